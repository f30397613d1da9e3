"""The linear part of the fit: the smoothest field that agrees with points, silhouettes and free space."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from ...maths.evidence import PointDistances, merged_points, point_distances, seen_through
from ...maths.grid import locate, spacing, splat
from ...maths.nearest import nearest_tree
from ...maths.rays import points_along
from ...maths.smooth_fit import fit_smooth
from ..measurements import Measurements
from .inner_outlines import FarSide
from .rims import RimRays, rim_points, rim_rays
from .shared_brightness import MOSTLY_TEXTURED, ShownPlaces
from .silhouettes import SilhouetteRays, inside_along, least_distance, middles, silhouette_rays
from .unseen_side import ball_behind, depth_is_bounded

OrientedPoints = tuple[Float[Tensor, "points 3"], Float[Tensor, "points 3"], Float[Tensor, "points"]]
"""Positions, normals and weights."""
Ask = Callable[[Float[Tensor, "nodes nodes nodes"]], ShownPlaces | None]
"""What brightness tells about a field; None if nothing more, and not to be asked again."""
_ENOUGH_TOLD = 0.07
"""Share of the surface that brightness has to tell for it to be fitted as what is plain."""
_FADE = 0.7
"""Share of its pull that a missed ray keeps in the next round: rays that are hit by then let go."""
_PUSHED_CELLS = 4.0
"""How far off a bridge is pushed: as far as brightness may tell that it is too near."""
_HARDLY_MEASURED = 0.1
"""Weight of the points around a node that pushes nothing away."""
_RIM_REACH = 0.2
"""How far from a measured point a rim is sure, in units of the grid's frame, if depth is not bounded."""


@dataclass(frozen=True, kw_only=True)
class LinearConfig:
    """Weights beside that of measurements, which is about 1."""

    smoothness: float = 0.1
    """Of the squared Laplacian."""
    free_space: float = 4.0
    """Off silhouettes, where the field says otherwise."""
    seen_through: float = 0.2
    """In front of what was measured, where the field says otherwise."""
    inner_outlines: bool = True
    """Whether bridges are looked for where photographs show that one part hides another."""
    flat_faces: bool = True
    """Whether what is evenly bright, with its border on a plane, is taken to lie on it."""
    brightness: float = 1.0
    """Of places that brightness tells where no texture does; 0 not to look for any."""
    may_shine: bool = True
    """Whether light that a thing is found to mirror is taken off the photographs for that."""
    silhouettes: float = 0.2
    """On rays through the subject that miss the field."""
    rims: float = 0.2
    """Where rays through the outline touch the field, if silhouettes bound the depth; else less."""
    prior: float = 1e-3
    """Of the level before, at 32 nodes; more than 0."""
    settled: float = 0.005
    """Movement of the surface in a round, in cells on average, below which no further round is asked for."""
    spread_cells: float = 1.0
    """How far points speak across their normals; twice as far along them."""
    stereo: float = 1.0
    """Of what stereo measured, beside what brightness tells."""
    confidence_power: float = 3.0
    """Points weigh as this power of their confidence."""
    power_if_textured: float = 1.5
    """The same where patches agree on most of the surface."""
    correlated: bool = True
    """Neighbouring pixels are matched by nearly the same windows: their errors are one error."""
    ball: float | None = None
    """Radius of the ball behind, in half widths of the subject; None to find it out."""


def for_plain(config: LinearConfig, textured: float, told: float) -> LinearConfig:
    """For the last grid where brightness tells what patches do not: smoother, and led by outlines.

    Patches that agree where there is little texture are few, lie along edges of paint, and know their depth
    better than their slope: at full weight each line of them is a dent in what is smooth around it. The less
    of the surface is `textured`, the less they weigh, if brightness has `told` enough (both of
    shared_brightness): else what patches do not tell is not plain but narrow, or faint.
    """
    plain = (1 - min(1.0, textured / MOSTLY_TEXTURED) ** 2) * min(1.0, told / _ENOUGH_TOLD)
    return replace(
        config,
        stereo=(1 - plain) * config.stereo,
        smoothness=(1 + plain) * config.smoothness,
        rims=(1 + 2 * plain) * config.rims,
    )


def for_textured(config: LinearConfig) -> LinearConfig:
    """Where patches agree on most of the surface: there doubtful points are seldom wrong, and count more."""
    return replace(config, confidence_power=config.power_if_textured)


def weight_beside(told: ShownPlaces, scene: Measurements, config: LinearConfig) -> float:
    """Of what brightness `told`, beside what stereo measured; infinite where that is nothing."""
    told_weight, measured = config.brightness * told.weights.sum(), stereo_weights(scene, config).sum()
    return float(told_weight / measured) if measured > 0 else math.inf


