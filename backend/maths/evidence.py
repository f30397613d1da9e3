"""What photographs say about the nodes of a grid: signed distances near points, and free space.

Near a measured point p with normal n the distance field is, to first order (Taylor), n . (q - p) at
q; every point says so to the nodes around it, and the nodes take the mean. A node is free where a
photograph sees through it: in front of what was measured there, or off the subject's silhouette.
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, Int64
from torch import Tensor

from .geometry import Pinhole, inside, sample_image
from .grid import flat_numbers, node_steps, spacing

_BATCH = 8192
"""Points whose distances to all nodes around them are computed at once: few enough for a core's cache."""
_BEYOND = 3
"""Nodes around the grid that points at its border speak to; nobody reads them."""
_ENOUGH_SHARED = 100
"""Cubes in which two views say something, for their median to mean anything."""


@dataclass(frozen=True, kw_only=True)
class PointDistances:
    """First-order signed distances at nodes near points."""

    distance: Float[Tensor, "nodes nodes nodes"]
    weight: Float[Tensor, "nodes nodes nodes"]
    """Sum of the confidences that spoke, by nearness; 0 where no point is near."""


def point_distances(
    positions: Float[Tensor, "points 3"],
    normals: Float[Tensor, "points 3"],
    confidence: Float[Tensor, "points"],
    nodes: int,
    *,
    spread_cells: float = 1.0,
) -> PointDistances:
    """Weighted mean of n . (q - p) over the points within two cells of each node q."""
    h = spacing(nodes)
    padded = nodes + 2 * _BEYOND
    cells = (positions + 1) / h
    near = ((cells > -2) & (cells < nodes + 1)).all(dim=-1)
    offsets = _offsets(-1, 2, positions.device)
    steps, offset_at = offsets.to(positions.dtype), flat_numbers(offsets, padded)
    sums = positions.new_zeros((padded**3, 2))
    batches = (torch.split(column[near], _BATCH) for column in (cells, normals, confidence))
    for place, normal, sure in zip(*batches, strict=True):
        base = place.floor()
        # lengths in cells: a node o beside the base is o - f from the point, n . (o - f) along its normal
        f = place - base
        along = normal @ steps.T - (f * normal).sum(dim=-1, keepdim=True)
        apart2 = steps.square().sum(dim=-1) - 2 * f @ steps.T + f.square().sum(dim=-1, keepdim=True)
        # a Gaussian that is twice as wide along the normal as across it
        weight = sure[:, None] * torch.exp((0.75 * along * along - apart2) / spread_cells**2)
        at = flat_numbers(base.long() + _BEYOND, padded)[:, None] + offset_at
        terms = torch.stack([weight * along, weight], dim=-1)
        sums.index_add_(0, at.flatten(), terms.flatten(0, 1))
    inner = slice(_BEYOND, _BEYOND + nodes)
    total, weight = sums.reshape(padded, padded, padded, 2)[inner, inner, inner].unbind(-1)
    distance = h * total / weight.clamp(min=1e-6)
    return PointDistances(distance=distance, weight=torch.where(weight > 1e-3, weight, 0.0))


def merged_points(
    positions: Float[Tensor, "points 3"],
    normals: Float[Tensor, "points 3"],
    confidence: Float[Tensor, "points"],
    cell: float,
    *,
    correlated: bool = False,
) -> tuple[Float[Tensor, "merged 3"], Float[Tensor, "merged 3"], Float[Tensor, "merged"]]:
    """Points that share a cube and face the same way as one: means, and the confidence's sum.

    Positions and `cell`, the side of a cube, are in the same unit, such as that of the object frame.

    The same way is the same side of a die, so that the two faces of a thin sheet stay apart. If the errors
    of neighbours are `correlated`, more points are not more evidence: the confidence is the mean, in which
    each counts by itself. Of no points there are none.
    """
    if not len(positions):
        return positions, normals, confidence
    columns = torch.column_stack([positions, normals, confidence])
    _, sums = _weighted_sums(_faced_cubes(positions, normals, cell), columns, confidence)
    total = sums[:, -1]
    return (
        sums[:, :3] / total[:, None],
        F.normalize(sums[:, 3:6], dim=-1),
        sums[:, 6] / total if correlated else total,
    )


def scatter_between(
    positions: Float[Tensor, "points 3"],
    normals: Float[Tensor, "points 3"],
    confidence: Float[Tensor, "points"],
    views: Int64[Tensor, "points"],
    cell: float,
) -> float:
    """How far apart two views put the same surface, in the median over cubes of side `cell`.

    Along the normals, between the means of what each view says: at most about a cell. Infinite where hardly
    any two say anything.
    """
    if not len(positions):
        return math.inf
    num_views = int(views.max()) + 1
    keys = _faced_cubes(positions, normals, cell) * num_views + views
    groups, sums = _weighted_sums(keys, torch.column_stack([positions, normals]), confidence)
    place, normal = sums[:, :3] / sums[:, -1:], F.normalize(sums[:, 3:6], dim=-1)
    cube = groups // num_views
    shared = cube[1:] == cube[:-1]
    along = F.normalize(normal[1:] + normal[:-1], dim=-1)[shared]
    apart = ((place[1:] - place[:-1])[shared] * along).sum(dim=-1).abs()
    return float(apart.median()) if len(apart) >= _ENOUGH_SHARED else math.inf


