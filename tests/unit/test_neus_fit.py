"""NeuS and SparseCraft on a small scene: from a ball to the body, repeatably, and never into nothing."""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from itertools import count

import numpy as np
import pytest
import torch

from backend.errors import Cancelled, ErrorCode, ReconstructionError
from backend.presets import PRESETS
from backend.scene import (
    Decision,
    DepthMap,
    Progress,
    StereoResult,
    View,
    no_progress,
)
from backend.stages.measurements import measurements
from backend.stages.mesh.extraction import level_set
from backend.stages.published import field_surface, neus_fit
from backend.stages.published.networks import HashConfig, NetworkConfig, NeuralSurface
from backend.stages.published.neus_fit import NeusConfig, active_levels, finest_detail, fit_neus, rate_share
from backend.stages.published.neus_losses import Moment, Sampling, Weights, measured_points, point_loss
from backend.stages.surface import ShowSurface, Surface, show_nothing
from backend.stages.train import render_fit
from backend.stages.train.field import SurfaceField
from backend.stages.train.render_fit import RenderConfig
from tests.synthetic_scene import (
    CENTRE,
    Scene,
    camera_at,
    diagonal,
    faced_points,
    photographed,
    ring_cameras,
    surface_distance,
    true_mesh,
    true_region,
)

SAMPLING = Sampling(rays=96, uniform=12, rounds=2, per_round=6, point_queries=256)
NEUS = NeusConfig(steps=200, sampling=SAMPLING, network=NetworkConfig(width=48, layers=2), nodes=40)
SPARSECRAFT = NeusConfig(
    steps=60,
    sampling=replace(SAMPLING, rays=48),
    network=NetworkConfig(
        width=32, layers=1, hash_grid=HashConfig(levels=4, finest=32), albedo_and_specular=True
    ),
    weights=Weights(points=1.0),
    learning_rate=1e-2,
    constant=0.5,
    slope_annealed_at=1.0,
    nodes=40,
)
PUBLISHED = {
    name: preset.train
    for name, preset in PRESETS.items()
    if name.endswith("-published") and isinstance(preset.train, NeusConfig)
}
BOTH = [pytest.param(NEUS, id="neus"), pytest.param(SPARSECRAFT, id="sparsecraft")]


@cache
def scene() -> Scene:
    """From all around, and from below."""
    return photographed([*ring_cameras(6, 80), camera_at(0.0, -4.0, 80)])


@cache
def exact_stereo() -> StereoResult:
    """Points on the true surface, all of which some view shows, without depth maps."""
    points = faced_points(scene().cameras)
    assert len(points.positions) == len(true_mesh().vertices[::20])
    blank = np.zeros(scene().coverage[0].shape, np.float32)
    maps = (DepthMap(depth=blank, confidence=blank, empty=None, subject=None),) * len(scene().views)
    return StereoResult(points=points, depth_maps=maps)


def fitted(
    config: NeusConfig,
    *,
    views: tuple[View, ...] | None = None,
    seed: int = 0,
    progress: Progress = no_progress,
    show: ShowSurface = show_nothing,
    clock: Callable[[], float] = time.perf_counter,
) -> Surface:
    torch.use_deterministic_algorithms(True)
    try:
        return fit_neus(
            scene().views if views is None else views,
            true_region(),
            exact_stereo(),
            config,
            device=torch.device("cpu"),
            generator=torch.Generator().manual_seed(seed),
            progress=progress,
            show=show,
            clock=clock,
        )
    finally:
        torch.use_deterministic_algorithms(False)


def median_error_percent(surface: Surface) -> float:
    """Of the zero level from the body, in percent of the body's diagonal."""
    return float(np.median(100 * np.abs(surface_distance(level_set(surface)[0])) / diagonal()))


@cache
def ball_error_percent() -> float:
    """Of the best that no learning could give: the ball around the centre with the least median error."""
    directions = np.asarray(true_mesh().vertices) - CENTRE
    reach = np.linalg.norm(directions, axis=1)
    directions /= reach[:, None]
    radii = np.linspace(reach.min(), reach.max(), 30)
    errors = (np.median(np.abs(surface_distance(CENTRE + radius * directions))) for radius in radii)
    return 100 * min(errors) / diagonal()