def start(scene: Measurements, radius: float, nodes: int) -> Float[Tensor, "nodes nodes nodes"]:
    """A field to begin with: the ball behind the surface, cut by what is free."""
    return torch.maximum(ball_behind(scene, radius, nodes), least_distance(scene, nodes))


def ask_nothing(distance: Float[Tensor, "nodes nodes nodes"]) -> None:
    """Nothing is told about any field."""


def fit_level(
    scene: Measurements,
    before: Float[Tensor, "nodes nodes nodes"],
    radius: float,
    rounds: int,
    config: LinearConfig,
    far: Sequence[FarSide] = (),
    told: ShownPlaces | None = None,
    ask: Ask = ask_nothing,
    looks: int = 0,
) -> Float[Tensor, "nodes nodes nodes"]:
    """The smoothest field near the points' planes that silhouettes allow, else like the level before.

    Smooth is measured against the ball behind, whose curvature is free. Free space (f > 0) and silhouettes
    (f < 0 somewhere on each ray) are inequalities: they pull only where the field says otherwise, which
    takes a few rounds; `rounds` at most, fewer where the surface comes to rest. What is before `far` sides is
    free as what is before measured depth. Places `told` about the level before are points as well.
    Before each of the last `looks` rounds, and if the surface rests earlier, `ask` is told the field: the
    places that it answers with stand in place of those, and a bridge before those that it hid is pushed away.
    """
    nodes = before.shape[0]
    h = spacing(nodes)
    points = _points(scene, config, h / 2, told)
    measured = _near_nodes(points, nodes, config)
    ball = ball_behind(scene, radius, nodes)
    bound = least_distance(scene, nodes)
    free = bound > 0
    through = _seen_through_any(scene, nodes, 3 * h)
    for side in far:
        through |= seen_through(side.camera, side.depth, 2 * h, nodes)
    bridges = torch.zeros_like(through)
    through_subject, pulled = silhouette_rays(scene, nodes), torch.zeros((nodes**3, 2), device=before.device)
    met_along = torch.full_like(through_subject.entry, torch.inf)
    rays, nearest = rim_rays(scene, nodes), nearest_tree(points[0].cpu().numpy())
    distance, left = before, rounds
    while left:
        if left <= looks:
            if (shown := ask(distance)) is None:
                looks = 0
            else:
                measured = points_near_nodes(scene, config, nodes, shown)
                bridges = _before_hidden(shown, nodes) & (measured.weight < _HARDLY_MEASURED)
        target, weight = _broken(
            distance,
            before,
            config.prior * (32 / nodes) ** 2,
            (free, bound, config.free_space),
            (through, 2 * h, config.seen_through),
            (bridges, _PUSHED_CELLS * h, config.seen_through),
        )
        met_along = inside_along(through_subject, distance, met_along)
        pulled = _FADE * pulled + _pulls(through_subject.chosen(met_along.isinf()), bound)
        pull = _pull(pulled, free, config.silhouettes)
        rims = _rim_distances(scene, rays, distance, nearest, config.rims)
        total = weight + measured.weight + pull.weight + rims.weight
        target = weight * target + measured.weight * measured.distance
        target += rims.weight * rims.distance + pull.weight * pull.distance
        last = distance
        distance = ball + fit_smooth(
            target / total - ball, total, last - ball, smoothness=config.smoothness, steps=30
        )
        rests = _movement(last, distance) < config.settled * h
        left = left - 1 if not rests else looks if looks < left else 0
    return distance


def _broken(
    distance: Float[Tensor, "nodes nodes nodes"],
    before: Float[Tensor, "nodes nodes nodes"],
    prior: float,
    *bounds: tuple[Bool[Tensor, "nodes nodes nodes"], Float[Tensor, "nodes nodes nodes"] | float, float],
) -> tuple[Float[Tensor, "nodes nodes nodes"], Float[Tensor, "nodes nodes nodes"]]:
    """Targets and weights: `before`, and where the field is below a bound (where, least, weight) that one.

    Of several the last counts.
    """
    target, weight = before, torch.full_like(before, prior)
    for where, least, strength in bounds:
        carved = where & (distance < least)
        target, weight = torch.where(carved, least, target), torch.where(carved, strength, weight)
    return target, weight


def points_near_nodes(
    scene: Measurements, config: LinearConfig, nodes: int, shown: ShownPlaces | None = None
) -> PointDistances:
    """What stereo measured, and what brightness tells, says of the nodes around it."""
    return _near_nodes(_points(scene, config, spacing(nodes) / 2, shown), nodes, config)


