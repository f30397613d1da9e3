"""A radiance field fitted to photographs (NeRF), and the mesh's surface at a level of its density.

For comparison with surfaces: nothing here knows of distances, normals or measured points. Masked photographs
are laid before another colour at every ray, so that what is not the subject has to be empty; others get one
colour behind the unit sphere, which is learned.
"""

import math
import time
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ...errors import ErrorCode, ReconstructionError
from ...maths.grid import spacing
from ...maths.radiance import composite, proposal_loss, weight_bound
from ...maths.volume import blending_weights
from ...scene import Decision, Progress, Region, StereoResult, View
from ..deadline import PESSIMISM, Clock, deadline_after
from ..measurements import Measurements, measurements
from ..pixels import Pixels, pixels_of_unit_sphere, rays_through
from ..radiance import RadianceShape
from ..safe_steps import OTHER_PHOTOS, SafeSteps
from ..surface import COARSEST, ShowSurface, Surface, show_nothing
from .field_surface import field_surface
from .radiance_field import RadianceField, RaySamples, kept, sample_rays

_FIRST_RATE, _LAST_RATE = 1e-2, 1e-3
"""Of Adam's steps."""
_WARM_UP_STEPS = 50
_ALL_WAVES_AT = 0.7
"""Share of the work after which every wave of the encoding counts; until then they come one by one."""
_RAYS_FOR_LEVEL = 4096
_POINTS_TIMED = 2**14
"""Of the field, to foretell what the grid will take."""
_LEAST_DENSITY = 1e-6
"""Per object unit: as good as none."""


@dataclass(frozen=True, kw_only=True)
class RadianceConfig:
    """How large and how long."""

    shape: RadianceShape = field(default_factory=RadianceShape)
    steps: int = 10_000
    rays: int = 256
    """In each step."""
    nodes: int = 128
    """Along each axis of the grid that the mesh is taken from."""
    budget_s: float | None = None
    """Time for the whole stage; None for all steps: then the result does not depend on the clock."""


def fit_radiance(
    views: tuple[View, ...],
    region: Region,
    stereo: StereoResult,
    config: RadianceConfig,
    *,
    device: torch.device,
    generator: torch.Generator,
    progress: Progress,
    show: ShowSurface = show_nothing,
    clock: Clock = time.perf_counter,
) -> Surface:
    """The density's level as a surface, with the field itself to render from.

    Stereo is not looked at. Raises ReconstructionError(NO_SURFACE) where the field is empty, or where steps
    led to numbers that are not finite again and again.
    """
    deadline = deadline_after(config.budget_s, clock)
    scene = measurements(views, region, stereo, device)
    pixels = pixels_of_unit_sphere(scene)
    radiance = RadianceField(config.shape, generator).to(device)
    backdrop = _Backdrop(pixels).to(device)
    optimiser = torch.optim.Adam(
        [*radiance.parameters(), *backdrop.parameters()], lr=_FIRST_RATE, betas=(0.9, 0.99), eps=1e-12
    )
    began_s = clock()
    radiance.density_and_features(torch.zeros((_POINTS_TIMED, 3), device=device))
    grid_s = PESSIMISM * (clock() - began_s) * (config.nodes**3 + COARSEST**3) / _POINTS_TIMED
    began_s = clock()
    steps_end = replace(deadline, at_s=deadline.at_s - min(grid_s, deadline.left_s() / 2))
    done = 0.0
    safe = SafeSteps(optimiser)
    while done < 1 and not safe.hopeless:
        if safe.steps % 10 == 0:
            progress(0.95 * done, f"fitting a radiance field, step {safe.steps} of {config.steps}")
            safe.keep()
        radiance.open_waves(done / _ALL_WAVES_AT)
        loss = _loss(radiance, backdrop, scene, pixels, config.rays, generator)
        grown = min(1.0, (safe.steps + 1) / _WARM_UP_STEPS)
        safe.take(loss, grown * (_LAST_RATE / _FIRST_RATE) ** done)
        done = max(safe.steps / config.steps, steps_end.share_gone(began_s))
    safe.raise_if_nothing_was_learned("the photographs", OTHER_PHOTOS)
    radiance.open_waves(1.0)
    progress(0.95, "density on a grid")
    level = _level(radiance, scene, pixels)
    surface = _level_surface(radiance, level, region, config.nodes, device)
    show(surface)
    return Surface(
        distance=surface.distance,
        grid_from_world=surface.grid_from_world,
        radiance=kept(radiance, region, backdrop.learned_srgb()),
        decisions=_decisions(config, backdrop, safe, level),
    )


