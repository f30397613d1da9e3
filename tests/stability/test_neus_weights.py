"""From signed distances to weights: sharpness from 1 to 1e5, and every way that a ray can meet a surface."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from backend.maths.volume import (
    annealed_slope,
    blending_weights,
    log_transmittance,
    log_transmittance_of_middles,
    log_transparency,
)
from tests.stability.sweep import Sweep, check, gradient, largest

SHARPNESS = tuple(10.0**k for k in range(6))
COUNTS = (2, 16, 128, 1024)
Alpha = Callable[[Tensor, float], Tensor]
"""From distances at the edges of intervals, and the sharpness, to the intervals' opacities."""


# what many programs do


def published_alpha(distance: Tensor, sharpness: float) -> Tensor:
    """NeuS's published program, with its epsilons."""
    phi = torch.sigmoid(sharpness * distance)
    before, after = phi[:, :-1], phi[:, 1:]
    return ((before - after + 1e-5) / (before + 1e-5)).clamp(0, 1)


def quotient(distance: Tensor, sharpness: float) -> Tensor:
    """NeuS, eq. 13, as it is written."""
    phi = torch.sigmoid(sharpness * distance)
    return ((phi[:, :-1] - phi[:, 1:]) / phi[:, :-1]).clamp(min=0)


def weights_of(alpha: Tensor) -> Tensor:
    reaching = torch.cumprod(torch.nn.functional.pad(1 - alpha + 1e-7, (1, 0), value=1.0), dim=-1)
    return alpha * reaching[:, :-1]


def ours(distance: Tensor, sharpness: float) -> Tensor:
    return blending_weights(log_transmittance(distance, sharpness))


# the cases: distances along rays through scenes of size 1, ray by ray


def along(count: int, first: float = 0.0, last: float = 3.0) -> Tensor:
    return torch.linspace(first, last, count + 1)


def towards_a_ball(count: int) -> Tensor:
    """A ball of radius 0.5 after 1.5, by rays from straight on to grazing and past it."""
    beside = torch.tensor([0.0, 0.3, 0.49, 0.4999, 0.5, 0.5001, 0.51, 0.7])
    return torch.hypot(along(count) - 1.5, beside[:, None]) - 0.5


def two_surfaces(count: int) -> Tensor:
    t = along(count)
    return torch.minimum((t - 0.8).abs() - 0.2, (t - 2.2).abs() - 0.3)[None]


def thin_shells(count: int) -> Tensor:
    """Sheets of a thousandth to a tenth of the scene."""
    half = torch.tensor([5e-4, 2e-3, 1e-2, 5e-2])
    return (along(count) - 1.5).abs() - half[:, None]


FROM_OUTSIDE = {"a ball": towards_a_ball, "two surfaces": two_surfaces, "thin shells": thin_shells}


def from_inside(count: int) -> Tensor:
    """Out of a ball that the ray starts in, through its middle and beside it."""
    return torch.hypot(along(count) - 0.2, torch.tensor([[0.0], [0.2]])) - 0.5


def far_behind(count: int) -> Tensor:
    """Deeper and deeper inside."""
    return -along(count, 0.1, 2.0)[None]


def free_space(count: int) -> Tensor:
    """Past a wall at 1/20 to 1, along it, towards it, and away from it."""
    t = along(count, 0.0, 1.0)
    apart = torch.tensor([0.05, 0.2, 1.0])[:, None]
    return torch.cat([apart + 0 * t, apart + 1 - t, apart + t])


def weight_error(weights: Alpha, exact: Alpha | None = None) -> float:
    """Largest, of rays from outside; those from inside are measured by what intervals absorb."""
    worst = 0.0
    for case in FROM_OUTSIDE.values():
        for count in COUNTS:
            distance = case(count)
            for s in SHARPNESS:
                worst = max(worst, largest(weights(distance, s), (exact or ours)(distance.double(), s)))
    return worst


def gradient_error(weights: Callable[[Tensor, float], Tensor]) -> float:
    """Of a pixel's colour by the distances times the sharpness: by the logits."""
    worst = 0.0
    for case in FROM_OUTSIDE.values():
        for count in COUNTS:
            distance = case(count)
            colour = torch.rand((1, count), generator=torch.Generator().manual_seed(1))
            for s in SHARPNESS:
                found = gradient(lambda f, s=s, c=colour: weights(f, s) * c, distance) / s
                exact = gradient(lambda f, s=s, c=colour: ours(f, s) * c, distance.double()) / s
                worst = max(worst, largest(found, exact))
    return worst


