"""Gradient steps: no seed leads to a number that is not one, and a planted one is noticed and taken back."""

import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from backend.errors import ErrorCode, ReconstructionError
from backend.scene import Decision, Region, View, no_progress
from backend.stages.deadline import deadline_after
from backend.stages.measurements import carried, measurements
from backend.stages.neus_fit import NeusConfig, fit_neus
from backend.stages.radiance_fit import RadianceConfig, fit_radiance
from backend.stages.render_fit import Refined, RenderConfig, refine
from backend.stages.safe_steps import PATIENCE, SafeSteps
from backend.stages.stereo import StereoResult, match_views, unmatched
from backend.stages.stereo_config import StereoConfig
from backend.stages.train import Surface, TrainConfig, fit_surface
from tests.synthetic_scene import Scene, photographed, ring_cameras, true_region

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
    config = TrainConfig(levels=(NODES,), rounds=(1,), steps=(steps,), render=FEW)
    chance = torch.Generator().manual_seed(0)
    return fit_surface(
        views, true_region(), stereo(), config, device=CPU, generator=chance, progress=no_progress
    )


@cache
def linear() -> Surface:
    """The field before any gradient step."""
    return fitted(scene().views, 0)


def rendered(views: tuple[View, ...], steps: int, seed: int = 0) -> Refined:
    frame = Region(object_from_world=linear().grid_from_world)
    measured = carried(measurements(views, true_region(), stereo(), CPU), views, true_region(), frame)
    chance = torch.Generator().manual_seed(seed)
    never = deadline_after(None, time.perf_counter)
    return refine(measured, torch.from_numpy(linear().distance), steps, FEW, chance, no_progress, never)


def spoiled(rows: slice, columns: slice) -> tuple[View, ...]:
    """The photographs, with pixels of the first that are no numbers."""
    first, *others = scene().views
    image = first.image_srgb.copy()
    image[rows, columns] = np.nan
    return (replace(first, image_srgb=image), *others)


def moved(field: Refined) -> float:
    return float((field.distance - torch.from_numpy(linear().distance)).abs().max())


def told(surface: Surface) -> Decision:
    (found,) = (d for d in surface.decisions if d.what == "refinement by rendering")
    return found


@pytest.mark.slow
def test_no_seed_leads_to_what_is_not_a_number() -> None:
    """A hundred runs that differ in rays, queries and the network's start; none moves a node by a cell."""
    for seed in range(100):
        field = rendered(scene().views, 3, seed)
        assert (field.steps, field.taken_back) == (3, 0)
        assert 0 < moved(field) < CELL


def test_a_few_pixels_that_are_no_numbers_cost_a_few_steps() -> None:
    one_pixel = spoiled(slice(20, 21), slice(30, 31))
    with_it, without = rendered(one_pixel, 40), rendered(scene().views, 40)
    assert with_it.steps == 40
    assert 0 < with_it.taken_back < PATIENCE
    assert with_it.distance.isfinite().all()
    apart = float((with_it.distance - without.distance).abs().max())
    assert apart < 0.5 * moved(without), "what was learnt ten steps before is kept"
    because = told(fitted(one_pixel, 40)).because
    assert because.startswith(f"the preset; {with_it.taken_back} steps led to numbers that are not finite")


def test_photographs_without_numbers_leave_the_field_as_it_was() -> None:
    surface = fitted(spoiled(slice(None), slice(None)), 40)
    np.testing.assert_array_equal(surface.distance, linear().distance)
    assert told(surface).choice == "left out"
    assert told(surface).because.startswith(f"{PATIENCE} steps led to numbers that are not finite")


# networks learned by rendering


def learned(fit: Callable[..., Surface], views: tuple[View, ...]) -> Surface:
    """A radiance field, or NeuS, of hardly any steps."""
    small = (
        RadianceConfig(steps=6, rays=64, nodes=24) if fit is fit_radiance else NeusConfig(steps=6, nodes=24)
    )
    chance = torch.Generator().manual_seed(0)
    return fit(
        views, true_region(), unmatched(views), small, device=CPU, generator=chance, progress=no_progress
    )


@pytest.mark.parametrize("fit", [fit_radiance, fit_neus])
def test_networks_that_learn_nothing_but_what_is_no_number_are_an_error(fit: Callable[..., Surface]) -> None:
    with pytest.raises(ReconstructionError, match="Nothing could be learned from the photographs") as raised:
        learned(fit, spoiled(slice(None), slice(None)))
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
