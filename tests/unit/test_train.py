"""The distance field against the body it was fitted to, before and after the mesh is taken from it.

Grids and photographs are small, so errors are a share of the grid's cells; benchmarks say how good it
gets on photographs of full size.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from itertools import count
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree

from backend.errors import Cancelled
from backend.maths.raycast import render_mesh
from backend.scene import (
    Decision,
    Progress,
    Region,
    StereoResult,
    SurfaceMesh,
    no_progress,
    transform_points,
    within,
)
from backend.stages.measurements import Measurements
from backend.stages.mesh.extraction import MeshConfig, extract_mesh, level_set, preview_mesh
from backend.stages.stereo.config import StereoConfig
from backend.stages.stereo.multi_view_stereo import match_views
from backend.stages.surface import ShowSurface, Surface, show_nothing
from backend.stages.train import looks, surface_fit
from backend.stages.train.linear_fit import LinearConfig, fit_level
from backend.stages.train.shared_brightness import ShownPlaces
from backend.stages.train.surface_fit import TrainConfig, fit_surface
from tests.synthetic_scene import (
    CENTRE,
    SIZE,
    Scene,
    diagonal,
    photographed,
    ring_cameras,
    surface_distance,
    true_mesh,
    true_normals,
    true_region,
)

ROOMY = Region(object_from_world=np.diag([0.75, 0.75, 0.75, 1.0]) @ true_region().object_from_world)
"""A region with half the body's size of room around it."""


def matched(scene: Scene, region: Region) -> StereoResult:
    return match_views(scene.views, region, StereoConfig(), device=torch.device("cpu"), progress=no_progress)


def fitted(
    scene: Scene,
    region: Region,
    stereo: StereoResult,
    config: TrainConfig,
    seed: int = 0,
    progress: Progress = no_progress,
    show: ShowSurface = show_nothing,
    clock: Callable[[], float] = time.perf_counter,
) -> Surface:
    return fit_surface(
        scene.views,
        region,
        stereo,
        config,
        device=torch.device("cpu"),
        generator=torch.Generator().manual_seed(seed),
        progress=progress,
        show=show,
        clock=clock,
    )


@cache
def masked_scene() -> Scene:
    return photographed(ring_cameras(8, 112))


@cache
def masked_stereo() -> StereoResult:
    return matched(masked_scene(), true_region())


@cache
def masked_surface() -> Surface:
    config = TrainConfig(levels=(36,), rounds=(5,), steps=(5,))
    return fitted(masked_scene(), true_region(), masked_stereo(), config)


@cache
def masked_mesh() -> SurfaceMesh:
    return extract_mesh(
        masked_scene().views,
        true_region(),
        masked_stereo(),
        masked_surface(),
        MeshConfig(),
        progress=no_progress,
    )


@cache
def open_scene() -> Scene:
    """Before a textured wall, nothing cut out."""
    return photographed(ring_cameras(8, 112), wall=True).without_masks()


@cache
def open_stereo() -> StereoResult:
    return matched(open_scene(), ROOMY)


def open_surface(seed: int, steps: int = 8) -> Surface:
    config = TrainConfig(levels=(32,), rounds=(5,), steps=(steps,))
    return fitted(open_scene(), ROOMY, open_stereo(), config, seed)


def errors_percent(vertices: np.ndarray) -> np.ndarray:
    """Distance from the true surface, in percent of the body's diagonal."""
    return np.asarray(100 * np.abs(surface_distance(vertices)) / diagonal())


# with masks


def test_the_zero_level_is_the_surface() -> None:
    """A cell of this grid is 2.2 % of the diagonal wide."""
    apart = errors_percent(level_set(masked_surface())[0])
    assert np.median(apart) < 0.25
    assert np.quantile(apart, 0.95) < 1.5
    assert apart.max() < 4


