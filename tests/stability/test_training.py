"""Gradient steps: no seed leads to a number that is not one, and a planted one is noticed and taken back."""

import math
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from itertools import count
from types import ModuleType
from typing import Any

import jaxtyping
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from backend.errors import ErrorCode, ReconstructionError
from backend.maths.grid import interpolate, locate
from backend.point_methods import PointMethod
from backend.scene import Decision, StereoResult, View, no_progress, transform_points
from backend.stages.deadline import deadline_after
from backend.stages.measurements import Measurements, carried, measurements
from backend.stages.points import point_network
from backend.stages.points.point_cloud import PointCloud, clean_cloud
from backend.stages.points.point_fit import PointFitConfig, fit_points
from backend.stages.points.point_network import METHODS
from backend.stages.points.point_network import NetworkConfig as PointNetworkConfig
from backend.stages.published import field_surface, neus_fit, radiance_fit
from backend.stages.published.networks import HashConfig, NetworkConfig, NeuralSurface
from backend.stages.published.neus_fit import NeusConfig, fit_neus
from backend.stages.published.neus_losses import MeasuredPoints, Sampling, Weights
from backend.stages.published.radiance_fit import RadianceConfig, fit_radiance
from backend.stages.radiance import RadianceShape
from backend.stages.safe_steps import PATIENCE, SafeSteps
from backend.stages.stereo.config import StereoConfig
from backend.stages.stereo.multi_view_stereo import match_views, unmatched
from backend.stages.surface import Surface
from backend.stages.train.render_fit import Refined, RenderConfig, refine
from backend.stages.train.surface_fit import TrainConfig, fit_surface
from tests.synthetic_scene import Scene, photographed, ring_cameras, surface_points, true_region

CPU = torch.device("cpu")
NODES = 16
CELL = 2 / (NODES - 1)
FEW = RenderConfig(rays=128, point_queries=256)


@cache
def scene() -> Scene:
    return photographed(ring_cameras(6, 64))


@cache
def stereo() -> StereoResult:
    return match_views(scene().views, true_region(), StereoConfig(), device=CPU, progress=no_progress)


def fitted(views: tuple[View, ...], steps: int) -> Surface:
    config = TrainConfig(levels=(NODES,), rounds=(1,), steps=(steps,), detail=0, render=FEW)
    chance = torch.Generator().manual_seed(0)
    return fit_surface(
        views, true_region(), stereo(), config, device=CPU, generator=chance, progress=no_progress
    )


@cache
def linear() -> Surface:
    """The field before any gradient step."""
    return fitted(scene().views, 0)


def rendered(views: tuple[View, ...], steps: int, seed: int = 0, config: RenderConfig = FEW) -> Refined:
    frame_from_object = linear().grid_from_world @ true_region().world_from_object
    in_object = measurements(views, true_region(), stereo(), CPU)
    measured = carried(in_object, views, true_region(), frame_from_object)
    chance = torch.Generator().manual_seed(seed)
    never = deadline_after(None, time.perf_counter)
    return refine(measured, torch.from_numpy(linear().distance), steps, config, chance, no_progress, never)


def spoiled(rows: slice, columns: slice) -> tuple[View, ...]:
    """The photographs, with pixels of the first that are no numbers."""
    first, *others = scene().views
    image = first.image_srgb.copy()
    image[rows, columns] = np.nan
    return (replace(first, image_srgb=image), *others)


def movement(field: Refined) -> Tensor:
    return field.distance - torch.from_numpy(linear().distance)


def moved(field: Refined) -> float:
    return float(movement(field).abs().max())


def told(surface: Surface) -> Decision:
    (found,) = (d for d in surface.decisions if d.what == "refinement by rendering")
    return found


TINY = RenderConfig(rays=32, edges=5, point_queries=64)


