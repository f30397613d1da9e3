"""What NeuS and SparseCraft ask of their networks: to look like the photographs, and to pass the points."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from ...maths import losses
from ...maths.gradients import analytic_gradient, central_gradient
from ...maths.nearest import nearest_tree
from ...maths.radiance import composite
from ...maths.rays import points_along, sphere_span
from ...maths.surface_samples import surface_samples
from ...maths.volume import annealed_slope, log_transmittance_of_middles, log_transparency
from ..measurements import Measurements
from ..pixels import Pixels, rays_through
from .networks import NeuralSurface


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """How much is looked at in each step."""

    rays: int = 256
    uniform: int = 24
    """Edges of intervals on each ray to begin with."""
    rounds: int = 3
    """Of more edges where the surface seems to be."""
    per_round: int = 8
    point_queries: int = 512
    """Places around measured points; only where points have a weight."""


@dataclass(frozen=True, kw_only=True)
class Weights:
    """Of the losses beside that of colour, which is 1."""

    eikonal: float = 0.1
    silhouettes: float = 0.1
    """Of masks, where there are some."""
    points: float = 0.0
    """Of both Taylor residuals at the end of the run; they begin at a thousandth. 0 to leave points out."""
    at_query: float = 1.0
    """Of the residual with the query's own gradient, in units of the weight of points."""
    at_point: float = 1.0
    """Of that with the point's normal, in the same."""
    point_colours: float = 0.5
    """Of the albedo at points, in units of the weight of points; only where colour is split."""
    gloss: float = 0.01
    """Of the gloss's size, until 3/8 of the run; then it falls to 0. Only where colour is split."""


@dataclass(frozen=True, kw_only=True)
class Moment:
    """What changes in the course of a run."""

    done: float
    """Share of the run."""
    active: int
    """Levels of the hash grid that count."""
    width: float
    """Of the finest detail that the field can have, object units."""
    differenced: bool
    """Whether gradients are differences over twice that width, else derivatives."""
    annealed: float
    """0 to 1: how far the slope along rays is that of `annealed_slope`'s end."""
    sharpness: Float[Tensor, ""]


@dataclass(frozen=True, kw_only=True)
class MeasuredPoints:
    """Points within the unit sphere, to be drawn and searched."""

    positions: Float[Tensor, "points 3"]
    normals: Float[Tensor, "points 3"]
    colours: Float[Tensor, "points 3"]
    upto: Float[Tensor, "points"]
    """Summed share of confidence cubed: points are drawn by it, so that it need not weigh them."""
    tree: cKDTree


def measured_points(scene: Measurements) -> MeasuredPoints:
    """Those of the scene."""
    near = scene.positions.norm(dim=-1) <= 1
    summed = scene.confidence[near].double().pow(3).cumsum(0)
    positions = scene.positions[near]
    return MeasuredPoints(
        positions=positions,
        normals=scene.normals[near],
        colours=scene.colours[near],
        upto=summed / summed[-1],
        tree=nearest_tree(positions.cpu().numpy()),
    )


def _at(
    surface: NeuralSurface, points: Float[Tensor, "points 3"], moment: Moment
) -> tuple[Float[Tensor, "points"], Float[Tensor, "points 3"], Float[Tensor, "points features"]]:
    """Distance, its gradient in space, and features."""
    if not moment.differenced:
        points = points.detach().requires_grad_()
        distance, features = surface.distance(points, moment.active)
        return distance, analytic_gradient(distance, points), features
    distance, features = surface.distance(points, moment.active)
    gradient = central_gradient(lambda x: surface.distance(x, moment.active)[0], points, moment.width)
    return distance, gradient, features


def ray_loss(
    surface: NeuralSurface,
    background: Float[Tensor, "3"],
    scene: Measurements,
    pixels: Pixels,
    moment: Moment,
    sampling: Sampling,
    weights: Weights,
    generator: torch.Generator,
) -> Float[Tensor, ""]:
    """Of random pixels: difference of colour where the mask is, opacity against the mask, slope, gloss."""
    chosen = torch.randint(len(pixels.view), (sampling.rays,), generator=generator).to(pixels.view.device)
    origins, directions = rays_through(scene.cameras, pixels, chosen)
    edges = surface_samples(
        lambda x: surface.distance(x, moment.active)[0],
        origins,
        directions,
        sphere_span(origins, directions),
        uniform=sampling.uniform,
        rounds=sampling.rounds,
        per_round=sampling.per_round,
        generator=generator,
    )
    along = (edges[:, 1:] + edges[:, :-1]) / 2
    points = points_along(origins, directions, along).reshape(-1, 3)
    towards = directions[:, None].expand(*along.shape, 3).reshape(-1, 3)
    distance, gradient, features = _at(surface, points, moment)
    slope = annealed_slope((gradient * towards).sum(dim=-1).reshape(along.shape), moment.annealed)
    log_pass = log_transmittance_of_middles(distance.reshape(along.shape), slope, edges, moment.sharpness)
    seen = surface.seen(points, features, F.normalize(gradient, dim=-1, eps=1e-3), towards)
    rendered = composite(log_pass, seen.colour.reshape(*along.shape, 3), background[None])
    coverage = pixels.coverage[chosen]
    masked = ~coverage.isnan()
    trust = torch.where(masked, coverage, 1.0)
    difference = (rendered - pixels.colour[chosen]).abs().mean(dim=-1)
    loss = (trust * difference).sum() / trust.sum().clamp(min=1) + weights.eikonal * losses.eikonal(gradient)
    if masked.any():
        opacity = losses.silhouette(log_transparency(log_pass)[masked], coverage[masked])
        loss = loss + weights.silhouettes * opacity
    if seen.gloss is not None:
        fading = min(1.0, (1 - moment.done) / (1 - 3 / 8))
        loss = loss + weights.gloss * fading * seen.gloss.abs().mean()
    return loss


def point_loss(
    surface: NeuralSurface,
    measured: MeasuredPoints,
    moment: Moment,
    sampling: Sampling,
    weights: Weights,
    generator: torch.Generator,
) -> Float[Tensor, ""]:
    """SparseCraft's losses at places q about half the finest detail away from points; p is q's nearest point.

    |f(q) + grad f(q) . (p - q)| and |f(q) - |grad f(p)| n(p) . (q - p)|, in the form of its project page; and
    the albedo's difference from the photographs' colour at p.
    """
    count, device = sampling.point_queries, measured.positions.device
    lot = torch.rand(count, generator=generator, dtype=torch.float64).to(device)
    around = measured.positions[torch.searchsorted(measured.upto, lot).clamp(max=len(measured.upto) - 1)]
    q = (around + 0.5 * moment.width * torch.randn((count, 3), generator=generator).to(device)).clamp(-1, 1)
    nearest = torch.tensor(measured.tree.query(q.cpu().numpy())[1], device=device)
    p = measured.positions[nearest]
    value, gradient, features = _at(surface, torch.cat([q, p]), moment)
    at_query = losses.taylor_at_query(value[:count], gradient[:count], p - q)
    normal = losses.length(gradient[count:])[:, None] * measured.normals[nearest]
    at_point = losses.taylor_at_point(value[:count], normal, p - q)
    loss = (weights.at_query * at_query.abs() + weights.at_point * at_point.abs()).mean()
    if surface.albedo is not None:
        albedo = torch.sigmoid(surface.all_round(p, features[count:]))
        loss = loss + weights.point_colours * (albedo - measured.colours[nearest]).abs().mean()
    return weights.points * (1e-3 + (1 - 1e-3) * moment.done) * loss