@cache
def whole(sparsecraft: bool) -> Surface:
    return fitted(SPARSECRAFT if sparsecraft else NEUS)


def decision_on(surface: Surface, what: str) -> Decision:
    (found,) = (decision for decision in surface.decisions if decision.what == what)
    return found


def test_what_is_fitted_starts_as_a_ball() -> None:
    assert median_error_percent(fitted(replace(NEUS, steps=1, learning_rate=0.0))) > ball_error_percent()


@pytest.mark.parametrize(("sparsecraft", "share"), [(False, 0.5), (True, 0.1)])
def test_the_ball_becomes_the_body(sparsecraft: bool, share: float) -> None:
    """Rendering alone halves the error of the best ball in a few seconds; with points a tenth is left."""
    assert median_error_percent(whole(sparsecraft)) < share * ball_error_percent()


@pytest.mark.parametrize("config", BOTH)
def test_the_same_seed_gives_the_same_bytes(config: NeusConfig) -> None:
    few = replace(config, steps=4, nodes=24)
    first, again, other = fitted(few), fitted(few), fitted(few, seed=1)
    assert first.distance.tobytes() == again.distance.tobytes()
    assert first.distance.tobytes() != other.distance.tobytes()


def test_nothing_but_nan_is_told() -> None:
    views = tuple(replace(view, image_srgb=view.image_srgb * np.nan) for view in scene().views)
    with pytest.raises(ReconstructionError) as raised:
        fitted(replace(NEUS, steps=4), views=views)
    assert raised.value.code is ErrorCode.NO_SURFACE


def test_without_masks_a_background_colour_is_learned() -> None:
    """Before black, with nothing cut out."""
    surface = fitted(SPARSECRAFT, views=scene().without_masks().views)
    assert decision_on(surface, "silhouettes").choice == "left out"
    assert median_error_percent(surface) < 0.2 * ball_error_percent()


def test_progress_grows_and_may_cancel() -> None:
    told: list[float] = []

    def listen(fraction: float, _text: str) -> None:
        told.append(fraction)
        if len(told) == 4:
            raise Cancelled

    with pytest.raises(Cancelled):
        fitted(replace(NEUS, steps=50), progress=listen)
    assert told == sorted(told)
    assert 0 <= told[0] < told[-1] < 1


def test_unfinished_surfaces_are_shown_and_change_nothing() -> None:
    few = replace(SPARSECRAFT, steps=20, nodes=24)
    shown: list[Surface] = []
    surface = fitted(few, show=shown.append)
    assert len(shown) == 10
    assert shown[0].distance.min() < 0 < shown[0].distance.max()
    assert surface.distance.tobytes() == fitted(few).distance.tobytes()


def ticking(tick_s: float) -> Callable[[], float]:
    """A clock that is later each time that it is read."""
    return partial(next, count(0.0, tick_s))


def test_learning_stops_at_the_deadline() -> None:
    """Of 20 s sampling the grid is taken to cost some; each step is a reading of the clock."""
    surface = fitted(replace(NEUS, steps=50, nodes=48, budget_s=20.0), clock=ticking(1.0))
    choice = decision_on(surface, "budget").choice
    steps = int(choice.removeprefix("stopped after ").removesuffix(" of 50 steps"))
    assert 5 < steps < 20


def test_time_enough_changes_nothing_but_the_words() -> None:
    few = replace(NEUS, steps=5, nodes=24)
    unlimited, ample = fitted(few, clock=ticking(1e3)), fitted(replace(few, budget_s=1e6), clock=ticking(1.0))
    assert ample.distance.tobytes() == unlimited.distance.tobytes()
    assert ample.decisions[:-1] == unlimited.decisions
    assert decision_on(ample, "budget").choice == "all that the preset asks for"