def test_all_of_the_surface_is_there() -> None:
    mesh = trimesh.Trimesh(masked_mesh().vertices, masked_mesh().faces, process=False)
    samples, _ = trimesh.sample.sample_surface(mesh, 50_000, seed=0)
    apart, _ = cKDTree(samples).query(np.asarray(true_mesh().vertices)[::40])
    assert 100 * np.quantile(apart, 0.95) / diagonal() < 1.5
    assert mesh.volume == pytest.approx(true_mesh().volume, rel=0.04)


def test_the_mesh_is_closed_and_one() -> None:
    mesh = trimesh.Trimesh(masked_mesh().vertices, masked_mesh().faces, process=False)
    assert mesh.is_watertight
    assert mesh.body_count == 1
    assert mesh.euler_number == 2


def test_normals_are_the_surface_s() -> None:
    cosine = (masked_mesh().normals * true_normals(masked_mesh().vertices)).sum(axis=1)
    angles_deg = np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))
    assert np.median(angles_deg) < 8
    assert np.quantile(angles_deg, 0.95) < 30


def test_silhouettes_are_honoured() -> None:
    for view, covered in zip(masked_scene().views, masked_scene().coverage, strict=True):
        drawn = render_mesh(masked_mesh(), view.camera).coverage
        assert (drawn & covered).sum() / (drawn | covered).sum() > 0.97


def test_the_border_of_the_grid_is_outside() -> None:
    for surface in (masked_surface(), open_surface(0)):
        inner = np.zeros(surface.distance.shape, bool)
        inner[1:-1, 1:-1, 1:-1] = True
        assert surface.distance[~inner].min() > 0


def test_the_grid_lies_tightly_around_the_surface() -> None:
    in_grid = transform_points(masked_surface().grid_from_world, np.asarray(true_mesh().vertices))
    assert 0.7 < np.abs(in_grid).max() < 1


def test_near_the_surface_the_field_is_a_distance() -> None:
    """Unit slope across the surface: values at points moved along the normals are the way moved."""
    surface = masked_surface()
    scale = float(np.cbrt(np.linalg.det(surface.grid_from_world[:3, :3])))
    vertices, cell = masked_mesh().vertices, 2 / (surface.distance.shape[0] - 1)
    for way in (-1.0, 1.0):
        moved = vertices + way * cell / scale * masked_mesh().normals
        values = trilinear(surface.distance, transform_points(surface.grid_from_world, moved)) / cell
        assert np.median(values) == pytest.approx(way, abs=0.25)


def trilinear(grid: np.ndarray, points: np.ndarray) -> np.ndarray:
    at = (points + 1) / 2 * (len(grid) - 1)
    low = np.floor(at).astype(int)
    part = at - low
    total = np.zeros(len(points))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(np.array(corner) == 1, part, 1 - part), axis=1)
        total += weight * grid[tuple((low + corner).T)]
    return total


# without masks


def test_without_masks_what_is_measured_is_true_and_the_rest_is_closed() -> None:
    surface = open_surface(0)
    mesh = extract_mesh(open_scene().views, ROOMY, open_stereo(), surface, MeshConfig(), progress=no_progress)
    apart = errors_percent(mesh.vertices)
    assert np.median(apart[mesh.support > 0.5]) < 0.5
    assert np.linalg.norm(mesh.vertices - CENTRE, axis=1).max() < 1.6 * SIZE


# chance and words


def test_a_seed_repeats_to_the_bit_and_another_one_does_not() -> None:
    torch.use_deterministic_algorithms(True)  # as a run does: backend.machine.set_up_torch
    try:
        first, again, other = open_surface(3), open_surface(3), open_surface(4)
    finally:
        torch.use_deterministic_algorithms(False)
    np.testing.assert_array_equal(first.distance, again.distance)
    np.testing.assert_array_equal(first.grid_from_world, again.grid_from_world)
    assert np.abs(first.distance - other.distance).max() > 0


