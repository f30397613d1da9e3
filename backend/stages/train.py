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

from ..maths.grid import refined, spacing
from ..scene import Decision, Progress, Region, StereoResult, View, within
from .deadline import PESSIMISM, Clock, Deadline, GridCost, deadline_after, finest_grid, predicted_s
from .detail import add_detail
from .flat_faces import FlatFaces, flat_faces, no_faces
from .inner_outlines import FarSide, decision, far_sides
from .linear_fit import LinearConfig, fit_level, start
from .looks import Looks
from .measurements import Measurements, carried, measurements
from .render_fit import RenderConfig, refine
from .safe_steps import not_finite
from .surface import COARSEST, ShowSurface, Surface, show_nothing, tight_frame
from .unseen_depth import depth_behind


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
        scene = extent.scene
        distance = start(scene, extent.radius, config.levels[0])
    costs = [extent.cost]
    total = sum(config.steps) + 10 * (len(config.levels) + 1)  # detail is one more
    done, rendered, taken_back, last = 0, 0, 0, len(config.levels) - 1
    told: list[FarSide] = []
    looks = Looks(scene=scene, linear=config.linear, deadline=deadline)
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
            told += far
            before = refined(distance, nodes)
            spent_s = looks.seconds
            linear, num_looks = looks.planned(before, _looks_wanted(config, level), is_last=level == last)
            ask = looks.on_grid(num_looks, within(progress, done / total, (done + 10) / total))
            distance = fit_level(
                scene,
                before,
                extent.radius,
                rounds,
                linear,
                far=far,
                told=looks.told,
                ask=ask,
                looks=num_looks,
            )
        done += 10
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
    progress(done / total, "detail")
    with torch.no_grad():
        detailed, of_detail = add_detail(
            scene,
            torch.cat([torch.from_numpy(stereo.points.view_index).to(device), extent.faces.views]),
            distance,
            config.detail,
            config.linear,
            partial(_in_time, costs[-1], config.rounds[-1], deadline),
        )
    made = (
        *_decisions(extent, config, nodes=len(distance), rendered=rendered),
        of_detail,
        extent.faces.decision,
        decision(told),
        *looks.decisions,
        _of_rendering(config, rendered, taken_back),
    )
    if config.budget_s is not None:
        made = (*made, _of_budget(config.budget_s, deadline.left_s(), config, costs, rendered))
    return Surface(
        distance=detailed.cpu().numpy(),
        grid_from_world=extent.frame.object_from_world,
        reach_cells=spacing(len(distance)) / spacing(len(detailed)),
        decisions=made,
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


def _in_time(last: GridCost, rounds: int, deadline: Deadline, nodes: int) -> bool:
    """Whether there is time for detail on so many nodes: it is like one of the `rounds` of the last grid."""
    return PESSIMISM * last.seconds / rounds * (nodes / last.nodes) ** 3 <= deadline.left_s()


def _looks_wanted(config: TrainConfig, level: int) -> int:
    first, between, last = config.looks
    if level == len(config.levels) - 1:
        return last
    return between if level else first


def _of_budget(
    budget_s: float, left_s: float, config: TrainConfig, costs: Sequence[GridCost], rendered: int
) -> Decision:
    """What the time was enough for."""
    nodes, wanted, steps = costs[-1].nodes, config.levels[-1], sum(config.steps)
    why = f"{budget_s:g} s given, {budget_s - left_s:.1f} s used"
    if nodes < wanted:
        choice = f"stopped at a grid of {nodes}"
        why += f"; a grid of {wanted} is predicted to take {predicted_s(costs, wanted):.1f} s"
    elif rendered < steps:
        choice = f"rendering stopped after {rendered} of {steps} steps"
    else:
        choice = "all that the preset asks for"
    return Decision(what="budget", choice=choice, because=why)


def _decisions(extent: _Extent, config: TrainConfig, *, nodes: int, rendered: int) -> tuple[Decision, ...]:
    """What was modelled and what was left out, with the measurement behind it."""
    masks = sum(outline is not None for outline in extent.scene.outlines)
    backdrops = sum(backdrop is not None for backdrop in extent.scene.backdrops)
    cell = spacing(nodes) * extent.frame.radius_world
    asked = _who_asked(config, nodes == config.levels[-1] and rendered == sum(config.steps))
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


def _of_rendering(config: TrainConfig, rendered: int, taken_back: int) -> Decision:
    """How many gradient steps there were, and whether all of them went well."""
    what, because = "refinement by rendering", _who_asked(config, rendered == sum(config.steps))
    if not taken_back:
        return Decision(what=what, choice=f"{rendered} steps" if rendered else "left out", because=because)
    numbers = not_finite(taken_back)
    if not rendered:
        return Decision(what=what, choice="left out", because=f"{numbers}; so the field before them stands")
    because += f"; {numbers}, were taken back and shortened"
    return Decision(what=what, choice=f"{rendered} steps", because=because)


def _who_asked(config: TrainConfig, all_done: bool) -> str:
    return "the preset" if all_done or config.budget_s is None else "the time given"