def off_the_body(distance: Tensor) -> float:
    """Mean distance that the field has where the body's surface is, in cells."""
    directions = F.normalize(torch.randn((500, 3), generator=torch.Generator().manual_seed(5)), dim=-1)
    points = transform_points(linear().grid_from_world, surface_points(directions.double().numpy()))
    values = interpolate(distance, locate(torch.tensor(points, dtype=torch.float32), NODES))
    return float(values.abs().mean()) / CELL


@pytest.fixture
def shapes_are_known() -> Iterator[None]:
    """They are the same for all seeds, and other tests check them: that takes a quarter of the time."""
    jaxtyping.config.update("jaxtyping_disable", True)  # type: ignore[no-untyped-call]
    yield
    jaxtyping.config.update("jaxtyping_disable", False)  # type: ignore[no-untyped-call]


@pytest.mark.slow
@pytest.mark.usefixtures("shapes_are_known")
@pytest.mark.parametrize(("seeds", "steps"), [(range(100), 20), (range(100, 105), 50)])
def test_no_seed_leads_to_what_is_not_a_number(seeds: range, steps: int) -> None:
    """Whole runs, from soft to sharp, that differ in rays, queries and the network's start.

    None moves a node by a cell, and none leaves the body.
    """
    before = off_the_body(torch.from_numpy(linear().distance))
    for seed in seeds:
        field = rendered(scene().views, steps, seed, TINY)
        assert (field.steps, field.taken_back) == (steps, 0)
        assert 0 < moved(field) < CELL
        assert off_the_body(field.distance) < before + 0.05


TINY_SAMPLING = Sampling(rays=24, uniform=8, rounds=1, per_round=4, point_queries=32)
TINY_NETWORKS: dict[str, RadianceConfig | NeusConfig] = {
    "nerf": RadianceConfig(
        steps=50,
        rays=32,
        nodes=16,
        shape=RadianceShape(width=16, layers=2, proposal_width=16, proposal_intervals=12, intervals=8),
    ),
    "neus": NeusConfig(
        steps=50,
        nodes=16,
        sampling=TINY_SAMPLING,
        network=NetworkConfig(width=32, layers=2, features=8, colour_layers=1),
    ),
    "sparsecraft": NeusConfig(
        steps=50,
        nodes=16,
        sampling=TINY_SAMPLING,
        weights=Weights(points=1.0),
        learning_rate=1e-2,
        constant=0.5,
        slope_annealed_at=1.0,
        network=NetworkConfig(
            width=32,
            layers=1,
            features=8,
            colour_layers=1,
            albedo_and_specular=True,
            hash_grid=HashConfig(levels=4, finest=32, most_rows=2**12),
        ),
    ),
}


@pytest.mark.slow
@pytest.mark.usefixtures("shapes_are_known")
@pytest.mark.parametrize(
    ("preset", "seeds", "steps"),
    [
        ("nerf", range(100), 50),  # with 25 steps some have no surface yet
        ("neus", range(100), 25),
        ("neus", range(100, 105), 50),
        ("sparsecraft", range(50), 25),
        ("sparsecraft", range(50, 100), 25),
        ("sparsecraft", range(100, 105), 50),
    ],
)
def test_no_seed_of_a_network_leads_to_what_is_not_a_number(preset: str, seeds: range, steps: int) -> None:
    """Of each all steps are taken, and there is a surface."""
    config = replace(TINY_NETWORKS[preset], steps=steps)
    fit: Callable[..., Surface] = fit_radiance if isinstance(config, RadianceConfig) else fit_neus
    for seed in seeds:
        chance = torch.Generator().manual_seed(seed)
        surface = fit(
            scene().views,
            true_region(),
            stereo(),
            config,
            device=CPU,
            generator=chance,
            progress=no_progress,
        )
        assert np.isfinite(surface.distance).all()
        assert surface.distance.min() < 0 < surface.distance.max()
        told = " ".join(f"{decision.choice} {decision.because}" for decision in surface.decisions)
        assert f"{steps} " in told
        assert "not finite" not in told
        assert "not taken" not in told


