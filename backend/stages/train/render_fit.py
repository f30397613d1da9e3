"""The rendering part of the fit: gradient steps on rays through the photographs and on measured points.

Rays are searched in the field itself, so that samples lie on the surface's two sides and empty space
costs nothing.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ...maths import losses
from ...maths.grid import laplacian_at, spacing, splat
from ...maths.radiance import mean_colour
from ...maths.rays import first_crossing, points_along, sphere_entry
from ...maths.volume import log_transmittance, log_transparency
from ...scene import Progress
from ..deadline import Deadline
from ..measurements import Measurements
from ..pixels import Pixels, rays_through, worthy_pixels
from ..safe_steps import SafeSteps
from .field import SurfaceField


@dataclass(frozen=True, kw_only=True)
class RenderConfig:
    """How much is sampled in each step."""

    rays: int = 1024
    edges: int = 9
    """Edges of the intervals on each ray."""
    point_queries: int = 4096
    at_query: float = 1.0
    """Weight of the Taylor residual with the query's own gradient."""
    at_point: float = 1.0
    """Of that with the point's normal."""


@dataclass(frozen=True, kw_only=True)
class Refined:
    """A field after gradient steps."""

    distance: Float[Tensor, "nodes nodes nodes"]
    steps: int
    """How many were tried; 0 where the field is what it was before them."""
    taken_back: int
    """How many of those tried had a loss or a gradient that is not finite."""


def refine(
    scene: Measurements,
    distance: Float[Tensor, "nodes nodes nodes"],
    steps: int,
    config: RenderConfig,
    generator: torch.Generator,
    progress: Progress,
    deadline: Deadline,
) -> Refined:
    """The field after at most `steps`, and none after the deadline.

    Step sizes shrink with the share that is done, of the steps or of the time, whichever ends first. After
    too many steps that are not finite the field is what it was before the first.
    """
    field = SurfaceField(distance, band_cells=4, channels=6, view_dependent=False, generator=generator)
    _colour_from_points(field, scene)
    pixels = worthy_pixels(scene)
    h = spacing(field.nodes)
    optimiser = torch.optim.Adam(
        [
            {"params": [field.distances], "lr": 0.015 * h},
            {"params": [field.features], "lr": 0.02},
            {"params": [field.first, field.first_bias, field.last, field.last_bias], "lr": 0.01},
        ],
        betas=(0.9, 0.99),
        eps=1e-12,
    )
    began_s = deadline.clock()
    step, done = 0, 0.0
    safe = SafeSteps(optimiser)
    while done < 1 and not safe.hopeless:
        if step % 10 == 0:
            progress(done, f"rendering at {field.nodes}^3, step {step} of {steps}")
            safe.keep()
            whole = field.whole()
        sharpness = 1 / (h * (1.0 - 0.5 * done))
        loss = _ray_loss(field, whole, scene, pixels, sharpness, config, generator)
        loss = loss + _point_loss(field, scene, config, generator) + _shape_loss(field, generator)
        safe.take(loss, 0.1**done)
        step += 1
        done = max(step / steps, deadline.share_gone(began_s))
    if safe.hopeless:
        return Refined(distance=distance, steps=0, taken_back=safe.taken_back)
    return Refined(distance=field.whole(), steps=step, taken_back=safe.taken_back)


def _colour_from_points(field: SurfaceField, scene: Measurements) -> None:
    """Start the features' colour logits at the stereo points' colours."""
    weight = scene.confidence[:, None]
    sums = splat(
        torch.cat([scene.colours * weight, weight], dim=-1), field.locate(scene.positions), field.nodes
    )
    mean = (scene.colours * weight).sum(dim=0) / weight.sum()
    colour = (sums[:, :3] + 1e-3 * mean) / (sums[:, 3:] + 1e-3)
    with torch.no_grad():
        field.features[:, :3] = torch.logit(colour[field.active].clamp(0.02, 0.98))


def _ray_loss(
    field: SurfaceField,
    whole: Float[Tensor, "nodes nodes nodes"],
    scene: Measurements,
    pixels: Pixels,
    sharpness: float,
    config: RenderConfig,
    generator: torch.Generator,
) -> Float[Tensor, ""]:
    """Difference between rendered and photographed colours, and between opacity and masks."""
    chosen = torch.randint(len(pixels.view), (config.rays,), generator=generator).to(pixels.view.device)
    origins, directions = rays_through(scene.cameras, pixels, chosen)
    with torch.no_grad():
        entry = sphere_entry(origins, directions)
        crossing = first_crossing(whole, origins, directions, entry)
    h = spacing(field.nodes)
    spread = torch.linspace(-3, 3, config.edges, device=origins.device)
    jitter = torch.rand((config.rays, 1), generator=generator).to(origins.device) - 0.5
    along = crossing.along[:, None] + h * (spread + jitter * (spread[1] - spread[0]))
    points = points_along(origins, directions, along)
    distances = field.distance(field.locate(points.reshape(-1, 3))).reshape(along.shape)
    log_pass = log_transmittance(distances, sharpness)

    middles = (points[:, 1:] + points[:, :-1]) / 2
    corners = field.locate(middles.reshape(-1, 3))
    _, gradient = field.distance_and_gradient(corners)
    normal = F.normalize(gradient, dim=-1, eps=1e-3)
    towards = directions[:, None].expand_as(middles).reshape(-1, 3)
    colour = field.colour(corners, normal, towards).reshape(*middles.shape)
    rendered = mean_colour(log_pass, colour)
    log_clear = log_transparency(log_pass)
    opacity = -torch.expm1(log_clear.detach())
    coverage = pixels.coverage[chosen]
    masked = ~coverage.isnan()
    trust = torch.where(masked, coverage, 1.0) * opacity * crossing.hit
    difference = losses.charbonnier(rendered - pixels.colour[chosen], 0.02).mean(dim=-1)
    loss = (trust * difference).mean() + 0.1 * losses.eikonal(gradient)
    if masked.any():
        loss = loss + 0.1 * losses.silhouette(log_clear[masked], coverage[masked])
    return loss


def _point_loss(
    field: SurfaceField, scene: Measurements, config: RenderConfig, generator: torch.Generator
) -> Float[Tensor, ""]:
    """Both Taylor residuals at queries around the points, in cells."""
    device = scene.positions.device
    h = spacing(field.nodes)
    chosen = torch.randint(len(scene.positions), (config.point_queries,), generator=generator).to(device)
    noise = torch.randn((config.point_queries, 3), generator=generator).to(device)
    p = scene.positions[chosen]
    q = p + 0.5 * h * noise
    value, gradient = field.distance_and_gradient(field.locate(q))
    at_query = losses.taylor_at_query(value, gradient, p - q)
    at_point = losses.taylor_at_point(value, scene.normals[chosen], p - q)
    both = config.at_query * losses.charbonnier(at_query / h, 0.5)
    both = both + config.at_point * losses.charbonnier(at_point / h, 0.5)
    return (scene.confidence[chosen] ** 3 * both).mean()


def _shape_loss(field: SurfaceField, generator: torch.Generator) -> Float[Tensor, ""]:
    """Squared Laplacian, at random nodes near the surface and in cells, of what the steps have changed.

    Not of the field itself, which is as smooth as the points allow and would lose what they say of it.
    """
    chosen = torch.randint(len(field.active), (8192,), generator=generator).to(field.active.device)
    bent = laplacian_at(field.change, field.active[chosen], field.nodes)
    return 5.0 * (bent / spacing(field.nodes)).square().mean()