def fog(alpha: Alpha) -> float:
    """Largest share of light lost on 1024 samples where the true one is less than e^-50."""
    distance = free_space(1024)
    lost = 0.0
    for s in (1e3, 1e4, 1e5):
        lost = max(lost, float((1 - (1 - alpha(distance, s).double()).prod(dim=-1)).max()))
    return lost


def inside_error(alpha: Alpha) -> dict[str, float]:
    """Of the opacity of intervals deep inside, entered (opaque at speed) or left (clear)."""

    def error(distance: Tensor, s: float) -> float:
        exact = -torch.expm1(log_transmittance(distance.double(), s))
        # float32 holds the logit to its last digit, and the opacity no better
        return largest(alpha(distance, s), exact, 1 + s * distance.abs().max().double())

    cases = (far_behind(1024), from_inside(1024))
    return {f"sharpness {s:g}": max(error(distance, s) for distance in cases) for s in SHARPNESS}


def our_alpha(distance: Tensor, sharpness: float) -> Tensor:
    return -torch.expm1(log_transmittance(distance, sharpness))


def from_middles(distance: Tensor, sharpness: float) -> Tensor:
    """Weights from distance and slope in the middles of intervals, as NeuS has them in practice."""
    single = distance.float()  # so that both precisions are given the same
    edges = along(distance.shape[-1] - 1).expand_as(single)
    middle, slope = (single[:, 1:] + single[:, :-1]) / 2, single.diff(dim=-1) / edges.diff(dim=-1)
    middle, slope, edges = (given.to(distance.dtype) for given in (middle, slope, edges))
    return blending_weights(log_transmittance_of_middles(middle, slope, edges, sharpness))


Pass = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
"""From distance, slope, edges and sharpness to the logs of the light that passes the intervals."""


def pass_of_middles(distance: Tensor, slope: Tensor, edges: Tensor, sharpness: Tensor) -> Tensor:
    return log_transmittance_of_middles(distance, slope, edges, sharpness)


def published_pass_of_middles(distance: Tensor, slope: Tensor, edges: Tensor, sharpness: Tensor) -> Tensor:
    """Of NeuS's published program; its opacities are asked for by their logs here."""
    rise = 0.5 * slope * edges.diff(dim=-1)
    before, after = (torch.sigmoid(sharpness * x) for x in (distance - rise, distance + rise))
    alpha = ((before - after + 1e-5) / (before + 1e-5)).clamp(0, 1)
    return torch.log(1 - alpha + 1e-7)


def middles_gradient_error(log_pass: Pass) -> dict[str, float]:
    """Of a pixel's colour by distance and slope, in logits, and by the log of the sharpness.

    One unit of the first two moves a logit by 1, of the third all of them by a multiple of themselves.
    """
    return {
        f"{name}, {done:g} of the annealing": max(
            middles_slope_error(log_pass, case(count), s, done) for count in COUNTS for s in SHARPNESS
        )
        for name, case in {**FROM_OUTSIDE, "from inside": from_inside, "far behind": far_behind}.items()
        for done in (0.0, 0.5, 1.0)
    }


def middles_slope_error(log_pass: Pass, distance: Tensor, sharpness: float, done: float) -> float:
    edges = along(distance.shape[-1] - 1).expand_as(distance)
    middle, slope = (distance[:, 1:] + distance[:, :-1]) / 2, distance.diff(dim=-1) / edges.diff(dim=-1)
    colour = torch.rand((1, middle.shape[-1]), generator=torch.Generator().manual_seed(1))

    def slopes(passing: Pass, dtype: torch.dtype) -> tuple[Tensor, ...]:
        given = [x.to(dtype).requires_grad_() for x in (middle, slope, torch.tensor(sharpness))]
        annealed = annealed_slope(given[1], done)
        logs = passing(given[0], annealed, edges.to(dtype), given[2])
        return torch.autograd.grad((blending_weights(logs) * colour.to(dtype)).sum(), given)

    units = (sharpness, sharpness * float(edges.diff(dim=-1).max()), len(middle) / sharpness)
    found, exact = slopes(log_pass, torch.float32), slopes(pass_of_middles, torch.float64)
    return max(largest(one, other, unit) for one, other, unit in zip(found, exact, units, strict=True))


