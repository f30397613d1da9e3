"""The signed distance field: started from points and silhouettes, refined by volume rendering.

Level by level on finer grids: first the smoothest field that agrees with the stereo points (first
order), with free space and with the level before (linear_fit); then gradient steps on rays through
the photographs (render_fit).
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor

from ..errors import ErrorCode, ReconstructionError
from ..maths.grid import refined, spacing
from ..scene import Decision, Progress, Region, View, to_unit_sphere
from .linear_fit import fit_level, start, widest_angle_deg
from .measurements import Measurements, measurements
from .render_fit import RenderConfig, refine
from .stereo import StereoResult

COARSEST = 48
"""Nodes along each axis of the grid that finds the surface's extent."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """How fine and how long."""

    levels: tuple[int, ...] = (32, 64, 128)
    """Nodes along each axis of the grids, coarse to fine."""
    steps: tuple[int, ...] = (0, 0, 100)
    """Gradient steps at each level."""
    smoothness: float = 0.1
    """Weight of the squared Laplacian in the linear fit."""
    render: RenderConfig = field(default_factory=RenderConfig)


@dataclass(frozen=True, kw_only=True)
class Surface:
    """The field at its finest level."""

    distance: Float32[np.ndarray, "nodes nodes nodes"]
    """Signed, on nodes over the cube [-1, 1]^3 of the grid frame and in its units; > 0 outside."""
    grid_from_world: Float64[np.ndarray, "4 4"]
    """A similarity: the cube is laid tightly around the surface."""
    decisions: tuple[Decision, ...] = ()


ShowSurface = Callable[[Surface], None]
"""Called with the field as it is so far; must not change it."""


def show_nothing(_surface: Surface) -> None:
    """A callback for those who do not want to look at unfinished surfaces."""


def fit_surface(
    views: tuple[View, ...],
    region: Region,
    stereo: StereoResult,
    config: TrainConfig,
    *,
    device: torch.device,
    generator: torch.Generator,
    progress: Progress,
    show: ShowSurface = show_nothing,
) -> Surface:
    """The distance field that agrees with points, silhouettes and photographs.

    `show` gets the field each time the points are fitted on a finer grid, before any steps of rendering.
    """
    progress(0.0, "finding the extent of the surface")
    with torch.no_grad():
        scene = measurements(views, region, region, stereo, device)
        distance = fit_level(scene, start(scene, COARSEST), config.smoothness)
        frame = _tight_frame(distance, region)
        scene = measurements(views, region, frame, stereo, device)
        distance = start(scene, config.levels[0])
    total = sum(config.steps) + 10 * len(config.levels)
    done = 0
    for nodes, steps in zip(config.levels, config.steps, strict=True):
        progress(done / total, f"fitting points on a grid of {nodes}^3")
        with torch.no_grad():
            distance = fit_level(scene, refined(distance, nodes), config.smoothness)
        done += 10
        show(Surface(distance=distance.cpu().numpy(), grid_from_world=frame.object_from_world))
        if steps:
            tell = _within(progress, done / total, (done + steps) / total)
            distance = refine(scene, distance, steps, config.render, generator, tell)
            done += steps
    return Surface(
        distance=distance.cpu().numpy(),
        grid_from_world=frame.object_from_world,
        decisions=_decisions(scene, frame, config),
    )


def _decisions(scene: Measurements, frame: Region, config: TrainConfig) -> tuple[Decision, ...]:
    """What was modelled and what was left out, with the measurement behind it."""
    masks = sum(outline is not None for outline in scene.outlines)
    backdrops = sum(backdrop is not None for backdrop in scene.backdrops)
    angle_deg = widest_angle_deg(scene)
    cell = spacing(config.levels[-1]) * frame.radius_world
    made = [
        Decision(
            what="grid",
            choice=f"{config.levels[-1]} nodes along each side of a cube around the surface",
            because=f"the preset; a cell is {cell:.3g} wide in the cameras' units",
        ),
        Decision(
            what="silhouettes",
            choice="used" if masks or backdrops else "left out",
            because=f"{masks} photographs have masks, {backdrops} an even backdrop",
        ),
        Decision(
            what="depth of the unseen side",
            choice="as deep as wide" if angle_deg > 90 else "continued from the measured curvature",
            because=f"the photographs are taken from sides up to {angle_deg:.0f} degrees apart",
        ),
        Decision(what="background", choice="left out", because="rays that miss the subject are not rendered"),
        Decision(
            what="refinement by rendering",
            choice=f"{sum(config.steps)} steps" if sum(config.steps) else "left out",
            because="the preset",
        ),
    ]
    return tuple(made)


def _within(progress: Progress, first: float, last: float) -> Progress:
    return lambda fraction, text: progress(first + (last - first) * fraction, text)


def _tight_frame(distance: Float[Tensor, "nodes nodes nodes"], region: Region) -> Region:
    """The cube around the inside of a coarse field, as the unit cube of a frame of its own.

    Raises ReconstructionError(NO_SURFACE) if there is no inside.
    """
    inside = torch.nonzero(distance < 0).float() * spacing(COARSEST) - 1
    if not len(inside):
        raise ReconstructionError(
            ErrorCode.NO_SURFACE,
            "No surface was found in the region.",
            "Check that the photographs show the same thing, and that masks, if any, are white on it.",
        )
    low, high = inside.amin(dim=0), inside.amax(dim=0)
    half = float((high - low).max()) / 2 + 2.5 * spacing(COARSEST)
    centre = ((low + high) / 2).cpu().double().numpy()
    frame_from_object = to_unit_sphere(centre, half)
    return Region(object_from_world=frame_from_object @ region.object_from_world)