def test_unfinished_surfaces_are_shown_and_change_nothing() -> None:
    """One for each level, each nearer to the truth; the last one is what rendering starts from."""
    shown: list[Surface] = []
    config = TrainConfig(levels=(16, 32), rounds=(5, 5), steps=(0, 3), detail=0)
    torch.use_deterministic_algorithms(True)
    try:
        seen = fitted(masked_scene(), true_region(), masked_stereo(), config, show=shown.append)
        unseen = fitted(masked_scene(), true_region(), masked_stereo(), config)
    finally:
        torch.use_deterministic_algorithms(False)
    assert seen.distance.tobytes() == unseen.distance.tobytes()
    assert [len(surface.distance) for surface in shown] == [16, 32]
    meshes = [preview_mesh(surface, np.zeros((0, 3)), np.zeros((0, 3), np.float32)) for surface in shown]
    coarse, fine = (float(np.median(errors_percent(mesh.vertices))) for mesh in meshes if mesh is not None)
    assert fine < coarse
    assert fine < 0.5
    moved = np.abs(shown[-1].distance - seen.distance).max()
    assert 0 < moved < 2 / 31, "in the grid's units, a cell"


def test_rendering_moves_the_surface_by_less_than_a_cell() -> None:
    before, after = open_surface(0, steps=0).distance, open_surface(0).distance
    moved = np.abs(before - after).max() / (2 / 31)
    assert 1e-4 < moved < 1


def test_progress_grows_and_may_cancel() -> None:
    told: list[float] = []

    def listen(fraction: float, _text: str) -> None:
        told.append(fraction)
        if len(told) == 3:
            raise Cancelled

    config = TrainConfig(levels=(24, 24), rounds=(5, 5), steps=(10, 10))
    with pytest.raises(Cancelled):
        fitted(open_scene(), ROOMY, open_stereo(), config, progress=listen)
    assert told == sorted(told)
    assert 0 <= told[0] < told[-1] < 1


def test_progress_of_a_part_is_within_the_whole() -> None:
    told: list[tuple[float, str]] = []
    tell = within(lambda fraction, text: told.append((fraction, text)), 0.25, 0.75)
    for fraction, text in ((0.0, "begun"), (0.5, ""), (1.0, "done")):
        tell(fraction, text)
    within(tell, 0.5, 1.0)(0.5, "a part of a part")
    assert told == [(0.25, "begun"), (0.5, ""), (0.75, "done"), (0.625, "a part of a part")]


def test_the_inside_lies_within_all_masks() -> None:
    surface = masked_surface()
    world_from_grid = np.linalg.inv(surface.grid_from_world)
    inside = np.argwhere(surface.distance < -0.05) * 2 / (surface.distance.shape[0] - 1) - 1.0
    positions = transform_points(world_from_grid, inside)
    for view in masked_scene().views:
        in_camera = transform_points(view.camera.camera_from_world, positions) @ view.camera.intrinsics.T
        at = np.floor(in_camera[:, :2] / in_camera[:, 2:]).astype(int)
        assert view.mask is not None
        assert view.mask[at[:, 1], at[:, 0]].mean() > 0.999


# time


def ticking(tick_s: float) -> Callable[[], float]:
    """A clock that is later each time that it is read."""
    return partial(next, count(0.0, tick_s))


def limited(budget_s: float | None, steps: int = 20, tick_s: float = 1.0) -> Surface:
    """Of levels that all cost one tick of the clock; deterministic."""
    config = TrainConfig(
        levels=(16, 24, 32), rounds=(5, 5, 5), steps=(0, 0, steps), detail=0, budget_s=budget_s
    )
    torch.use_deterministic_algorithms(True)
    try:
        return fitted(masked_scene(), true_region(), masked_stereo(), config, clock=ticking(tick_s))
    finally:
        torch.use_deterministic_algorithms(False)


def two_places(weights: torch.Tensor) -> ShownPlaces:
    """On the subject's surface, as if brightness had told them."""
    some = torch.tensor([[0.0, 0.0, 0.5], [0.0, 0.5, 0.0]])
    return ShownPlaces(
        positions=some,
        normals=2 * some,
        weights=weights,
        mirrored=torch.zeros(2),
        directions=-2 * some,
        hidden=torch.zeros(2, dtype=torch.bool),
    )


