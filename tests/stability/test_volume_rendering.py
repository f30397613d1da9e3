"""Emission and absorption: from densities of hardly anything to opaque, against float64."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from backend.maths.volume import blending_weights, log_transparency
from tests.stability.sweep import Sweep, check, gradient, largest

SAMPLES = (1, 2, 3, 16, 64, 256, 1024, 4096)
Weights = Callable[[Tensor], Tensor]
"""From optical depths (density times length) of intervals to the weights of their colours."""


# what many programs do


def by_running_product(depth: Tensor) -> Tensor:
    """NeRF's published program, with its epsilon."""
    alpha = 1 - torch.exp(-depth)
    reaching = torch.cumprod(torch.nn.functional.pad(1 - alpha + 1e-10, (1, 0), value=1.0), dim=-1)
    return alpha * reaching[:, :-1]


def by_logs_of_alpha(depth: Tensor) -> Tensor:
    """A sum of log(1 - alpha), as packed implementations have it."""
    alpha = 1 - torch.exp(-depth)
    before = torch.log(1 - alpha).cumsum(dim=-1)
    return alpha * torch.exp(torch.nn.functional.pad(before[:, :-1], (1, 0)))


def by_all_less_the_own(depth: Tensor) -> Tensor:
    """An exclusive sum as the inclusive one less the own part."""
    return -torch.expm1(-depth) * torch.exp(-(depth.cumsum(dim=-1) - depth))


def ours(depth: Tensor) -> Tensor:
    return blending_weights(-depth)


# the cases


