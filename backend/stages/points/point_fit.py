"""A surface from points alone: noisy, sparse, incomplete, with or without normals.

`linear` lets a short Neural-Pull run say which side is inside, opens the lids on which no points lie, and
then fits the smoothest grid that agrees with the points' planes, as smooth as foretells best points that
were held out. The other methods are networks alone.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float64
from torch import Tensor

from ...errors import ErrorCode, ReconstructionError
from ...maths.evidence import merged_points, point_distances
from ...maths.grid import interpolate, locate, refined, spacing, value_and_gradient
from ...maths.neighbours import against_neighbours, neighbour_planes, trusts
from ...maths.sides import Sides, sides_by_walking
from ...maths.smooth_fit import fit_smooth
from ...point_methods import PointMethod
from ...scene import Decision, Progress, to_unit_sphere, within
from ..safe_steps import not_finite
from ..surface import Surface
from .point_cloud import PointCloud
from .point_network import LearnedField, NetworkConfig, fit_network

_LEFT_OUT = 5
"""One point in so many is held out to choose the smoothness."""
_COARSE = 48, 64
"""Nodes along each axis of the grids on which it is chosen."""
_MARGIN = 1.25
"""Half a side of the cube over half the widest extent of the cloud."""
_MOST_FLIPPED = 0.1
"""Share of normals against their neighbours'; more, and the signs are chance."""
_CLEAR = 3.0
"""Where the nearest point tells how far the surface is: so many times as far as points are apart."""
_WORK = 10_000
"""Conjugate gradients on a grid, times its nodes along an axis: with fewer the network's waves stay."""
_SURE = 0.25
"""Trust of points that bound the cube and tell the networks: three and a half times the usual area."""
_KNOWN = 0.5
"""Trust of points that a walk may not pass unnoticed: strays would be walls."""


@dataclass(frozen=True, kw_only=True)
class PointFitConfig:
    """How the cloud is fitted."""

    method: PointMethod = PointMethod.LINEAR
    normals_known: bool = False
    """Whether the cloud's normals point outwards and are to be met."""
    nodes: int = 128
    """Along each axis of the finest grid."""
    most_points: int = 200_000
    """Of more, so many are drawn."""
    sides: NetworkConfig = field(
        default_factory=lambda: NetworkConfig(
            layers=3, steps=300, batch=500, learning_rate=5e-3, warm_up=30, anywhere=0.25
        )
    )
    """`linear`: of the run that finds the sides. With slower learning a torus is still without its hole."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    """The other methods."""
    smoothness: tuple[float, ...] = (0.1, 0.5, 2.0)
    """`linear`: of the squared Laplacian at 64 nodes; the choice."""
    prior: float = 1e-2
    """`linear`: weight of the sides' distances far from points, at 32 nodes."""


@dataclass(frozen=True, kw_only=True)
class _Points:
    """The cloud in the cube [-1, 1]^3."""

    positions: Float[Tensor, "points 3"]
    trust: Float[Tensor, "points"]
    planes: Float[Tensor, "points 3"]
    """Normals of the neighbours' planes, or the given ones."""
    flatness: Float[Tensor, "points"]
    signs_known: bool

    def where(self, kept: Tensor) -> "_Points":
        return replace(
            self,
            positions=self.positions[kept],
            trust=self.trust[kept],
            planes=self.planes[kept],
            flatness=self.flatness[kept],
        )