SWEEPS = (
    Sweep(
        what="NeuS weights, sharpness 1 to 1e5, 2 to 1024 samples, from outside",
        usual_formula="(Phi_i - Phi_i+1 + 1e-5) / (Phi_i + 1e-5), as published",
        usual=lambda: weight_error(lambda f, s: weights_of(published_alpha(f, s))),
        ours=lambda: weight_error(ours),
        tolerance=1e-6,
    ),
    Sweep(
        what="the same from distance and slope in the middles of intervals",
        usual_formula="as published, with epsilons",
        usual=lambda: weight_error(lambda f, s: weights_of(published_alpha(f, s)), from_middles),
        ours=lambda: weight_error(from_middles),
        tolerance=1e-3,  # a quarter of the logit's error, sharpness times half a digit of the distance
    ),
    Sweep(
        what="gradient of a pixel's colour by sharpness times distance",
        usual_formula="quotient of sigmoids",
        usual=lambda: gradient_error(lambda f, s: weights_of(quotient(f, s))),
        ours=lambda: gradient_error(ours),
        tolerance=1e-6,
    ),
    Sweep(
        what="gradient by distance, annealed slope and sharpness in the middles, in logits",
        usual_formula="as published, with epsilons",
        usual=lambda: middles_gradient_error(published_pass_of_middles),
        ours=lambda: middles_gradient_error(pass_of_middles),
        tolerance=2e-4,  # a few of the logit's last digits
    ),
    Sweep(
        what="light lost in free space, 1024 samples, sharpness 1e3 to 1e5",
        usual_formula="as published, with epsilons",
        usual=lambda: fog(published_alpha),
        ours=lambda: fog(our_alpha),
        tolerance=1e-6,
    ),
    Sweep(
        what="opacity of intervals far inside, sharpness 1 to 1e5, relative to 1 + sharpness times depth",
        usual_formula="as published, with epsilons",
        usual=lambda: inside_error(published_alpha),
        ours=lambda: inside_error(our_alpha),
        tolerance=1.2e-7,
    ),
)


@pytest.mark.parametrize("sweep", SWEEPS, ids=lambda sweep: sweep.what)
def test_sweep(sweep: Sweep) -> None:
    check(sweep)


@pytest.mark.parametrize("sharpness", SHARPNESS)
@pytest.mark.parametrize("count", [2, 128, 1024])
def test_a_sheet_lets_through_what_it_should(sharpness: float, count: int) -> None:
    """The sum telescopes: Phi in the sheet's middle over Phi at the ray's start, at any number of samples."""
    distance = thin_shells(count)
    middle, first = distance[:, count // 2].double(), distance[:, 0].double()
    exact = torch.nn.functional.logsigmoid(sharpness * middle)
    exact -= torch.nn.functional.logsigmoid(sharpness * first)
    found = log_transparency(log_transmittance(distance, sharpness))
    assert largest(found, exact, 1 + exact.abs()) < 1e-6


@pytest.mark.parametrize("sharpness", SHARPNESS)
def test_weights_and_what_passes_are_all_the_light(sharpness: float) -> None:
    cases = (*FROM_OUTSIDE.values(), from_inside, far_behind, free_space)
    for distance in (case(count) for case in cases for count in COUNTS):
        log_pass = log_transmittance(distance, sharpness)
        through = log_transparency(log_pass).exp()
        assert (blending_weights(log_pass).sum(dim=-1) - (1 - through)).abs().max() < 1e-6
        assert gradient(lambda f: ours(f, sharpness), distance).isfinite().all()


@pytest.mark.parametrize("sharpness", SHARPNESS)
def test_a_ray_that_leaves_from_inside_is_clear(sharpness: float) -> None:
    distance = along(1024, -1.0, 2.0)[None]
    assert (ours(distance, sharpness) == 0).all()
    assert published_alpha(distance, max(sharpness, 100))[0, 0] > 0.9, "with epsilons it is opaque"


def test_nothing_is_seen_of_what_lies_behind() -> None:
    distance = two_surfaces(1024)
    for s in (1e3, 1e4, 1e5):
        weights = ours(distance, s)
        assert weights[:, : 1024 // 2].sum() == pytest.approx(1.0, abs=1e-6)
        assert weights[:, 1024 // 2 :].abs().max() == 0


def test_far_behind_a_surface_the_distance_still_has_a_gradient() -> None:
    """Twenty widths inside the quotient of sigmoids is 0 / 0, and a wrong surface could never be moved."""
    distance = torch.tensor([[-0.2, -0.21, -0.215]])
    by_logs = gradient(lambda f: log_transparency(log_transmittance(f, 1e3)), distance)
    torch.testing.assert_close(by_logs, torch.tensor([[-1e3, 0.0, 1e3]]))
    assert not gradient(lambda f: quotient(f, 1e3), distance).isfinite().all()
