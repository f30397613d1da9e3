"""Learned features of places in the cube [-1, 1]^3, on grids of many sizes at once.

Instant-NGP (Mueller et al., arXiv:2201.05989), section 3, in plain torch. A level is a grid of N cells along
each axis with a row of features at each node, trilinear in between. Levels with more nodes than a table may
have rows share rows by a hash of the node's number; what collides is left to be sorted out by learning.
The grids are those of grid.py: node i of N + 1 lies at -1 + 2 i / N.
"""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from .grid import cells_of

_PRIMES = (1, 2_654_435_761, 805_459_861)
"""One per axis; eq. 4."""


def level_cells(levels: int, coarsest: int, finest: int) -> tuple[int, ...]:
    """Cells along each axis of each level, by one factor from `coarsest` to `finest` (eq. 2, 3)."""
    growth = math.log(finest / coarsest) / max(1, levels - 1)
    return tuple(round(coarsest * math.exp(level * growth)) for level in range(levels))


def table_rows(cells: int, most: int) -> int:
    """Rows of a level's table: one for each node, but at most so many."""
    return min((cells + 1) ** 3, most)


def corner_rows(low: Int[Tensor, "points 3"], cells: int, rows: int) -> Int[Tensor, "points 8"]:
    """Row in the level's table of the eight nodes around each point, given the lowest of them.

    Each node has a row of its own where the table is large enough, else that of its hash.
    """
    nodes = cells + 1
    dense = rows == nodes**3
    factors = low.new_tensor((nodes * nodes, nodes, 1) if dense else _PRIMES)
    x, y, z = (torch.stack([low, low + 1], dim=1) * factors).unbind(-1)
    x, y, z = x[:, :, None, None], y[:, None, :, None], z[:, None, None, :]
    return (x + y + z).flatten(1) if dense else (x ^ y ^ z).flatten(1) % rows


def encode(
    tables: Sequence[Float[Tensor, "_ features"]],
    cells: Sequence[int],
    points: Float[Tensor, "points 3"],
    active: int,
) -> Float[Tensor, "points encoded"]:
    """Features of all levels, coarse to fine, one table per level; 0 for those from `active` on.

    Levels that are not active cost nothing. Differentiable, twice, in tables and points; in the points
    only within cells, as anything piecewise linear. Points outside the cube are moved to its side.
    """
    found = []
    for table, along in zip(tables[:active], cells, strict=False):
        low, t = cells_of(points, along + 1)
        sides = torch.stack([1 - t, t], dim=1)
        x, y, z = sides[:, :, None, None, 0], sides[:, None, :, None, 1], sides[:, None, None, :, 2]
        values = F.embedding(corner_rows(low, along, len(table)), table)
        found.append(((x * y * z).flatten(1)[..., None] * values).sum(dim=1))
    silent = sum(table.shape[1] for table in tables[active:])
    return torch.cat([*found, points.new_zeros((len(points), silent))], dim=-1)