def fit_points(
    cloud: PointCloud,
    config: PointFitConfig,
    *,
    device: torch.device,
    generator: torch.Generator,
    progress: Progress,
) -> Surface:
    """The distance field whose zero level the points lie on.

    Raises ReconstructionError(CLOUD_UNUSABLE) if normals are said to be known and the cloud has none, and
    NO_SURFACE if the points enclose nothing.
    """
    progress(0.0, "neighbours of the points")
    positions = cloud.positions
    normals = _known_normals(cloud) if config.normals_known else None
    decisions = list(cloud.decisions)
    if len(positions) > config.most_points:
        drawn = torch.randperm(len(positions), generator=generator)[: config.most_points].numpy()
        decisions.append(_decision("points", f"{config.most_points} of {len(positions)}", "drawn by lot"))
        positions, normals = positions[drawn], None if normals is None else normals[drawn]
    trust = trusts(positions)
    low, high = _extent(positions[trust > _SURE])
    middle, half = (low + high) / 2, _MARGIN * float((high - low).max()) / 2
    frame = to_unit_sphere(middle, half)
    placed = (positions - middle) / half  # not by the frame, in which digits cancel far from the origin
    near = (np.abs(placed) < 1).all(axis=1)
    placed, trust = placed[near], trust[near]
    if config.method == PointMethod.LINEAR:
        points = _points(placed, trust, None if normals is None else normals[near], device)
        distance, made = _fit_linear(points, config, generator=generator, progress=progress)
        decisions += made
    else:
        sure = torch.tensor(placed[trust > _SURE], dtype=torch.float32, device=device)
        learned = fit_network(
            sure, config.nodes, config.method, config.network, generator=generator, progress=progress
        )
        distance = learned.distance
        decisions.append(_of_learning("the network", config.network, learned))
    if not bool(distance.isfinite().all() & (distance < 0).any() & (distance > 0).any()):
        raise ReconstructionError(
            ErrorCode.NO_SURFACE,
            "No surface was found in the points.",
            "Check that they lie on a surface; try another method.",
        )
    return Surface(distance=distance.cpu().numpy(), grid_from_world=frame, decisions=tuple(decisions))


def _known_normals(cloud: PointCloud) -> Float64[np.ndarray, "points 3"]:
    if cloud.normals is None or not cloud.normals.any():
        raise ReconstructionError(
            ErrorCode.CLOUD_UNUSABLE,
            "The cloud has no normals, though they are said to be known.",
            "Do not say that they are known: a surface is found without them.",
        )
    return cloud.normals