def _points(
    scene: Measurements, config: LinearConfig, cell: float, shown: ShownPlaces | None = None
) -> OrientedPoints:
    """What stereo measured and what brightness tells, merged in cubes."""
    positions, normals = scene.positions, scene.normals
    sure = stereo_weights(scene, config)
    if shown is not None:
        positions = torch.cat([positions, shown.positions])
        normals = torch.cat([normals, shown.normals])
        sure = torch.cat([sure, config.brightness * shown.weights])
    return merged_points(positions, normals, sure, cell, correlated=config.correlated)


def stereo_weights(scene: Measurements, config: LinearConfig) -> Float[Tensor, "points"]:
    """What stereo's points weigh."""
    return config.stereo * scene.confidence**config.confidence_power


def _near_nodes(points: OrientedPoints, nodes: int, config: LinearConfig) -> PointDistances:
    measured = point_distances(*points, nodes, spread_cells=config.spread_cells)
    return replace(measured, weight=measured.weight.clamp(max=4.0))


def _movement(
    last: Float[Tensor, "nodes nodes nodes"], distance: Float[Tensor, "nodes nodes nodes"]
) -> float:
    """Mean change at the nodes within a cell of the surface, in units of the grid's frame; 0 without any."""
    near = distance.abs() < spacing(len(distance))
    return float((distance - last)[near].abs().mean().nan_to_num())


def _before_hidden(shown: ShownPlaces, nodes: int) -> Bool[Tensor, "nodes nodes nodes"]:
    """Nodes along the rays to hidden places, from a cell before them as far as a bridge may reach."""
    h, hidden = spacing(nodes), shown.chosen(shown.hidden)
    along = -h * torch.arange(1.5, 2 * _PUSHED_CELLS + 0.5, 0.5, device=hidden.positions.device)
    at = points_along(hidden.positions, hidden.directions, along.expand(len(hidden.positions), -1))
    place = ((at.reshape(-1, 3) + 1) / h).round().long()
    x, y, z = place[((place >= 0) & (place < nodes)).all(dim=-1)].unbind(-1)
    before = torch.zeros((nodes, nodes, nodes), dtype=torch.bool, device=at.device)
    before[x, y, z] = True
    return before


def _pulls(missed: SilhouetteRays, bound: Float[Tensor, "nodes nodes nodes"]) -> Float[Tensor, "cells 2"]:
    """At the nodes around the middles of rays that miss the field: 1 for each, and how deep it should be."""
    middle, depth = middles(missed, bound)
    nodes = bound.shape[0]
    return splat(torch.stack([torch.ones_like(depth), depth], dim=-1), locate(middle, nodes), nodes)


def _pull(
    pulled: Float[Tensor, "cells 2"], free: Bool[Tensor, "nodes nodes nodes"], most: float
) -> PointDistances:
    """What the pulls, added up, say of the nodes that are not free: to be inside, weighing at `most` that."""
    rays_near, depths = pulled.reshape(*free.shape, 2).unbind(-1)
    weight = most * rays_near.clamp(max=1.0) * ~free
    return PointDistances(distance=-depths / rays_near.clamp(min=1e-6), weight=weight)


def _rim_distances(
    scene: Measurements,
    rays: RimRays,
    distance: Float[Tensor, "nodes nodes nodes"],
    measured: cKDTree,
    weight: float,
) -> PointDistances:
    """What the rims say of the nodes around them; less, the farther they are from what was measured.

    There only the field's own guess says where a ray touches, unless silhouettes bound the depth. Where
    nothing was measured, guesses are all there is.
    """
    positions, normals = rim_points(rays, distance)
    apart = torch.zeros_like(positions[:, 0])
    if measured.n:
        nearest, _ = measured.query(positions.cpu().numpy(), workers=-1)
        apart = torch.tensor(nearest, dtype=positions.dtype, device=positions.device)
    doubt = (1 - depth_is_bounded(scene)) * (1 + (apart / _RIM_REACH).square())
    said = point_distances(positions, normals, weight * torch.exp(-doubt), distance.shape[0])
    return replace(said, weight=said.weight.clamp(max=2.0))


def _seen_through_any(scene: Measurements, nodes: int, margin: float) -> Bool[Tensor, "nodes nodes nodes"]:
    free = torch.zeros((nodes, nodes, nodes), dtype=torch.bool, device=scene.positions.device)
    for camera, depth in zip(scene.cameras, scene.sure_depths, strict=True):
        free |= seen_through(camera, depth, margin, nodes)
    return free
