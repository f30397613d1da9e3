"""The signed distance field: started from points and silhouettes, refined by volume rendering.

Level by level on finer grids: first the smoothest field that agrees with the stereo points (first
order), with free space and with the level before (linear_fit); then gradient steps on rays through
the photographs (render_fit).
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from ...maths.grid import refined, spacing
from ...scene import Decision, Progress, Region, StereoResult, View, within
from ..deadline import PESSIMISM, Clock, Deadline, GridCost, deadline_after, finest_grid, predicted_s
from ..measurements import Measurements, carried, measurements
from ..safe_steps import not_finite
from ..surface import COARSEST, ShowSurface, Surface, show_nothing, tight_frame
from .detail import add_detail
from .flat_faces import FlatFaces, flat_faces, no_faces
from .inner_outlines import FarSide, decision, far_sides
from .linear_fit import LinearConfig, fit_level, start
from .looks import Looks
from .render_fit import RenderConfig, refine
from .unseen_depth import depth_behind

_STEPS_OF_GRID = 10
"""Of rendering, that fitting points on a grid counts as long as: so progress is told."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """How fine and how long."""

    levels: tuple[int, ...] = (32, 64, 128)
    """Nodes along each axis of the grids, coarse to fine."""
    steps: tuple[int, ...] = (0, 0, 0)
    """Gradient steps at each level."""
    rounds: tuple[int, ...] = (15, 15, 10)
    """How often the linear fit asks at each level which inequalities are broken."""
    looks: tuple[int, int, int] = (0, 6, 2)
    """Before how many of the last rounds it asks what brightness tells, if patches are mostly silent:
    on the first grid, on those between, on the last one."""
    detail: int = 256
    """Nodes along each axis of the grid that what stereo measured is put on in the end, at most."""
    linear: LinearConfig = field(default_factory=LinearConfig)
    render: RenderConfig = field(default_factory=RenderConfig)
    budget_s: float | None = None
    """Time for the whole stage; it ends earlier when all else here is done. None for no limit: then the
    result does not depend on the clock."""


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
    clock: Clock = time.perf_counter,
) -> Surface:
    """The distance field that agrees with points, silhouettes and photographs.

    `show` gets the field each time the points are fitted on a finer grid, before any steps of rendering.
    With a budget the coarsest level is always done, and a later one only as fine as is predicted to fit.
    """
    deadline = deadline_after(config.budget_s, clock)
    progress(0.0, "finding the extent of the surface")
    with torch.no_grad():
        extent = _extent(measurements(views, region, stereo, device), views, region, config, clock)
    looks = Looks(scene=extent.scene, linear=config.linear, deadline=deadline)
    detail_from = 1 - _STEPS_OF_GRID / (_steps_of_grids(config) + _STEPS_OF_GRID)
    tell = within(progress, 0.0, detail_from)
    fit = _coarse_to_fine(extent, config, looks, generator=generator, progress=tell, show=show)
    progress(detail_from, "detail")
    with torch.no_grad():
        there_is_time = partial(_in_time, fit.costs[-1], config.rounds[-1], deadline)
        detailed, of_detail = add_detail(
            extent.scene, fit.distance, config.detail, config.linear, there_is_time
        )
    return Surface(
        distance=detailed.cpu().numpy(),
        grid_from_world=extent.frame.object_from_world,
        reach_cells=spacing(len(fit.distance)) / spacing(len(detailed)),
        decisions=(
            *_decisions(extent, config, fit),
            of_detail,
            extent.faces.decision,
            decision(fit.far),
            *looks.decisions,
            _of_rendering(config, fit),
            *_of_budget(config, fit, deadline),
        ),
    )


@dataclass(frozen=True, kw_only=True)
class _Extent:
    """Where the surface lies, by a coarse fit, and what was measured of it."""

    scene: Measurements
    """In a cube that lies tightly around the surface, flat faces among the points."""
    frame: Region
    """That cube's sphere."""
    radius: float
    """Of the ball behind what is seen."""
    depth: Decision
    """How that was found."""
    faces: FlatFaces
    cost: GridCost


def _extent(
    scene: Measurements, views: tuple[View, ...], region: Region, config: TrainConfig, clock: Clock
) -> _Extent:
    radius, depth = depth_behind(scene, config.linear)
    began_s = clock()
    distance = fit_level(scene, start(scene, radius, COARSEST), radius, config.rounds[0], config.linear)
    frame_from_object = tight_frame(distance)
    cost = GridCost(nodes=COARSEST, seconds=clock() - began_s)
    scene = carried(scene, views, region, frame_from_object)
    faces = flat_faces(scene) if config.linear.flat_faces else no_faces(scene)
    return _Extent(
        scene=faces.beside(scene),
        frame=region.part(frame_from_object),
        radius=radius,
        depth=depth,
        faces=faces,
        cost=cost,
    )


@dataclass(frozen=True, kw_only=True)
class _Fit:
    """The field on the finest grid that there was time for, and how it came about."""

    distance: Float[Tensor, "nodes nodes nodes"]
    costs: Sequence[GridCost]
    """Of all grids, that of the extent first."""
    far: Sequence[FarSide]
    """What was found behind bridges."""
    rendered: int
    """Gradient steps."""
    taken_back: int
    """Of these, how many led to what is no number."""