def _weighted_sums(
    keys: Int64[Tensor, "points"], columns: Float[Tensor, "points columns"], weight: Float[Tensor, "points"]
) -> tuple[Int64[Tensor, "groups"], Float[Tensor, "groups columns+1"]]:
    """Sums over points of the same key, the last of the weight itself; keys of no weight are left out."""
    groups, group_of = torch.unique(keys, return_inverse=True)
    weighted = torch.column_stack([columns, torch.ones_like(weight)]) * weight[:, None]
    sums = columns.new_zeros((len(groups), weighted.shape[1])).index_add_(0, group_of, weighted)
    any_weight = sums[:, -1] > 0
    return groups[any_weight], sums[any_weight]


def _faced_cubes(
    positions: Float[Tensor, "points 3"], normals: Float[Tensor, "points 3"], cell: float
) -> Int64[Tensor, "points"]:
    """A number for the cube that a point lies in, and the side of a die that it faces."""
    axis = normals.abs().argmax(dim=-1)
    side = 2 * axis + (normals.gather(-1, axis[:, None])[:, 0] > 0)
    return cube_keys(positions, cell) * 6 + side


def cube_keys(positions: Float[Tensor, "points 3"], cell: float) -> Int64[Tensor, "points"]:
    """A number for the cube, of side `cell`, that a point lies in; of at least one point."""
    place = (positions / cell).floor().long()
    place -= place.amin(dim=0)
    size = place.amax(dim=0) + 1
    return (place[:, 0] * size[1] + place[:, 1]) * size[2] + place[:, 2]


def cell_px(camera: Pinhole, nodes: int) -> float:
    """About a cell of the grid in pixels of a photograph, at the grid's middle."""
    return float(spacing(nodes) * camera.intrinsics[0, 0] / camera.position.norm())


def half_cell_px(camera: Pinhole, nodes: int) -> int:
    """Half of that in whole pixels; at least 1."""
    return max(1, round(cell_px(camera, nodes) / 2))


def _offsets(first: int, last: int, device: torch.device) -> Int[Tensor, "offsets 3"]:
    steps = torch.arange(first, last + 1, device=device)
    return torch.cartesian_prod(steps, steps, steps)


def read_at_nodes(
    camera: Pinhole, image: Float[Tensor, "height width"], nodes: int, mode: str = "bilinear"
) -> tuple[
    Float[Tensor, "nodes nodes nodes"], Float[Tensor, "nodes nodes nodes"], Bool[Tensor, "nodes nodes nodes"]
]:
    """What an image holds where it shows each node, each node's depth, and whether it is shown at all."""
    pixel, depth = _project_nodes(camera, nodes)
    shown = inside(pixel, camera.width, camera.height) & (depth > 0)
    flat = pixel.reshape(nodes, nodes * nodes, 2)
    return sample_image(image[None], flat[None], mode=mode)[0, 0].reshape(shown.shape), depth, shown


def _project_nodes(
    camera: Pinhole, nodes: int
) -> tuple[Float[Tensor, "nodes nodes nodes 2"], Float[Tensor, "nodes nodes nodes"]]:
    """`project` of all nodes: homogeneous coordinates are sums of what each axis adds to them."""
    matrix = camera.intrinsics @ camera.camera_from_object[:3]
    steps = node_steps(nodes, matrix.device)
    x, y, depth = (
        (row[0] * steps)[:, None, None] + (row[1] * steps)[:, None] + (row[2] * steps + row[3])
        for row in matrix
    )
    divisor = torch.where(depth > 0, depth, 1.0)
    pixel = torch.empty((*depth.shape, 2), device=depth.device)
    torch.div(x, divisor, out=pixel[..., 0])
    torch.div(y, divisor, out=pixel[..., 1])
    return pixel, depth


def off_silhouette(
    camera: Pinhole, outline_px: Float[Tensor, "height width"], nodes: int
) -> Float[Tensor, "nodes nodes nodes"]:
    """Distance of every node from the silhouette, in object units: > 0 off the subject, < 0 on it.

    `outline_px` is the image's signed distance to the mask's outline; a node that the photograph does
    not show gets minus infinity (it may be anything).
    """
    at, depth, shown = read_at_nodes(camera, outline_px, nodes)
    return torch.where(shown, at * depth / camera.intrinsics[0, 0], -torch.inf)


def seen_through(
    camera: Pinhole, depth_map: Float[Tensor, "height width"], margin: float, nodes: int
) -> Bool[Tensor, "nodes nodes nodes"]:
    """Nodes that lie in front of what the photograph measured, by more than `margin`; object units."""
    measured, depth, shown = read_at_nodes(camera, depth_map, nodes, mode="nearest")
    return shown & (measured > 0) & (depth < measured - margin)