@pytest.mark.slow
@pytest.mark.parametrize("name", PUBLISHED)
def test_the_published_sizes_learn(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A few steps of a few rays: all are taken, and the field moves."""
    for module in (neus_fit, field_surface):  # to ask these networks at 48^3 places takes half a minute
        monkeypatch.setattr(module, "COARSEST", 12)
    published = PUBLISHED[name]
    few = replace(
        published,
        steps=3,
        nodes=12,
        sampling=replace(published.sampling, rays=16, point_queries=100),
        warm_up=0.0,
    )
    surface, still = fitted(few), fitted(replace(few, learning_rate=0.0))
    assert np.isfinite(surface.distance).all()
    assert surface.distance.min() < 0 < surface.distance.max()
    assert decision_on(surface, "refinement by rendering").choice == "3 steps of 16 rays"
    assert np.abs(surface.distance - still.distance).max() > 1e-3


def test_levels_join_one_by_one_and_differences_shrink_with_them() -> None:
    """As published: all 32 levels from step 3100 of 4000, a first difference of half the region's radius."""
    published = PUBLISHED["sparsecraft-published"].network
    levels = [active_levels(published, step / 4000) for step in range(0, 4000, 50)]
    assert levels == sorted(levels)
    assert set(levels) == set(range(1, 33))
    assert active_levels(published, 3120 / 4000) == 32
    assert finest_detail(published, 1) == 0.5
    assert finest_detail(published, 32) == pytest.approx(2 / 2048)
    assert active_levels(NetworkConfig(), 0.5) == 0


def test_steps_grow_stay_and_shrink() -> None:
    """As NeuS publishes it, but that SPARSECRAFT stays for half of the run; and as SparseCraft does."""
    shares = [rate_share(SPARSECRAFT, done) for done in np.linspace(0, 1, 200)]
    assert shares[0] == pytest.approx(0.01)
    assert shares[50] == shares[99] == 1.0
    assert shares[99:] == sorted(shares[99:], reverse=True)
    assert shares[-1] == pytest.approx(0.05)
    published = PUBLISHED["sparsecraft-published"]
    shares = [rate_share(published, step / 4000) for step in (0, 1000, 2000, 3000, 4000)]
    assert shares == pytest.approx([1, 1, 1, 0.1**0.5, 0.1])


@pytest.mark.parametrize("of", ["network", "grid"])
def test_each_taylor_residual_has_a_weight_of_its_own(of: str) -> None:
    """The same draw each time: with a weight of 0 a residual is gone, and the parts add up to the whole."""

    def loss(at_query: float, at_point: float) -> float:
        generator = torch.Generator().manual_seed(3)
        if of == "grid":
            ball = torch.linspace(-1, 1, 24).square()
            distance = (ball[:, None, None] + ball[:, None] + ball).sqrt() - 0.6
            field = SurfaceField(
                distance, band_cells=4, channels=6, view_dependent=False, generator=generator
            )
            config = RenderConfig(point_queries=64, at_query=at_query, at_point=at_point)
            return render_fit._point_loss(field, points, config, generator).item()
        surface = NeuralSurface(replace(SPARSECRAFT.network, albedo_and_specular=False), generator)
        weights = Weights(points=1.0, at_query=at_query, at_point=at_point)
        return point_loss(surface, measured_points(points), moment, SAMPLING, weights, generator).item()

    points = measurements(scene().views, true_region(), exact_stereo(), torch.device("cpu"))
    moment = Moment(
        done=1.0, active=2, width=0.1, differenced=True, annealed=1.0, sharpness=torch.tensor(20.0)
    )
    at_query, at_point = loss(1.0, 0.0), loss(0.0, 1.0)
    assert loss(0.0, 0.0) == 0
    assert min(at_query, at_point) > 0
    assert at_query != pytest.approx(at_point)
    assert loss(1.0, 1.0) == pytest.approx(at_query + at_point)
    assert loss(0.5, 2.0) == pytest.approx(0.5 * at_query + 2 * at_point)