TINY_POINT_NETWORK = PointNetworkConfig(width=16, layers=2, steps=30, batch=100, warm_up=5)


@cache
def few_points() -> PointCloud:
    """Three hundred on a sphere, a hundredth of its radius off."""
    chance = np.random.default_rng(0)
    directions = chance.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return clean_cloud(directions + 0.01 * chance.normal(size=(300, 3)), None)


@pytest.mark.slow
@pytest.mark.usefixtures("shapes_are_known")
@pytest.mark.parametrize(
    ("method", "seeds"),
    [(PointMethod.LINEAR, range(5)), *((method, range(100)) for method in sorted(METHODS))],
)
def test_no_seed_of_points_alone_leads_to_what_is_not_a_number(
    method: PointMethod, seeds: range, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No step is taken back, and there is a surface around the middle, another for each seed."""
    monkeypatch.setattr(point_network, "_QUERIES", 20_000)  # a step sees a hundred of them
    config = PointFitConfig(method=method, nodes=16, sides=TINY_POINT_NETWORK, network=TINY_POINT_NETWORK)
    middles = set()
    for seed in seeds:
        chance = torch.Generator().manual_seed(seed)
        surface = fit_points(few_points(), config, device=CPU, generator=chance, progress=no_progress)
        assert np.isfinite(surface.distance).all()
        middle = float(surface.distance[7:9, 7:9, 7:9].mean())
        assert middle < 0 < surface.distance.max()
        middles.add(middle)
        told = [decision for decision in surface.decisions if decision.choice == "30 steps"]
        assert [decision.because for decision in told] == ["the method's setting"]
    assert len(middles) == len(seeds)


def test_a_few_pixels_that_are_no_numbers_cost_a_few_steps() -> None:
    one_pixel = spoiled(slice(20, 21), slice(30, 31))
    with_it, without = rendered(one_pixel, 40), rendered(scene().views, 40)
    assert with_it.steps == 40
    assert 0 < with_it.taken_back < PATIENCE
    assert with_it.distance.isfinite().all()
    learnt, all_of_it = movement(with_it), movement(without)
    # of two seeds' steps, without such a pixel, 0.70 to 0.87 have one direction
    assert (learnt * all_of_it).sum() > 0.7 * all_of_it.square().sum(), "ten steps before is kept"
    because = told(fitted(one_pixel, 40)).because
    assert because.startswith(f"the preset; {with_it.taken_back} steps led to numbers that are not finite")


def test_photographs_without_numbers_leave_the_field_as_it_was() -> None:
    surface = fitted(spoiled(slice(None), slice(None)), 40)
    np.testing.assert_array_equal(surface.distance, linear().distance)
    assert told(surface).choice == "left out"
    assert told(surface).because.startswith(f"{PATIENCE} steps led to numbers that are not finite")


# networks learned by rendering


class PlainSteps(SafeSteps):
    """Steps as they are usually taken: whatever the numbers are."""

    def take(self, loss: Tensor, length: float = 1.0) -> None:
        self.steps += 1
        self._optimiser.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        self._optimiser.step()


SMALL = {
    radiance_fit: RadianceConfig(
        shape=RadianceShape(
            width=16, layers=2, frequencies=4, proposal_width=8, proposal_intervals=16, intervals=8
        ),
        steps=40,
        rays=192,
        nodes=24,
    ),
    neus_fit: NeusConfig(
        steps=40,
        network=NetworkConfig(width=16, layers=2, features=8),
        sampling=Sampling(rays=192, uniform=8, rounds=1, per_round=4),
        nodes=24,
    ),
}
"""Networks learned by rendering that take a second."""
LOSS = {radiance_fit: "_loss", neus_fit: "ray_loss"}
FITS = [pytest.param(module, id=module.__name__.rpartition(".")[2]) for module in SMALL]


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Looking for where a network's surface is takes longer than its few steps."""
    for module in (neus_fit, radiance_fit, field_surface):
        monkeypatch.setattr(module, "COARSEST", 16)


def learned(module: ModuleType, views: tuple[View, ...]) -> Surface:
    fit = {radiance_fit: fit_radiance, neus_fit: fit_neus}[module]
    chance = torch.Generator().manual_seed(0)
    stereo = unmatched(views)
    given = (views, true_region(), stereo, SMALL[module])
    return fit(*given, device=CPU, generator=chance, progress=no_progress)


def taken_back(surface: Surface) -> int:
    """As the report says it."""
    choices = " ".join(decision.choice for decision in surface.decisions)
    found = re.search(r"rays, (\d+) of which (?:was|were) not finite and taken back", choices)
    return int(found[1]) if found else 0


@pytest.mark.parametrize("module", FITS)
def test_a_step_that_is_no_number_is_told_and_the_others_count(
    module: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loss of the twentieth step; taken plainly, it leaves nothing."""
    loss, calls = getattr(module, LOSS[module]), count(1)

    def planted(*given: object) -> Tensor:
        return loss(*given) * (math.nan if next(calls) == 20 else 1.0)

    good = learned(module, scene().views)
    assert taken_back(good) == 0
    monkeypatch.setattr(module, LOSS[module], planted)
    surface = learned(module, scene().views)
    assert np.isfinite(surface.distance).all()
    assert taken_back(surface) == 1
    assert next(calls) == 41
    calls = count(1)
    monkeypatch.setattr(module, "SafeSteps", PlainSteps)
    with pytest.raises(ReconstructionError):
        learned(module, scene().views)


@pytest.mark.parametrize(("module", "masks"), [(radiance_fit, True), (radiance_fit, False), (neus_fit, True)])
def test_a_pixel_that_is_no_number_costs_two_steps(
    module: ModuleType, masks: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One on the body in the first photograph; two of the forty steps draw it.

    Taken plainly they leave nothing of a radiance field. NeuS survives: the slope of |x| is 0 where x is no
    number, so only the loss shows it.
    """
    views = spoiled(slice(15, 16), slice(41, 42))
    views = views if masks else tuple(replace(view, mask=None) for view in views)
    surface = learned(module, views)
    assert np.isfinite(surface.distance).all()
    assert taken_back(surface) == 2
    if module is radiance_fit:
        monkeypatch.setattr(module, "SafeSteps", PlainSteps)
        with pytest.raises(ReconstructionError):
            learned(module, views)


@pytest.mark.parametrize("module", FITS)
def test_networks_that_learn_nothing_but_what_is_no_number_are_an_error(module: ModuleType) -> None:
    with pytest.raises(ReconstructionError, match="Nothing could be learned from the photographs") as raised:
        learned(module, spoiled(slice(None), slice(None)))
    assert raised.value.code == ErrorCode.NO_SURFACE


# SparseCraft's points


def sparse_crafted() -> Surface:
    """Forty steps with points."""
    config = TINY_NETWORKS["sparsecraft"]
    assert isinstance(config, NeusConfig)
    given = (scene().views, true_region(), stereo(), replace(config, steps=40))
    chance = torch.Generator().manual_seed(0)
    return fit_neus(*given, device=CPU, generator=chance, progress=no_progress)


@pytest.mark.parametrize("name", ["loss", "colours", "normals"])
def test_points_that_are_no_numbers_in_one_step_are_told_and_the_others_count(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the twentieth step, every second of them, or the loss; that, taken plainly, leaves nothing."""
    loss, calls = neus_fit.point_loss, count(1)

    def planted(surface: NeuralSurface, measured: MeasuredPoints, *others: Any) -> Tensor:
        wrong = next(calls) == 20
        if wrong and name != "loss":
            values = getattr(measured, name).clone()
            values[::2] = math.nan
            measured = replace(measured, **{name: values})
        found = loss(surface, measured, *others)
        return found * math.nan if wrong and name == "loss" else found

    assert taken_back(sparse_crafted()) == 0
    monkeypatch.setattr(neus_fit, "point_loss", planted)
    surface = sparse_crafted()
    assert np.isfinite(surface.distance).all()
    assert taken_back(surface) == 1
    assert next(calls) == 41
    if name == "loss":
        calls = count(1)
        monkeypatch.setattr(neus_fit, "SafeSteps", PlainSteps)
        with pytest.raises(ReconstructionError):
            sparse_crafted()


def test_points_none_of_which_is_a_number_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    measured = neus_fit.measured_points

    def planted(given: Measurements) -> MeasuredPoints:
        points = measured(given)
        return replace(points, colours=torch.full_like(points.colours, math.nan))

    monkeypatch.setattr(neus_fit, "measured_points", planted)
    with pytest.raises(ReconstructionError, match="Nothing could be learned from the photographs") as raised:
        sparse_crafted()
    assert raised.value.code == ErrorCode.NO_SURFACE


# the steps alone


def descent() -> tuple[Tensor, torch.optim.Optimizer]:
    place = torch.tensor([1.0, -2.0], requires_grad=True)
    return place, torch.optim.Adam([place], lr=0.1)


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
def test_a_plain_step_is_lost_for_ever_and_a_safe_one_goes_back(wrong: float) -> None:
    place, optimiser = descent()
    (wrong * place).sum().backward()
    optimiser.step()
    assert not place.isfinite().all()

    place, optimiser = descent()
    safe = SafeSteps(optimiser)
    safe.take(place.square().sum())
    safe.keep()
    good = place.detach().clone()
    safe.take(place.square().sum())
    assert not torch.equal(place, good)
    safe.take((wrong * place).sum())
    assert torch.equal(place, good)
    assert (safe.taken_back, safe.hopeless) == (1, False)
    safe.take(place.square().sum())
    step = (place - good).detach()
    torch.testing.assert_close(
        step, torch.tensor([-0.05, 0.05])
    )  # Adam's first step is its rate, here a half


def test_a_finite_loss_with_a_gradient_that_is_none_is_noticed() -> None:
    """sqrt(0) = 0, and its slope is infinite."""
    place = torch.zeros(2, requires_grad=True)
    safe = SafeSteps(torch.optim.Adam([place]))
    safe.take(place.square().sum().sqrt())
    assert safe.taken_back == 1
    assert (place == 0).all()


def test_long_gradients_are_cut_and_endless_ones_are_noticed() -> None:
    """Plain descent by 0.1 of a gradient of 50, cut to 10, of a short one, and of one without end."""
    place = torch.tensor([30.0, 40.0], requires_grad=True)
    safe = SafeSteps(torch.optim.SGD([place], lr=0.1), longest=10.0)
    safe.take(place.square().sum() / 2)
    torch.testing.assert_close(place.detach(), torch.tensor([29.4, 39.2]))
    safe.take((0.1 * place).sum())
    torch.testing.assert_close(place.detach(), torch.tensor([29.39, 39.19]))
    safe.take((place * math.inf).sum())
    torch.testing.assert_close(place.detach(), torch.tensor([30.0, 40.0]))
    assert (safe.steps, safe.taken_back) == (3, 1)


def test_after_a_few_of_them_there_is_no_hope() -> None:
    place, optimiser = descent()
    safe = SafeSteps(optimiser)
    for _ in range(PATIENCE):
        assert not safe.hopeless
        safe.take(place.sum() * math.nan)
    assert safe.hopeless


def test_safe_steps_are_the_optimiser_s() -> None:
    place, optimiser = descent()
    plain, plain_optimiser = descent()
    safe = SafeSteps(optimiser)
    for step in range(10):
        safe.take(place.square().sum(), length=0.9**step)
        plain_optimiser.param_groups[0]["lr"] = 0.1 * 0.9**step
        plain_optimiser.zero_grad()
        plain.square().sum().backward()
        plain_optimiser.step()
    assert torch.equal(place, plain)
