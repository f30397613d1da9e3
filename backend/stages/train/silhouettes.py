"""What silhouettes say of a field: where there is nothing, and which rays must meet an inside."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ...maths.evidence import half_cell_px, off_silhouette
from ...maths.geometry import Pinhole, ray_directions
from ...maths.grid import node_positions, read, spacing
from ...maths.rays import Crossing, first_crossing, points_along, sphere_entry, sphere_span
from ...maths.rows import Rows
from ..measurements import Measurements

_AROUND = 1.75
"""Radius of a ball around the grid's cube."""


def least_distance(scene: Measurements, nodes: int) -> Float[Tensor, "nodes nodes nodes"]:
    """A bound that the distance is not below where it is > 0: off any silhouette, before any empty backdrop,
    below the ground and outside the region."""
    points = node_positions(nodes, scene.positions.device)
    bound = (points - scene.region_centre).norm(dim=-1) - 0.97 * scene.region_radius
    bound = torch.maximum(bound, points.abs().amax(dim=-1) - (1 - spacing(nodes)))
    if scene.ground is not None:
        normal = torch.tensor(scene.ground.normal).to(points)
        bound = torch.maximum(bound, scene.ground.offset - points @ normal)
    for camera, outline, backdrop in zip(scene.cameras, scene.outlines, scene.backdrops, strict=True):
        edge = outline if outline is not None else backdrop
        if edge is not None:
            bound = torch.maximum(bound, off_silhouette(camera, edge, nodes))
    return bound


@dataclass(frozen=True, kw_only=True)
class SilhouetteRays(Rows):
    """Rays through the subject; each must meet an inside somewhere."""

    origins: Float[Tensor, "rays 3"]
    directions: Float[Tensor, "rays 3"]
    """Unit vectors."""
    entry: Float[Tensor, "rays"]
    """Where a ray comes near the grid, as far from its origin."""
    from_outline: Float[Tensor, "rays"]
    """Distance of the ray from the outline's rays, in units of the distance from the origin."""


def silhouette_rays(scene: Measurements, nodes: int) -> SilhouetteRays:
    """As many rays as a grid of so many nodes needs."""
    none = scene.positions[:0]
    parts = [[none, none, none[:, 0], none[:, 0]]]
    for camera, outline in zip(scene.cameras, scene.certain, strict=True):
        if outline is None:
            continue
        step = half_cell_px(camera, nodes)
        rows, columns = torch.nonzero(outline[::step, ::step] < -0.5 * step, as_tuple=True)
        pixels = torch.stack([columns, rows], dim=-1) * step + 0.5
        directions = F.normalize(ray_directions(camera, pixels), dim=-1)
        meets = _meets_region(scene, camera, directions)
        rows, columns, directions = rows[meets], columns[meets], directions[meets]
        origins = camera.position.expand_as(directions)
        entry = grid_entry(origins, directions)
        inside_px = -outline[rows * step, columns * step]
        parts.append([origins, directions, entry, inside_px / camera.intrinsics[0, 0]])
    origins, directions, entry, from_outline = (torch.cat(column) for column in zip(*parts, strict=True))
    return SilhouetteRays(origins=origins, directions=directions, entry=entry, from_outline=from_outline)


def middles(
    rays: SilhouetteRays, bound: Float[Tensor, "nodes nodes nodes"]
) -> tuple[Float[Tensor, "possible 3"], Float[Tensor, "possible"]]:
    """Where a ray that misses the field should be inside, and how deep.

    In the middle of all places that may be inside as far as `bound` (of least_distance) knows; as deep as
    it is from the outline, but not more than a cell. A ray on which nothing may be inside is contradicted
    by another photograph, and left out.
    """
    along, allowed = _allowed(rays, bound)
    possible = allowed[:, -1] > 0
    index = torch.searchsorted(allowed, (allowed[:, -1:] + 1) // 2)[possible]
    at = along[possible].gather(1, index)
    middle = rays.origins[possible] + at * rays.directions[possible]
    depth = (rays.from_outline[possible] * at[:, 0]).clamp(max=spacing(len(bound)))
    return middle, depth


def uncontradicted(rays: SilhouetteRays, bound: Float[Tensor, "nodes nodes nodes"]) -> SilhouetteRays:
    """The rays on which something may be inside as far as `bound` (of least_distance) knows."""
    return rays.chosen(_allowed(rays, bound)[1][:, -1] > 0)


def _allowed(
    rays: SilhouetteRays, bound: Float[Tensor, "nodes nodes nodes"]
) -> tuple[Float[Tensor, "rays places"], Int[Tensor, "rays places"]]:
    """Places along each ray, and how many up to each may be inside."""
    along = rays.entry[:, None] + torch.linspace(0, 2 * _AROUND, 2 * len(bound), device=bound.device)
    points = points_along(rays.origins, rays.directions, along)
    return along, (read(bound, points.reshape(-1, 3)) < 0).reshape(along.shape).cumsum(dim=1)


def inside_along(
    rays: SilhouetteRays, distance: Float[Tensor, "nodes nodes nodes"], before: Float[Tensor, "rays"]
) -> Float[Tensor, "rays"]:
    """How far along each ray a field is inside, about where the ray enters it; infinite where it misses.

    `before` is the same of an earlier field, or infinite: where this one is inside there too, nothing is
    searched. A field changes little from round to round, so hardly a ray has to be traced again.
    """
    known = before.isfinite()
    at = torch.where(known, before, 0.0)[:, None]
    known = known & (read(distance, rays.origins + at * rays.directions) < 0)
    lost = torch.nonzero(~known)[:, 0]
    origins, directions, entry = rays.origins[lost], rays.directions[lost], rays.entry[lost]
    crossing = grid_crossing(distance, origins, directions, entry)
    found = torch.where(crossing.hit, crossing.along + 0.25 * spacing(len(distance)), torch.inf)
    return before.index_copy(0, lost, found)


def grid_entry(
    origins: Float[Tensor, "rays 3"], directions: Float[Tensor, "rays 3"]
) -> Float[Tensor, "rays"]:
    """Where rays (unit directions) come near the grid's cube, as far from their origins."""
    return sphere_entry(origins / _AROUND, directions) * _AROUND


def grid_crossing(
    distance: Float[Tensor, "nodes nodes nodes"],
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    entry: Float[Tensor, "rays"],
) -> Crossing:
    """Where rays meet a field on the grid, from their `grid_entry` on, in steps of half a cell and more."""
    return first_crossing(
        distance,
        origins,
        directions,
        entry,
        reach=2 * _AROUND,
        shortest=0.5 * spacing(len(distance)),
        steps=60,
    )


def missing(rays: SilhouetteRays, distance: Float[Tensor, "nodes nodes nodes"]) -> Bool[Tensor, "rays"]:
    """Rays that miss a field's inside."""
    return inside_along(rays, distance, torch.full_like(rays.entry, torch.inf)).isinf()


def _meets_region(
    scene: Measurements, camera: Pinhole, directions: Float[Tensor, "rays 3"]
) -> Bool[Tensor, "rays"]:
    """Rays that go through the region's inner nine tenths."""
    inner = (camera.position - scene.region_centre) / (0.9 * scene.region_radius)
    entry, leave = sphere_span(inner.expand_as(directions), directions)
    return leave > entry