def optical_depths() -> list[Tensor]:
    """Rays of 1 to 4096 intervals: one density, one length all along, from 1e-8 to 1e8; and hard mixtures."""
    scales = 10.0 ** torch.arange(-16, 17)
    rays = [scales[:, None].expand(-1, count) for count in SAMPLES]
    generator = torch.Generator().manual_seed(0)
    for count in SAMPLES:
        density = 10 ** (16 * torch.rand((64, count), generator=generator) - 8)
        length = 10 ** (8 * torch.rand((64, count), generator=generator) - 8)
        length[torch.rand((64, count), generator=generator) < 0.2] = 0
        rays.append(density * length)
        opaque_first = (0.5 / count) * torch.rand((8, count), generator=generator)
        opaque_first[:, 0] = 1e8
        opaque_amid = opaque_first.roll(count // 2, dims=-1)
        rays += [opaque_first, opaque_amid, torch.zeros((1, count))]
    return rays


def thin_optical_depths() -> list[Tensor]:
    """Together up to 1e-6 of the light is absorbed."""
    return [scale / count * torch.ones((1, count)) for count in SAMPLES for scale in (1e-10, 1e-8, 1e-6)]


def colours(like: Tensor) -> Tensor:
    return torch.rand(like.shape, generator=torch.Generator().manual_seed(1))


def weight_error(weights: Weights, cases: list[Tensor]) -> float:
    return max(largest(weights(depth), ours(depth.double())) for depth in cases)


def relative_opacity_error(weights: Weights, cases: list[Tensor]) -> float:
    """Of the sum of weights, in shares of it."""
    exact = [-torch.expm1(-depth.double().sum(dim=-1)) for depth in cases]
    return max(
        largest(weights(depth).sum(dim=-1), opacity, opacity)
        for depth, opacity in zip(cases, exact, strict=True)
    )


def gradient_error(weights: Weights, cases: list[Tensor]) -> float:
    """Of a pixel's colour by the optical depths, in shares of the largest colour."""
    worst = 0.0
    for depth in cases:
        colour = colours(depth)
        found = gradient(lambda x, c=colour: weights(x) * c, depth)
        exact = gradient(lambda x, c=colour: ours(x) * c, depth.double())
        worst = max(worst, largest(found, exact))
    return worst


def log_transparency_error(transparency: Callable[[Tensor], Tensor]) -> float:
    """Of the log of the light that passes a ray of optical depth 1e-8 to 1e8, in shares of it."""
    depths = [(10.0 ** torch.arange(-8, 9) / count)[:, None].expand(-1, count) for count in SAMPLES]
    exact = [-depth.double().sum(dim=-1) for depth in depths]
    return max(largest(transparency(depth), log, log.abs()) for depth, log in zip(depths, exact, strict=True))


SWEEPS = (
    Sweep(
        what="weights, all cases",
        usual_formula="exclusive sum as all less the own",
        usual=lambda: weight_error(by_all_less_the_own, optical_depths()),
        ours=lambda: weight_error(ours, optical_depths()),
        tolerance=1e-6,
    ),
    Sweep(
        what="opacity of thin media (optical depth 1e-10 to 1e-6), relative",
        usual_formula="alpha = 1 - exp(-x), running product of 1 - alpha + 1e-10",
        usual=lambda: relative_opacity_error(by_running_product, thin_optical_depths()),
        ours=lambda: relative_opacity_error(ours, thin_optical_depths()),
        tolerance=1e-6,
    ),
    Sweep(
        what="gradient of a pixel's colour by the optical depths, all cases",
        usual_formula="running sum of log(1 - alpha)",
        usual=lambda: gradient_error(by_logs_of_alpha, optical_depths()),
        ours=lambda: gradient_error(ours, optical_depths()),
        tolerance=1e-6,
    ),
    Sweep(
        what="log of the light that passes, optical depth 1e-8 to 1e8, relative",
        usual_formula="log of 1 - sum of weights",
        usual=lambda: log_transparency_error(lambda x: torch.log(1 - by_running_product(x).sum(dim=-1))),
        ours=lambda: log_transparency_error(lambda x: log_transparency(-x)),
        tolerance=1e-6,
    ),
)


@pytest.mark.parametrize("sweep", SWEEPS, ids=lambda sweep: sweep.what)
def test_sweep(sweep: Sweep) -> None:
    check(sweep)


def test_weights_and_what_passes_are_all_the_light() -> None:
    """To 1e-6, whatever the densities and however many the samples."""
    for depth in optical_depths():
        weights = ours(depth)
        assert ((weights >= 0) & (weights <= 1)).all()
        through = log_transparency(-depth).exp()
        assert (weights.sum(dim=-1) - (1 - through)).abs().max() < 1e-6


def test_an_opaque_first_sample_takes_all_and_nothing_follows() -> None:
    depth = torch.tensor([[1e8, 0.3, 1e-8, 1e8, 0.0]])
    assert ours(depth).tolist() == [[1.0, 0.0, 0.0, 0.0, 0.0]]
    assert gradient(lambda x: ours(x) * colours(x), depth).abs().max() == 0


def test_an_empty_ray_is_clear_and_still_says_where_light_would_be_taken() -> None:
    """At zero density the gradient by an interval's optical depth is its colour."""
    depth = torch.zeros((1, 1024))
    assert (ours(depth) == 0).all()
    assert log_transparency(-depth).item() == 0
    torch.testing.assert_close(gradient(lambda x: ours(x) * colours(x), depth), colours(depth))


def test_intervals_without_length_take_nothing_however_dense() -> None:
    density, length = torch.full((1, 3), 1e8), torch.tensor([[0.0, 1e-9, 0.0]])
    weights = ours(density * length)
    assert weights[0, [0, 2]].tolist() == [0.0, 0.0]
    assert weights[0, 1].item() == pytest.approx(-math.expm1(-0.1), rel=1e-6)


def test_infinite_optical_depth_is_opaque_and_has_no_gradient() -> None:
    """A density and a length that are finite may have a product that is not."""
    depth = torch.tensor([[0.1, math.inf, 0.5]])
    weights = ours(depth)
    torch.testing.assert_close(weights, torch.tensor([[-math.expm1(-0.1), math.exp(-0.1), 0.0]]))
    assert gradient(ours, depth).isfinite().all()
