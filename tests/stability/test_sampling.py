"""Where rays are sampled, waves of coordinates, and pictures read at their borders."""

import math
from collections.abc import Callable, Iterator

import pytest
import torch
from torch import Tensor

from backend.maths.encoding import positional_encoding
from backend.maths.geometry import sample_image
from backend.maths.radiance import proposal_loss
from backend.maths.resampling import resample, strata
from tests.stability.sweep import Errors, Sweep, check, gradient, largest

INTERVALS = (2, 64, 1024)
FREQUENCIES = 16
Resampling = Callable[[Tensor, Tensor, Tensor], Tensor]
"""From a ray's edges, its intervals' weights and shares of them to positions."""


# resampling


def with_epsilons(edges: Tensor, weights: Tensor, shares: Tensor) -> Tensor:
    """NeRF's published program."""
    weights = weights + 1e-5
    below = (weights / weights.sum(dim=-1, keepdim=True)).cumsum(dim=-1)
    below = torch.nn.functional.pad(below, (1, 0))
    index = torch.searchsorted(below, shares.contiguous(), right=True)
    low, high = (index - 1).clamp(min=0), index.clamp(max=below.shape[-1] - 1)
    step = below.gather(-1, high) - below.gather(-1, low)
    t = (shares - below.gather(-1, low)) / torch.where(step < 1e-5, 1.0, step)
    return edges.gather(-1, low) + t * (edges.gather(-1, high) - edges.gather(-1, low))


def spikes() -> list[tuple[Tensor, Tensor, Tensor]]:
    """Edges, weights, and the one interval that has them: of any size; 0 or hardly any elsewhere."""
    cases = []
    for count in INTERVALS:
        edges = torch.linspace(0, 1, count + 1).expand(8, -1).contiguous()
        for size in (1e-44, 1e-38, 1e-20, 1e-5, 1e-2, 1.0):
            for floor in (0.0, 1e-12 * size):
                weights = torch.full((8, count), floor)
                where = torch.arange(8) * (count - 1) // 7
                weights[torch.arange(8), where] = size
                cases.append((edges, weights, where))
    return cases


def strayed(draw: Resampling) -> float:
    """Largest distance of a sample from the interval that has all but 1e-9 of the weight."""
    worst = 0.0
    for edges, weights, where in spikes():
        samples = draw(edges, weights, strata(8, 128, None, torch.device("cpu")))
        first, last = edges.gather(-1, where[:, None]), edges.gather(-1, where[:, None] + 1)
        worst = max(worst, largest(samples, samples.clamp(first, last)))
    return worst


