"""NeuS and SparseCraft, for comparison: a network of distance learned by rendering, or with points as well.

NeuS (Wang et al., NeurIPS 2021) has a positional encoding, normals by differentiation, and colours of
everything at once. SparseCraft (Younes et al., ECCV 2024) has a hash grid whose levels join one by one,
normals by differences as wide as a cell of the last one, Taylor losses at measured points, and colours split
into albedo and gloss. One config makes either; what differs from the published programs is in docs/method.md.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...maths.hash_grid import level_cells
from ...maths.rays import DistanceFunction
from ...scene import Decision, Progress, Region, StereoResult, View
from ..deadline import Clock, Deadline, GridCost, deadline_after, predicted_s
from ..measurements import Measurements, measurements
from ..pixels import pixels_of_unit_sphere
from ..safe_steps import OTHER_PHOTOS, SafeSteps
from ..surface import COARSEST, ShowSurface, Surface, show_nothing
from .field_surface import field_surface, surface_in
from .networks import NetworkConfig, NeuralSurface
from .neus_losses import Moment, Sampling, Weights, measured_points, point_loss, ray_loss

_SOFTEST, _SHARPEST = math.log(10.0), math.log(2048.0)
"""Logs of the sharpness, 1 / object unit. What is sharper than samples are dense gets no gradient."""
_ALL_LEVELS_AT = 0.78
"""Share of a run after which all levels of a hash grid count: 3100 of 4000 steps."""
_LONGEST = 10.0
"""Length that gradients are cut to."""
_SHOWN = 10
"""How often the unfinished surface is shown."""


@dataclass(frozen=True, kw_only=True)
class NeusConfig:
    """How long, how large, and which of the two."""

    steps: int = 2000
    network: NetworkConfig = field(default_factory=NetworkConfig)
    sampling: Sampling = field(default_factory=Sampling)
    weights: Weights = field(default_factory=Weights)
    learning_rate: float = 2e-3
    sharpness_rate: float = 1e-2
    """Of the log of the sharpness."""
    warm_up: float = 1 / 60
    """Share of the run in which steps grow."""
    constant: float = 0.0
    """Share of the run until which steps stay as they are; then they shrink."""
    last_rate: float = 0.05
    """What is left of the size of steps at the end."""
    exponential: bool = False
    """Whether they shrink by the same factor everywhere, else by a cosine."""
    slope_annealed_at: float = 1 / 6
    """Share of the run after which surface seen from behind absorbs no more."""
    nodes: int = 128
    """Along each axis of the grid that the result is sampled on."""
    budget_s: float | None = None
    """Time for the whole stage; it ends earlier when all steps are done. None for no limit: then the result
    does not depend on the clock."""


class _Model(torch.nn.Module):
    """All that is learned."""

    def __init__(self, config: NetworkConfig, generator: torch.Generator) -> None:
        super().__init__()
        self.surface = NeuralSurface(config, generator)
        self.log_sharpness = torch.nn.Parameter(torch.tensor(3.0))
        """10 times the published variance of 0.3."""
        self.background = torch.nn.Parameter(torch.zeros(3))
        """Logits of the colour behind everything."""

    def distance(self, active: int) -> DistanceFunction:
        """The distance alone."""
        return lambda points: self.surface.distance(points, active)[0]


def fit_neus(
    views: tuple[View, ...],
    region: Region,
    stereo: StereoResult,
    config: NeusConfig,
    *,
    device: torch.device,
    generator: torch.Generator,
    progress: Progress,
    show: ShowSurface = show_nothing,
    clock: Clock = time.perf_counter,
) -> Surface:
    """The learned distance on a grid laid tightly around its zero level.

    A step whose loss or gradient is not finite is taken back; a decision says how many there were.
    Raises ReconstructionError(NO_SURFACE) if that happens again and again, or nothing is inside.
    """
    deadline = deadline_after(config.budget_s, clock)
    progress(0.0, "making networks")
    scene = measurements(views, region, stereo, device)
    model = _Model(config.network, generator).to(device)
    look = partial(surface_in, region=region, frame_from_object=np.eye(4), nodes=COARSEST, device=device)
    began_s = clock()
    show(look(model.distance(active_levels(config.network, 1.0))))
    sampled = GridCost(nodes=COARSEST, seconds=clock() - began_s)
    learning = replace(deadline, at_s=deadline.at_s - predicted_s([sampled], config.nodes))
    steps = _learn(model, scene, config, generator, progress, learning, lambda distance: show(look(distance)))
    steps.raise_if_nothing_was_learned("the photographs", OTHER_PHOTOS)
    progress(1.0, f"sampling the distance on {config.nodes}^3")
    distance = model.distance(active_levels(config.network, 1.0))
    surface = field_surface(distance, region, config.nodes, device)
    made = _decisions(model, scene, config, steps)
    if config.budget_s is not None:
        used_s = config.budget_s - deadline.left_s()
        made = (*made, _of_budget(config, steps.steps, used_s))
    return replace(surface, decisions=made)


def _learn(
    model: _Model,
    scene: Measurements,
    config: NeusConfig,
    generator: torch.Generator,
    progress: Progress,
    deadline: Deadline,
    show: Callable[[DistanceFunction], None],
) -> SafeSteps:
    """Take steps until all are taken, the time is over, or there is no hope."""
    pixels = pixels_of_unit_sphere(scene)
    measured = measured_points(scene) if config.weights.points else None
    optimiser = torch.optim.Adam(
        [
            {"params": [*model.surface.parameters(), model.background], "lr": config.learning_rate},
            {"params": [model.log_sharpness], "lr": config.sharpness_rate},
        ],
        betas=(0.9, 0.99),
        eps=1e-12,
    )
    safe = SafeSteps(optimiser, longest=_LONGEST)
    began_s = deadline.clock()
    done = 0.0
    while done < 1 and not safe.hopeless:
        if safe.steps % 10 == 0:
            progress(done, f"step {safe.steps} of {config.steps}")
            safe.keep()
        moment = _moment(config, done, model.log_sharpness.exp())
        background = torch.sigmoid(model.background)
        loss = ray_loss(
            model.surface, background, scene, pixels, moment, config.sampling, config.weights, generator
        )
        if measured is not None:
            loss = loss + point_loss(
                model.surface, measured, moment, config.sampling, config.weights, generator
            )
        safe.take(loss, rate_share(config, done))
        with torch.no_grad():
            model.log_sharpness.clamp_(_SOFTEST, _SHARPEST)
        before, done = done, max(safe.steps / config.steps, deadline.share_gone(began_s))
        if int(before * _SHOWN) < int(done * _SHOWN) < _SHOWN:
            show(model.distance(moment.active))
    return safe


def _moment(config: NeusConfig, done: float, sharpness: Float[Tensor, ""]) -> Moment:
    """Where the run stands."""
    active = active_levels(config.network, done)
    return Moment(
        done=done,
        active=active,
        width=finest_detail(config.network, active),
        differenced=active > 0,
        annealed=min(1.0, done / config.slope_annealed_at),
        sharpness=sharpness,
    )


def active_levels(config: NetworkConfig, done: float) -> int:
    """Levels of the hash grid that count after a share of the run; 0 where there is none."""
    levels = 0 if config.hash_grid is None else config.hash_grid.levels
    return min(levels, 1 + int(done / _ALL_LEVELS_AT * levels))


def rate_share(config: NeusConfig, done: float) -> float:
    """Size of steps: grows at first, then is constant, then falls to `last_rate`."""
    grown = min(1.0, 0.01 + done / config.warm_up) if config.warm_up else 1.0
    falling = max(0.0, done - config.constant) / (1 - config.constant)
    if config.exponential:
        return float(grown * config.last_rate**falling)
    return grown * (config.last_rate + (1 - config.last_rate) * 0.5 * (1 + math.cos(math.pi * falling)))


def finest_detail(config: NetworkConfig, active: int) -> float:
    """Width of a cell of the last active level of the hash grid, or half the shortest wave; object units."""
    grid = config.hash_grid
    if grid is None:
        return config.longest_wave / 2.0**config.frequencies
    return 2.0 / level_cells(grid.levels, grid.coarsest, grid.finest)[active - 1]


def _decisions(
    model: _Model, scene: Measurements, config: NeusConfig, steps: SafeSteps
) -> tuple[Decision, ...]:
    """What was modelled, with what it was decided by."""
    masks = sum(mask is not None for mask in scene.masks)
    network, grid = config.network, config.network.hash_grid
    return (
        Decision(
            what="method",
            choice="NeuS" if grid is None else "SparseCraft",
            because="the preset; for comparison, slower than the default. The distance has "
            f"{network.layers} hidden layers of {network.width}",
        ),
        Decision(
            what="silhouettes",
            choice="used" if masks else "left out",
            because=f"{masks} of {len(scene.masks)} photographs have masks",
        ),
        Decision(
            what="background",
            choice="one learned colour",
            because="what is behind the region is not modelled; masks, where there are some, cut it off",
        ),
        Decision(
            what="refinement by rendering",
            choice=f"{steps.steps} steps of {config.sampling.rays} rays{steps.told}",
            because=f"the sharpness reached {model.log_sharpness.exp().item():.0f} per region's radius",
        ),
    )


def _of_budget(config: NeusConfig, steps: int, used_s: float) -> Decision:
    """What the time was enough for."""
    all_steps = steps == config.steps
    choice = "all that the preset asks for" if all_steps else f"stopped after {steps} of {config.steps} steps"
    return Decision(what="budget", choice=choice, because=f"{config.budget_s:g} s given, {used_s:.1f} s used")
