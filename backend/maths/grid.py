"""Functions on a regular grid over the cube [-1, 1]^3, and their gradients.

A grid of N nodes per axis is a tensor [x, y, z, ...] whose node i lies at -1 + 2 i / (N - 1).
Between nodes the function is trilinear. Its value and its gradient in space at a given point are
both linear in the eight node values around, so that losses on gradients (eikonal, normals) need no
second derivatives: one backward pass through a gather gives everything.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Corners:
    """Where points lie in a grid."""

    index: Int[Tensor, "points 8"]
    """Flat node numbers of each point's cell."""
    weight: Float[Tensor, "points 8"]
    """Trilinear weights; they sum to one."""
    slope: Float[Tensor, "points 8 3"]
    """Gradient of each weight in space; they sum to zero."""


def spacing(nodes: int) -> float:
    """Distance between neighbouring nodes."""
    return 2.0 / (nodes - 1)


def node_steps(nodes: int, device: torch.device) -> Float[Tensor, "nodes"]:
    """Where the nodes lie along each axis."""
    return torch.linspace(-1, 1, nodes, device=device)


def node_positions(nodes: int, device: torch.device) -> Float[Tensor, "nodes nodes nodes 3"]:
    """Where the nodes lie."""
    steps = node_steps(nodes, device)
    return torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), dim=-1)


def cells_of(
    points: Float[Tensor, "points 3"], nodes: int
) -> tuple[Int[Tensor, "points 3"], Float[Tensor, "points 3"]]:
    """Lowest node of each point's cell, and where in the cell it lies, 0 to 1 along each axis.

    Points outside the cube are moved to its side. The second is differentiable in the points.
    """
    scaled = ((points + 1) * (0.5 * (nodes - 1))).clamp(0, nodes - 1)
    low = scaled.floor().clamp(max=nodes - 2)  # the last node belongs to the last cell
    return low.long(), scaled - low


def flat_numbers(place: Int[Tensor, "*batch 3"], nodes: int) -> Int[Tensor, "*batch"]:
    """Of nodes in memory, by their numbers along each axis; no GPU multiplies matrices of whole numbers."""
    x, y, z = place.unbind(-1)
    return (x * nodes + y) * nodes + z


def locate(points: Float[Tensor, "points 3"], nodes: int) -> Corners:
    """The cell of each point; points outside the cube are moved to its side."""
    base, t = cells_of(points, nodes)
    offsets = torch.tensor(
        [(i * nodes + j) * nodes + k for i in (0, 1) for j in (0, 1) for k in (0, 1)], device=points.device
    )
    sides = torch.stack([1 - t, t], dim=1)  # (points, 2, 3)
    x, y, z = sides.unbind(-1)
    xy = x[:, :, None] * y[:, None, :]
    weight = (xy[..., None] * z[:, None, None, :]).flatten(1)
    sign = points.new_tensor([-1.0, 1.0]) * (0.5 * (nodes - 1))
    slope_x = (sign[:, None, None] * (y[:, :, None] * z[:, None, :])[:, None]).flatten(1)
    slope_y = (sign[:, None] * (x[:, :, None] * z[:, None, :])[:, :, None]).flatten(1)
    slope_z = (xy[..., None] * sign).flatten(1)
    return Corners(
        index=flat_numbers(base, nodes)[:, None] + offsets,
        weight=weight,
        slope=torch.stack([slope_x, slope_y, slope_z], dim=-1),
    )


def interpolate(grid: Float[Tensor, "nodes nodes nodes"], corners: Corners) -> Float[Tensor, "points"]:
    """Value at each point."""
    return (grid.reshape(-1)[corners.index] * corners.weight).sum(dim=-1)


def read(
    grid: Float[Tensor, "nodes nodes nodes"], points: Float[Tensor, "points 3"]
) -> Float[Tensor, "points"]:
    """The same as `interpolate`, faster, for a grid that needs no gradients."""
    threads = 8  # torch spreads the batch axis over its threads
    padded = F.pad(points, (0, 0, 0, -len(points) % threads)).flip(-1)
    spread = padded.reshape(threads, 1, 1, -1, 3)
    whole = grid[None, None].expand(threads, -1, -1, -1, -1)
    values = F.grid_sample(whole, spread, padding_mode="border", align_corners=True)
    return values.flatten()[: len(points)]