def _coarse_to_fine(
    extent: _Extent,
    config: TrainConfig,
    looks: Looks,
    *,
    generator: torch.Generator,
    progress: Progress,
    show: ShowSurface,
) -> _Fit:
    """Grid by grid the points fitted, then steps of rendering."""
    scene, deadline, clock = extent.scene, looks.deadline, looks.deadline.clock
    with torch.no_grad():
        distance = start(scene, extent.radius, config.levels[0])
    costs = [extent.cost]
    found: list[FarSide] = []
    total, done, rendered, taken_back = _steps_of_grids(config), 0, 0, 0
    for level, (wanted, rounds, steps) in enumerate(
        zip(config.levels, config.rounds, config.steps, strict=True)
    ):
        nodes = finest_grid(costs, len(distance), wanted, deadline.left_s())
        if nodes == len(distance) < wanted:
            break
        progress(done / total, f"fitting points on a grid of {nodes}^3")
        began_s = clock()
        with torch.no_grad():
            # bridges are seen in the first grid's field; finer ones than the second go on without them
            is_second = config.linear.inner_outlines and len(costs) == 2
            far = far_sides(scene, distance) if is_second else []
            found += far
            before = refined(distance, nodes)
            spent_s = looks.seconds
            is_last = level + 1 == len(config.levels)
            linear, num_looks = looks.planned(before, _looks_wanted(config, level), is_last=is_last)
            ask = looks.on_grid(num_looks, within(progress, done / total, (done + _STEPS_OF_GRID) / total))
            radius, told = extent.radius, looks.told
            distance = fit_level(
                scene, before, radius, rounds, linear, far=far, told=told, ask=ask, looks=num_looks
            )
        done += _STEPS_OF_GRID
        show(Surface(distance=distance.cpu().numpy(), grid_from_world=extent.frame.object_from_world))
        # looks take as long on any grid, and are left out where time is short
        costs.append(GridCost(nodes=nodes, seconds=clock() - began_s - (looks.seconds - spent_s)))
        if steps:
            tell = within(progress, done / total, (done + steps) / total)
            better = refine(scene, distance, steps, config.render, generator, tell, deadline)
            distance = better.distance
            rendered += better.steps
            taken_back += better.taken_back
            done += steps
    return _Fit(distance=distance, costs=costs, far=found, rendered=rendered, taken_back=taken_back)


def _steps_of_grids(config: TrainConfig) -> int:
    """Of rendering, that all grids take; for progress."""
    return sum(config.steps) + _STEPS_OF_GRID * len(config.levels)


def _in_time(last: GridCost, rounds: int, deadline: Deadline, nodes: int) -> bool:
    """Whether there is time for detail on so many nodes: it is like one of the `rounds` of the last grid."""
    return PESSIMISM * last.seconds / rounds * (nodes / last.nodes) ** 3 <= deadline.left_s()


def _looks_wanted(config: TrainConfig, level: int) -> int:
    first, between, last = config.looks
    if level == len(config.levels) - 1:
        return last
    return between if level else first


def _of_budget(config: TrainConfig, fit: _Fit, deadline: Deadline) -> tuple[Decision, ...]:
    """What the time was enough for, where there is a limit."""
    if config.budget_s is None:
        return ()
    nodes, wanted, steps = len(fit.distance), config.levels[-1], sum(config.steps)
    why = f"{config.budget_s:g} s given, {config.budget_s - deadline.left_s():.1f} s used"
    if nodes < wanted:
        choice = f"stopped at a grid of {nodes}"
        why += f"; a grid of {wanted} is predicted to take {predicted_s(fit.costs, wanted):.1f} s"
    elif fit.rendered < steps:
        choice = f"rendering stopped after {fit.rendered} of {steps} steps"
    else:
        choice = "all that the preset asks for"
    return (Decision(what="budget", choice=choice, because=why),)


def _decisions(extent: _Extent, config: TrainConfig, fit: _Fit) -> tuple[Decision, ...]:
    """What was modelled and what was left out, with the measurement behind it."""
    masks = sum(outline is not None for outline in extent.scene.outlines)
    backdrops = sum(backdrop is not None for backdrop in extent.scene.backdrops)
    nodes = len(fit.distance)
    cell = spacing(nodes) * extent.frame.radius_world
    asked = _who_asked(config, nodes == config.levels[-1] and fit.rendered == sum(config.steps))
    made = [
        Decision(
            what="grid",
            choice=f"{nodes} nodes along each side of a cube around the surface",
            because=f"{asked}; a cell is {cell:.3g} wide in the cameras' units",
        ),
        Decision(
            what="silhouettes",
            choice="used" if masks or backdrops else "left out",
            because=f"{masks} photographs have masks, {backdrops} an even backdrop",
        ),
        extent.depth,
        Decision(what="background", choice="left out", because="rays that miss the subject are not rendered"),
    ]
    return tuple(made)


def _of_rendering(config: TrainConfig, fit: _Fit) -> Decision:
    """How many gradient steps there were, and whether all of them went well."""
    rendered = fit.rendered
    what, because = "refinement by rendering", _who_asked(config, rendered == sum(config.steps))
    if not fit.taken_back:
        return Decision(what=what, choice=f"{rendered} steps" if rendered else "left out", because=because)
    numbers = not_finite(fit.taken_back)
    if not rendered:
        return Decision(what=what, choice="left out", because=f"{numbers}; so the field before them stands")
    because += f"; {numbers}, were taken back and shortened"
    return Decision(what=what, choice=f"{rendered} steps", because=because)


def _who_asked(config: TrainConfig, all_done: bool) -> str:
    return "the preset" if all_done or config.budget_s is None else "the time given"