class _Backdrop(nn.Module):
    """What is behind the unit sphere: another colour for every ray where a mask is, else a learned one."""

    def __init__(self, pixels: Pixels) -> None:
        super().__init__()
        self.num_masked = len(torch.unique(pixels.view[~pixels.coverage.isnan()]))
        self.num_views = len(torch.unique(pixels.view))
        unmasked = pixels.colour[pixels.coverage.isnan()]
        mean = unmasked.nanmean(dim=0) if len(unmasked) else pixels.colour.new_full((3,), 0.5)
        self.logit = nn.Parameter(torch.logit(mean.clamp(0.02, 0.98)))

    def learned_srgb(self) -> Float[Tensor, "3"] | None:
        """None where every photograph has a mask."""
        return None if self.num_masked == self.num_views else torch.sigmoid(self.logit.detach())


def _loss(
    radiance: RadianceField,
    backdrop: _Backdrop,
    scene: Measurements,
    pixels: Pixels,
    rays: int,
    generator: torch.Generator,
) -> Float[Tensor, ""]:
    """Mean squared difference of colours, and what the proposal leaves out."""
    device = pixels.view.device
    chosen = torch.randint(len(pixels.view), (rays,), generator=generator, device=generator.device).to(device)
    samples = sample_rays(radiance, *rays_through(scene.cameras, pixels, chosen), generator)
    drawn = torch.rand((rays, 3), generator=generator, device=generator.device).to(device)
    coverage, colour = pixels.coverage[chosen, None], pixels.colour[chosen]
    masked = ~coverage.isnan()
    behind = torch.where(masked, drawn, torch.sigmoid(backdrop.logit))
    wanted = torch.where(masked, coverage * colour + (1 - coverage) * drawn, colour)
    seen = composite(samples.log_pass, samples.colour, behind)
    return (seen - wanted).square().mean() + _proposal_loss(samples)


def _proposal_loss(samples: RaySamples) -> Float[Tensor, ""]:
    bound = weight_bound(samples.edges, samples.proposal_edges, samples.proposal_weights)
    return proposal_loss(blending_weights(samples.log_pass), bound)


def half_light_density(samples: RaySamples) -> Float[Tensor, "opaque"]:
    """Density where a ray has lost half of its light, for the rays that do."""
    lost = -samples.log_pass.cumsum(dim=-1)
    opaque = lost[:, -1] > math.log(2)
    interval = (lost[opaque] > math.log(2)).long().argmax(dim=-1, keepdim=True)
    density = -samples.log_pass[opaque].gather(-1, interval)
    return (density / samples.edges[opaque].diff(dim=-1).gather(-1, interval))[:, 0]


def _level(radiance: RadianceField, scene: Measurements, pixels: Pixels) -> float:
    """Density that rays through the photographs meet, in the median, where half of their light is lost.

    Raises ReconstructionError(NO_SURFACE) where none loses as much.
    """
    device = pixels.view.device
    chosen = torch.linspace(0, len(pixels.view) - 1, _RAYS_FOR_LEVEL, device=device).long()
    with torch.no_grad():
        found = half_light_density(sample_rays(radiance, *rays_through(scene.cameras, pixels, chosen), None))
    if not len(found):
        raise ReconstructionError(
            ErrorCode.NO_SURFACE,
            "The radiance field is empty: no ray loses half of its light in it.",
            "Check that the photographs show the same thing, and that masks, if any, are white on it.",
        )
    return float(found.median())


def _level_surface(
    radiance: RadianceField, level: float, region: Region, nodes: int, device: torch.device
) -> Surface:
    """The level of the density as the zero level of log(level / density), in cells of the region.

    Density near a surface changes by powers of ten between nodes: its logarithm is more nearly linear there.
    """

    def pseudo_distance(points: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        density, _ = radiance.density_and_features(points)
        return spacing(nodes) * (math.log(level) - density.clamp(min=_LEAST_DENSITY).log())

    return field_surface(pseudo_distance, region, nodes, device)


def _decisions(
    config: RadianceConfig, backdrop: _Backdrop, safe: SafeSteps, level: float
) -> tuple[Decision, ...]:
    masked, views = backdrop.num_masked, backdrop.num_views
    colour = backdrop.learned_srgb()
    learned = "" if colour is None else " ".join(f"{round(255 * float(part))}" for part in colour)
    return (
        Decision(
            what="field",
            choice=f"density and radiance, {safe.steps} of {config.steps} steps of {config.rays} rays"
            + safe.told,
            because="the preset asks for it" if config.budget_s is None else f"{config.budget_s:g} s given",
        ),
        Decision(
            what="background",
            choice="nothing, as the masks say" if colour is None else f"one learned colour, sRGB {learned}",
            because=f"{masked} of {views} photographs have masks",
        ),
        Decision(
            what="surface",
            choice=f"density {level:.3g} per radius of the region, where rays have lost half of their light",
            because="a density has no surface of its own: the level that is chosen moves the mesh, and "
            "nothing asks the density to be thin or smooth there. So the mesh is rougher and less true than "
            "that of a signed distance; this preset is for comparison, and for rendering",
        ),
    )