def _extent(
    positions: Float64[np.ndarray, "points 3"],
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
    return positions.min(axis=0), positions.max(axis=0)


def _points(
    placed: Float64[np.ndarray, "points 3"],
    trust: Float64[np.ndarray, "points"],
    normals: Float64[np.ndarray, "points 3"] | None,
    device: torch.device,
) -> _Points:
    def tensor(array: Float64[np.ndarray, "*shape"]) -> Tensor:
        return torch.tensor(array, dtype=torch.float32, device=device)

    if normals is None:
        planes, flatness = neighbour_planes(placed)
        signs_known = False
    else:
        planes, flatness = normals, np.linalg.norm(normals, axis=1)
        signs_known = float(against_neighbours(placed, normals).mean()) <= _MOST_FLIPPED
    return _Points(
        positions=tensor(placed),
        trust=tensor(trust),
        planes=tensor(planes),
        flatness=tensor(flatness),
        signs_known=signs_known,
    )


def _fit_linear(
    points: _Points, config: PointFitConfig, *, generator: torch.Generator, progress: Progress
) -> tuple[Float[Tensor, "nodes nodes nodes"], list[Decision]]:
    sure = points.positions[points.trust > _SURE]
    learned = fit_network(
        sure,
        _COARSE[-1],
        PointMethod.NEURAL_PULL,
        config.sides,
        generator=generator,
        progress=within(progress, 0.0, 0.6),
    )
    with torch.no_grad():
        progress(0.6, "walking from side to side")
        known = points.trust > _KNOWN
        sides = sides_by_walking(
            learned.distance, points.positions[known], points.planes[known], points.flatness[known].square()
        )
        inwards = _share_inwards(points, sides) if points.signs_known else 0.0
        if inwards > 0.5:
            points = replace(points, planes=-points.planes)
        progress(0.6, "choosing the smoothness")
        held = torch.randperm(len(points.positions), generator=generator) % _LEFT_OUT == 0
        foretold = []
        for tried in config.smoothness:
            progress(0.6, "choosing the smoothness")
            coarse = _fit_levels(points.where(~held), sides, _COARSE, tried, config.prior)
            foretold.append(_distance_off(points.where(held), coarse))
        missed, smoothness = min(zip(foretold, config.smoothness, strict=True))
        progress(0.8, f"fitting points on a grid of {config.nodes}^3")
        levels = (*(nodes for nodes in (*_COARSE, 96) if nodes < config.nodes), config.nodes)
        distance = _fit_levels(points, sides, levels, smoothness, config.prior)
    percent = 100 * missed / np.sqrt(12)  # of the cube's diagonal
    made = [
        _of_learning("the sides' network", config.sides, learned),
        _decision(
            "smoothness",
            f"{smoothness:g}",
            f"one point in {_LEFT_OUT}, held out, is met to {percent:.2g} % of the cube's diagonal",
        ),
    ]
    if config.normals_known and not points.signs_known:
        made.append(
            _decision(
                "normals",
                "their signs left out",
                f"more than {_MOST_FLIPPED:.0%} are against their neighbours'",
            )
        )
    if inwards > 0.5:
        made.append(_decision("normals", "all turned round", f"{inwards:.0%} point inwards"))
    return distance, made


def _share_inwards(points: _Points, sides: Sides) -> float:
    """Of the points, by trust: how many have more outside behind their normals than before them."""
    nodes = len(sides.distance)
    step = 2 * spacing(nodes) * points.planes
    before, behind = (
        interpolate(sides.distance, locate(points.positions + way * step, nodes)) for way in (1, -1)
    )
    return float((points.trust * (before < behind)).sum() / points.trust.sum())


def _fit_levels(
    points: _Points, sides: Sides, levels: tuple[int, ...], smoothness: float, prior: float
) -> Float[Tensor, "nodes nodes nodes"]:
    """Grid by grid the smoothest field near the points' planes; far from points like `sides`.

    The energy of the same function grows with the cell, so that its weight grows with the nodes.
    """
    distance = sides.distance
    # The planes know better than the nearest point where points are near: it is noisy, and beside the gaps.
    told = prior * -torch.expm1(-(sides.clearance / _CLEAR).square())
    for nodes in levels:
        distance, like = refined(distance, nodes), refined(sides.distance, nodes)
        h = spacing(nodes)
        normals, weight = _facing(points, distance, h)
        measured = point_distances(*merged_points(points.positions, normals, weight, h / 2), nodes)
        measured_weight = measured.weight.clamp(max=4.0)
        prior_weight = refined(told, nodes) * (32 / nodes) ** 2
        total = measured_weight + prior_weight
        target = torch.where(
            total > 0, (measured_weight * measured.distance + prior_weight * like) / total, like
        )
        distance = fit_smooth(
            target, total, distance, smoothness=smoothness * nodes / 64, steps=_WORK // nodes
        )
    return distance


def _facing(
    points: _Points, distance: Float[Tensor, "nodes nodes nodes"], cell: float
) -> tuple[Float[Tensor, "points 3"], Float[Tensor, "points"]]:
    """Normals that agree in sign with the field so far, and what weight the points have beside it.

    Where neighbours lie in no plane the field's own gradient is the better normal. A point far from the
    surface that most points lie on is a stray: its weight falls with the fourth power of the distance.
    """
    value, gradient = value_and_gradient(distance, locate(points.positions, len(distance)))
    gradient = F.normalize(gradient, dim=-1)
    usual = 1.5 * value.abs()[points.trust > 0.5].median() + 0.25 * cell
    weight = points.trust / (1 + (value / (2 * usual)).square()).square()
    if points.signs_known:
        return points.planes, weight * (points.flatness > 0)
    sign = torch.where((points.planes * gradient).sum(dim=-1, keepdim=True) < 0, -1.0, 1.0)
    share = points.flatness.square()[:, None]
    return F.normalize(share * sign * points.planes + (1 - share) * gradient, dim=-1), weight


def _distance_off(points: _Points, distance: Float[Tensor, "nodes nodes nodes"]) -> float:
    """Mean distance of the points from the zero level, weighted by trust; to first order |f| / |grad f|."""
    value, gradient = value_and_gradient(distance, locate(points.positions, len(distance)))
    off = value.abs() / torch.linalg.vector_norm(gradient, dim=-1).clamp(min=0.3)
    return float((points.trust * off).sum() / points.trust.sum())


def _of_learning(what: str, config: NetworkConfig, learned: LearnedField) -> Decision:
    """How many steps a network took, and whether all of them went well."""
    because = "the method's setting"
    if learned.taken_back:
        because += f"; {not_finite(learned.taken_back)}, were taken back and shortened"
    return _decision(what, f"{config.steps} steps", because)


def _decision(what: str, choice: str, because: str) -> Decision:
    return Decision(what=what, choice=choice, because=because)