def decision_on(surface: Surface, what: str) -> Decision:
    (found,) = (decision for decision in surface.decisions if decision.what == what)
    return found


def test_the_more_time_the_finer_the_grid_and_the_smaller_the_error() -> None:
    surfaces = [limited(budget_s, steps=0) for budget_s in (0.5, 9.0, 20.0)]
    assert [len(surface.distance) for surface in surfaces] == [16, 24, 32]
    errors = [float(np.median(errors_percent(level_set(surface)[0]))) for surface in surfaces]
    assert errors == sorted(errors, reverse=True)
    stopped, _, whole = (decision_on(surface, "budget") for surface in surfaces)
    assert stopped.choice == "stopped at a grid of 16"
    assert "0.5 s given" in stopped.because
    assert "a grid of 32 is predicted to take 2.0 s" in stopped.because
    assert whole.choice == "all that the preset asks for"
    assert decision_on(surfaces[0], "grid").because.startswith("the time given")
    assert decision_on(surfaces[2], "grid").because.startswith("the preset")


def test_rendering_stops_at_the_deadline() -> None:
    """20 s are over after the levels' readings of the clock and some steps, each a reading."""
    surface = limited(20.0)
    assert len(surface.distance) == 32
    choice = decision_on(surface, "budget").choice
    steps = int(choice.removeprefix("rendering stopped after ").removesuffix(" of 20 steps"))
    assert 0 < steps < 20
    assert decision_on(surface, "refinement by rendering").choice == f"{steps} steps"
    assert np.abs(surface.distance - limited(20.0, steps=0).distance).max() > 0


def test_time_enough_changes_nothing_but_the_words() -> None:
    unlimited, ample = limited(None, tick_s=1e3), limited(1e6)
    assert ample.distance.tobytes() == unlimited.distance.tobytes()
    assert ample.decisions[:-1] == unlimited.decisions
    assert decision_on(ample, "budget").choice == "all that the preset asks for"


