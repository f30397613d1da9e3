"""Rims: what a photograph's outline says of the surface that it touches.

A ray through the outline grazes the surface, so it lies in the tangent plane where it touches, and the
outline gives that plane's normal (Cipolla and Giblin, "Visual Motion of Curves and Surfaces", 2000).
Where along the ray is not said: it is taken where the field so far is lowest.
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ...maths.correlation import window_sum
from ...maths.evidence import half_cell_px
from ...maths.geometry import ray_directions
from ...maths.grid import spacing
from ...maths.rays import lowest_along
from ..measurements import Measurements

_FARTHEST_CELLS = 6.0
"""From the field's surface, in cells: a ray that comes no nearer touches something that is not there yet."""


@dataclass(frozen=True, kw_only=True)
class RimRays:
    """Rays that graze the surface; the same at every state of the field."""

    origins: Float[Tensor, "rims 3"]
    directions: Float[Tensor, "rims 3"]
    """Unit vectors."""
    normals: Float[Tensor, "rims 3"]
    """Of the surface where it is touched; unit vectors, outwards."""


def rim_rays(scene: Measurements, nodes: int) -> RimRays:
    """Rays through the outlines of all views, as many as a grid of so many nodes needs."""
    parts = [[scene.positions[:0]] * 3]
    for camera, edge, empty in zip(scene.cameras, scene.certain, scene.backdrops, strict=True):
        if edge is None:
            continue
        surely = edge.abs() if empty is None else torch.maximum(edge.abs(), empty.abs() - 1)
        pixels, across = _outline(edge, surely, half_cell_px(camera, nodes))
        directions = F.normalize(ray_directions(camera, pixels), dim=-1)
        # the line n . p = c of the image is the plane K^T (n, -c) of camera axes through the camera
        line = torch.cat([across, -(across * pixels).sum(dim=-1, keepdim=True)], dim=-1)
        normals = F.normalize((line @ camera.intrinsics) @ camera.camera_from_object[:3, :3], dim=-1)
        parts.append([camera.position.expand_as(directions), directions, normals])
    origins, directions, normals = (torch.cat(column) for column in zip(*parts, strict=True))
    return RimRays(origins=origins, directions=directions, normals=normals)


def rim_points(
    rays: RimRays, distance: Float[Tensor, "nodes nodes nodes"]
) -> tuple[Float[Tensor, "rims 3"], Float[Tensor, "rims 3"]]:
    """Where rays touch a field: where it is lowest on them, inside the cube; and the normals there."""
    h = spacing(distance.shape[0])
    reach = math.sqrt(3.0)
    count = math.ceil(2 * reach / h) + 1
    steps = torch.linspace(-reach, reach, count, device=distance.device)
    along, lowest = lowest_along(distance, rays.origins, rays.directions, rays.origins.norm(dim=-1), steps)
    near = lowest.abs() < _FARTHEST_CELLS * h
    return (rays.origins + along[:, None] * rays.directions)[near], rays.normals[near]


def _outline(
    edge: Float[Tensor, "height width"], surely: Float[Tensor, "height width"], step: int
) -> tuple[Float[Tensor, "rims 2"], Float[Tensor, "rims 2"]]:
    """Places on an outline to a fraction of a pixel, one in each square of `step`; unit normals, outwards."""
    # a mask knows its outline to a pixel: only a mean over several says how it turns
    smooth = window_sum(edge, 2) / 25  # less at the border, which is left out
    down, right = torch.gradient(smooth)
    inner = torch.zeros_like(edge, dtype=torch.bool)
    inner[3:-3, 3:-3] = True  # where a photograph ends is no outline
    rows, columns = torch.nonzero(inner & (surely < 0.75), as_tuple=True)
    slope = torch.stack([right[rows, columns], down[rows, columns]], dim=-1)
    clear = slope.norm(dim=-1) > 0.5  # else two outlines meet
    rows, columns, slope = rows[clear], columns[clear], slope[clear]
    blocks, block_of = torch.unique(rows // step * edge.shape[1] + columns // step, return_inverse=True)
    first = torch.full_like(blocks, len(rows))
    first.scatter_reduce_(0, block_of, torch.arange(len(rows), device=edge.device), "amin")
    rows, columns, across = rows[first], columns[first], F.normalize(slope[first], dim=-1)
    pixels = torch.stack([columns, rows], dim=-1) + 0.5
    return pixels - across * edge[rows, columns, None], across