def value_and_gradient(
    grid: Float[Tensor, "nodes nodes nodes"], corners: Corners
) -> tuple[Float[Tensor, "points"], Float[Tensor, "points 3"]]:
    """Value and spatial gradient at each point; both differentiable in the grid."""
    values = grid.reshape(-1)[corners.index]
    return (values * corners.weight).sum(dim=-1), torch.einsum("pc,pcd->pd", values, corners.slope)


def interpolate_features(
    grid: Float[Tensor, "cells channels"], corners: Corners
) -> Float[Tensor, "points channels"]:
    """Value of a grid with several channels, given as one row per node."""
    return torch.einsum("pc,pcd->pd", corners.weight, grid[corners.index])


def splat(
    values: Float[Tensor, "points channels"], corners: Corners, nodes: int
) -> Float[Tensor, "cells channels"]:
    """Sum of the points' values at the nodes, by trilinear weight: the transpose of interpolation."""
    out = values.new_zeros((nodes**3, values.shape[1]))
    for corner in range(8):
        out.index_add_(0, corners.index[:, corner], corners.weight[:, corner, None] * values)
    return out


def refined(grid: Float[Tensor, "coarse coarse coarse"], nodes: int) -> Float[Tensor, "nodes nodes nodes"]:
    """The same function on a grid of another size (trilinear)."""
    return F.interpolate(grid[None, None], size=(nodes, nodes, nodes), mode="trilinear", align_corners=True)[
        0, 0
    ]


def laplacian(
    grid: Float[Tensor, "nodes nodes nodes"],
) -> Float[Tensor, "nodes nodes nodes"]:
    """Sum of differences to the neighbours, in grid steps; symmetric: nothing flows through the sides."""
    out = torch.zeros_like(grid)
    for axis in range(3):
        count = grid.shape[axis]
        step = grid.narrow(axis, 1, count - 1) - grid.narrow(axis, 0, count - 1)
        out.narrow(axis, 0, count - 1).add_(step)
        out.narrow(axis, 1, count - 1).sub_(step)
    return out


def laplacian_at(
    node_values: Callable[[Int[Tensor, "*batch"]], Float[Tensor, "*batch"]],
    index: Int[Tensor, "chosen"],
    nodes: int,
) -> Float[Tensor, "chosen"]:
    """The same at chosen nodes (flat numbers), for a function of flat node numbers."""
    strides = torch.tensor([1, nodes, nodes * nodes], device=index.device)
    here = index[:, None]
    place = here // strides % nodes
    # beyond a side stands the node itself: no difference, nothing flows
    around = torch.cat([here + strides * (place < nodes - 1), here - strides * (place > 0), here], dim=-1)
    values = node_values(around)
    return (values[:, :6] - values[:, 6:]).sum(dim=-1)


def near_surface(grid: Float[Tensor, "nodes nodes nodes"], cells: int) -> Bool[Tensor, "nodes nodes nodes"]:
    """Nodes within `cells` steps (along the axes' boxes) of a change of sign."""
    inside = grid < 0
    return _widened(inside, cells) & _widened(~inside, cells)


def _widened(flags: Bool[Tensor, "nodes nodes nodes"], cells: int) -> Bool[Tensor, "nodes nodes nodes"]:
    """True where any node is, up to so many steps away on each axis; pooling takes 100 times as long."""
    nodes = len(flags)
    for axis in range(3):
        wide = flags.clone()
        for step in range(1, min(cells, nodes - 1) + 1):
            wide.narrow(axis, step, nodes - step).logical_or_(flags.narrow(axis, 0, nodes - step))
            wide.narrow(axis, 0, nodes - step).logical_or_(flags.narrow(axis, step, nodes - step))
        flags = wide
    return flags