def test_long_looks_are_not_taken_for_the_cost_of_a_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two looks of 100 s leave 150 of 350 s: enough for a grid of a few seconds."""
    now_s = [0.0]

    def clock() -> float:
        now_s[0] += 1.0
        return now_s[0]

    def long_look(*field: Any, **how: Any) -> ShownPlaces:
        now_s[0] += 100.0
        return two_places(torch.ones(2))

    monkeypatch.setattr(looks, "textured", lambda scene, distance: 0.35)
    monkeypatch.setattr(looks, "weight_beside", lambda *asked: 1.0)
    monkeypatch.setattr(looks, "shared_brightness", long_look)
    config = TrainConfig(
        levels=(32, 56, 64), rounds=(2, 2, 2), steps=(0, 0, 0), looks=(0, 2, 0), budget_s=350.0
    )
    config = replace(config, linear=LinearConfig(settled=0.0))
    surface = fitted(masked_scene(), true_region(), masked_stereo(), config, clock=clock)
    assert now_s[0] > 200
    assert len(surface.distance) == 64


def test_the_report_says_why_brightness_was_left_out() -> None:
    whole, stopped = (
        decision_on(limited(budget_s, steps=0), "brightness without texture") for budget_s in (None, 0.5)
    )
    assert whole.choice == stopped.choice == "left out"
    assert "patches tell 8" in whole.because
    assert "time" in stopped.because


def test_the_last_grid_of_a_plain_subject_is_fitted_as_such(monkeypatch: pytest.MonkeyPatch) -> None:
    """From the grid before it hears what brightness told there, and how much of the surface is textured."""
    heard: list[tuple[int, float, int]] = []
    places = two_places(torch.ones(2))

    def spy(scene: Measurements, before: torch.Tensor, *args: Any, **words: Any) -> torch.Tensor:
        told = words.get("told")
        heard.append((len(before), args[2].stereo, 0 if told is None else len(told.weights)))
        return fit_level(scene, before, *args, **words)

    monkeypatch.setattr(surface_fit, "fit_level", spy)
    monkeypatch.setattr(looks, "textured", lambda scene, distance: 0.35)
    monkeypatch.setattr(looks, "share_told", lambda told, distance: 0.035)
    config = TrainConfig(levels=(16, 20, 24, 32), rounds=(3, 3, 3, 3), steps=(0, 0, 0, 0), looks=(0, 1, 1))
    subject, unknown = (masked_scene(), true_region(), masked_stereo()), (open_scene(), ROOMY, open_stereo())
    nothing = places.chosen(places.weights < 0)
    for what, told, num, stereo in (
        (subject, places, 2, 1 - 0.75 * 0.5),
        (subject, nothing, 0, 1),
        (unknown, places, 2, 1 - 0.75 * 0.5),
    ):
        monkeypatch.setattr(looks, "shared_brightness", lambda *field, told=told, **how: told)
        heard.clear()
        fitted(*what, config)
        assert heard[-4:] == [(16, 1.0, 0), (20, 1.0, 0), (24, 1.0, num), (32, stereo, num)]


def test_doubtful_points_count_more_where_most_is_textured(monkeypatch: pytest.MonkeyPatch) -> None:
    """From the first grid on whose texture is looked at; brightness is not asked there."""
    powers: list[float] = []

    def spy(scene: Measurements, before: torch.Tensor, *args: Any, **words: Any) -> torch.Tensor:
        powers.append(args[2].confidence_power)
        return fit_level(scene, before, *args, **words)

    def nobody(*field: Any, **how: Any) -> ShownPlaces:
        raise AssertionError("brightness was asked")

    monkeypatch.setattr(surface_fit, "fit_level", spy)
    config = TrainConfig(levels=(16, 24, 32), rounds=(3, 3, 3), steps=(0, 0, 0), looks=(0, 2, 2))
    usual = LinearConfig()
    assert usual.power_if_textured < usual.confidence_power
    unasked = replace(usual, brightness=0.0)
    textured = [usual.confidence_power, usual.power_if_textured, usual.power_if_textured]
    for share, linear, asked, last in (
        (0.86, usual, nobody, textured),
        (0.86, unasked, nobody, textured),
        (0.35, usual, lambda *field, **how: two_places(torch.ones(2)), [usual.confidence_power] * 3),
    ):
        monkeypatch.setattr(looks, "textured", lambda scene, distance, share=share: share)
        monkeypatch.setattr(looks, "shared_brightness", asked)
        powers.clear()
        surface = fitted(masked_scene(), true_region(), masked_stereo(), replace(config, linear=linear))
        assert powers[-3:] == last
        doubt = decision_on(surface, "doubtful points")
        assert doubt.choice == f"weigh as their confidence to the power of {last[-1]:g}"
        assert doubt.because == f"patches tell {share:.0%} of the surface"


def test_what_hardly_weighs_is_asked_about_once_on_each_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stereo's points weigh the cube of their confidence."""
    asked = [0]
    views, region, stereo = masked_scene(), true_region(), masked_stereo()
    measured = float((torch.tensor(stereo.points.confidence) ** 3).sum())
    monkeypatch.setattr(looks, "textured", lambda scene, distance: 0.35)
    config = TrainConfig(levels=(16, 24, 32), rounds=(3, 5, 5), steps=(0, 0, 0), looks=(0, 3, 2))
    config = replace(config, linear=LinearConfig(settled=0.0))
    for share, times in ((0.05, 1 + 1), (0.2, 3 + 2)):
        told = two_places(torch.full((2,), share * measured / 2))

        def counted(*field: Any, told: ShownPlaces = told, **how: Any) -> ShownPlaces:
            asked[0] += 1
            return told

        asked[0] = 0
        monkeypatch.setattr(looks, "shared_brightness", counted)
        fitted(views, region, stereo, config)
        assert asked[0] == times