def smooth_weights(count: int) -> tuple[Tensor, Tensor]:
    """Bells of several widths; the narrow ones are 0 everywhere but in one interval."""
    edges = torch.linspace(0, 1, count + 1).expand(6, -1).contiguous()
    width = 10.0 ** -torch.arange(6)[:, None] / 2
    middle = (edges[:, 1:] + edges[:, :-1]) / 2
    centre = middle[:, count // 3, None]
    return edges, torch.exp(-(((middle - centre) / width) ** 2)) / (1 + 50 * count)


def position_error(draw: Resampling) -> float:
    """Against the inverse in float64, told as the share of the weight between the two places."""
    worst = 0.0
    for count in INTERVALS:
        edges, weights = smooth_weights(count)
        shares = strata(6, 200, None, torch.device("cpu"))
        below = torch.nn.functional.pad(weights.double().cumsum(dim=-1), (1, 0))
        below = below / below[:, -1:]
        index = (torch.searchsorted(edges, draw(edges, weights, shares)) - 1).clamp(0, count - 1)
        samples = draw(edges, weights, shares).double()
        low, high = edges.double().gather(-1, index), edges.double().gather(-1, index + 1)
        t = (samples - low) / (high - low)
        reached = below.gather(-1, index) * (1 - t) + below.gather(-1, index + 1) * t
        worst = max(worst, largest(reached, shares))
    return worst


# waves


def plain_waves(x: Tensor) -> Tensor:
    """NeRF, eq. 4, as it is written."""
    waves = [x * (math.pi * 2.0**k) for k in range(FREQUENCIES)]
    return torch.cat([w.sin() for w in waves] + [w.cos() for w in waves], dim=-1)


def our_waves(x: Tensor) -> Tensor:
    return positional_encoding(x, FREQUENCIES)


def coordinates() -> Tensor:
    """In the box and up to eight times as far, also next to whole and half turns of every wave."""
    generator = torch.Generator().manual_seed(0)
    turns = torch.arange(-8, 9)[:, None] / 2.0 ** torch.arange(FREQUENCIES)
    near = torch.nextafter(turns.flatten(), torch.tensor(9.0))
    return torch.cat([16 * torch.rand(2000, generator=generator) - 8, turns.flatten(), near])[:, None]


def wave_error(waves: Callable[[Tensor], Tensor]) -> float:
    return largest(waves(coordinates()), plain_waves(coordinates().double()))


def wave_slope_error(waves: Callable[[Tensor], Tensor]) -> float:
    """Of the derivative of a mixture of all waves, in shares of the steepest wave's."""
    mixture = torch.randn(2 * FREQUENCIES, generator=torch.Generator().manual_seed(2))
    found = gradient(lambda x: waves(x) * mixture, coordinates())
    exact = gradient(lambda x: plain_waves(x) * mixture, coordinates().double())
    return largest(found, exact, math.pi * 2.0 ** (FREQUENCIES - 1))


# the proposal


def histograms() -> tuple[Tensor, Tensor]:
    """Weights from 0 over denormal ones to 1, and bounds from 0 to twice as large."""
    weights = torch.cat([torch.zeros(1), 10.0 ** torch.arange(-44, 1)])[:, None].expand(-1, 9)
    return weights, weights * torch.linspace(0, 2, 9)


def with_epsilon(weights: Tensor, bound: Tensor) -> Tensor:
    """mip-NeRF 360's published program."""
    return ((weights - bound).clamp(min=0).square() / (weights + 1e-7)).sum(dim=-1).mean()


def proposal_slope_error(loss: Callable[[Tensor, Tensor], Tensor]) -> float:
    """Of the derivative by the bound, -2 (1 - bound / w) where that is too small; finite for any weight."""
    weights, bound = histograms()
    found = gradient(lambda b: loss(weights, b), bound) * len(weights)
    exact = -2 * (1 - bound.double() / weights.double()).clamp(min=0)
    full = weights > 1e-37
    return max(largest(found[full], exact[full]), largest(found, found))


# pictures at their borders

Reading = Callable[[Tensor, Tensor], Tensor]
"""From a picture and pixels to values, as `sample_image`."""


def with_nothing_around(image: Tensor, pixels: Tensor) -> Tensor:
    """torch's own reading as it comes: beyond the border all is 0."""
    height, width = image.shape[1:]
    grid = pixels / pixels.new_tensor([width / 2, height / 2]) - 1
    return torch.nn.functional.grid_sample(image[None], grid, align_corners=False)


def border_error(read: Reading) -> Errors:
    """Of a ramp of 1 a pixel, in shares of the width: u + 1/2 up to the border, and the border's beyond."""
    errors = {}
    for width in (2, 3, 640, 6000):
        image = 1 + torch.arange(float(width)).expand(1, 2, width).contiguous()
        u = torch.cat([torch.linspace(-3, 3, 601), torch.linspace(width - 3, width + 3, 601)])
        pixels = torch.stack([u, torch.ones_like(u)], dim=-1)[None, None]
        exact = 1 + (u.double() - 0.5).clamp(0, width - 1)
        errors[f"{width} pixels"] = largest(read(image, pixels)[0, 0, 0], exact, width)
    return errors


SWEEPS = (
    Sweep(
        what="how far samples stray from a single spike of 1e-44 to 1, of the ray's length",
        usual_formula="weights + 1e-5, as published",
        usual=lambda: strayed(with_epsilons),
        ours=lambda: strayed(resample),
        tolerance=1e-6,
    ),
    Sweep(
        what="share of the weight between a sample and its place, 2 to 1024 intervals",
        usual_formula="weights + 1e-5, as published",
        usual=lambda: position_error(with_epsilons),
        ours=lambda: position_error(resample),
        tolerance=6e-5,  # half a digit of a position, 2^-24 of the ray, in the thousandth of it that weighs
    ),
    Sweep(
        what="derivative of the proposal's loss, weights from 0 to 1",
        usual_formula="(w - bound)^2 / (w + 1e-7), as published",
        usual=lambda: proposal_slope_error(with_epsilon),
        ours=lambda: proposal_slope_error(proposal_loss),
        tolerance=1e-6,
    ),
    Sweep(
        what=f"positional encoding, {FREQUENCIES} frequencies, coordinates up to 8",
        usual_formula="sin(2^k pi x)",
        usual=lambda: wave_error(plain_waves),
        ours=lambda: wave_error(our_waves),
        tolerance=1e-6,
    ),
    Sweep(
        what="its derivative, in shares of the highest frequency",
        usual_formula="sin(2^k pi x)",
        usual=lambda: wave_slope_error(plain_waves),
        ours=lambda: wave_slope_error(our_waves),
        tolerance=1e-5,
    ),
    Sweep(
        what="pictures of 2 to 6000 pixels read at and beyond their borders, in widths",
        usual_formula="nothing but 0 beyond the border",
        usual=lambda: border_error(with_nothing_around),
        ours=lambda: border_error(sample_image),
        tolerance=1e-6,
    ),
)


@pytest.mark.parametrize("sweep", SWEEPS, ids=lambda sweep: sweep.what)
def test_sweep(sweep: Sweep) -> None:
    check(sweep)


def by_their_sum(edges: Tensor, weights: Tensor, shares: Tensor) -> Tensor:
    """The inverse of a distribution function as it is written: weights over their sum."""
    below = torch.nn.functional.pad((weights / weights.sum(dim=-1, keepdim=True)).cumsum(dim=-1), (1, 0))
    index = (torch.searchsorted(below, shares, right=True) - 1).clamp(0, weights.shape[-1] - 1)
    low, high = below.gather(-1, index), below.gather(-1, index + 1)
    return edges.gather(-1, index).lerp(edges.gather(-1, index + 1), (shares - low) / (high - low))


@pytest.mark.parametrize("size", [0.0, 1e-45])
def test_without_weight_every_place_counts_alike(size: float) -> None:
    """Where weights are divided by their sum, 0 / 0 is no place at all."""
    edges = torch.linspace(0, 1, 1025)[None]
    shares = strata(1, 64, None, torch.device("cpu"))
    weights = torch.full((1, 1024), size)
    torch.testing.assert_close(resample(edges, weights, shares), shares)
    assert bool(by_their_sum(edges, weights, shares).isfinite().all()) == (size > 0)


@pytest.fixture
def _flushed() -> Iterator[None]:
    """Denormal numbers are taken for 0, as in every run on the CPU."""
    before = (torch.full((1,), 1e-39) * 0.5).item() == 0
    if not torch.set_flush_denormal(True):
        pytest.skip("this processor can not take denormal numbers for 0")
    yield
    torch.set_flush_denormal(before)


@pytest.mark.usefixtures("_flushed")
def test_spikes_where_denormal_numbers_are_flushed() -> None:
    """A denormal spike is no weight, and every place counts alike; others are met as exactly."""
    assert (torch.full((1,), 1e-44) * 0.5).item() == 0, "they are flushed"
    for edges, weights, where in spikes():
        shares = strata(8, 128, None, torch.device("cpu"))
        samples = resample(edges, weights, shares)
        if weights.max().item() < torch.finfo(torch.float32).tiny:
            torch.testing.assert_close(samples, shares, rtol=0, atol=1e-6)
        else:
            first, last = edges.gather(-1, where[:, None]), edges.gather(-1, where[:, None] + 1)
            assert largest(samples, samples.clamp(first, last)) < 1e-6
    assert strayed(with_epsilons) > 0.5
