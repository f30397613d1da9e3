"""Emission and absorption: from densities of hardly anything to opaque, against float64."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain

import pytest
import torch
from torch import Tensor

from backend.maths.losses import silhouette
from backend.maths.radiance import composite, log_pass_of_density, mean_colour
from backend.maths.volume import blending_weights, log_transparency
from tests.stability.sweep import Errors, Sweep, check, gradient, largest

SAMPLES = (1, 2, 3, 16, 64, 256, 1024, 4096)
LAST_EDGES = (1e10, 1e30)
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


Cases = dict[str, list[Tensor]]


def optical_depths() -> Cases:
    """Rays of 1 to 4096 intervals: one density, one length all along, from 1e-8 to 1e8; and hard mixtures."""
    scales = 10.0 ** torch.arange(-16, 17)
    cases: Cases = {
        "even, up to 1024 samples": [scales[:, None].expand(-1, count) for count in SAMPLES[:-1]],
        "even, 4096 samples": [scales[:, None].expand(-1, 4096)],
        "mixed, with lengths of 0": [],
        "opaque first": [],
        "opaque amid": [],
        "empty": [torch.zeros((1, count)) for count in SAMPLES],
    }
    generator = torch.Generator().manual_seed(0)
    for count in SAMPLES:
        density = 10 ** (16 * torch.rand((64, count), generator=generator) - 8)
        length = 10 ** (8 * torch.rand((64, count), generator=generator) - 8)
        length[torch.rand((64, count), generator=generator) < 0.2] = 0
        cases["mixed, with lengths of 0"].append(density * length)
        opaque_first = (0.5 / count) * torch.rand((8, count), generator=generator)
        opaque_first[:, 0] = 1e8
        cases["opaque first"].append(opaque_first)
        cases["opaque amid"].append(opaque_first.roll(count // 2, dims=-1))
    return cases


def thin_optical_depths() -> Cases:
    """Together up to 1e-6 of the light is absorbed."""
    return {
        f"{count} samples": [scale / count * torch.ones((1, count)) for scale in (1e-10, 1e-8, 1e-6)]
        for count in SAMPLES
    }


def densities_and_edges() -> dict[str, list[tuple[Tensor, Tensor]]]:
    """Densities of 1e-8 to 1e8 between edges from 0.5 to 3.5, an even or an uneven length apart, or none.

    Also with a last interval to 1e10 and 1e30, as where a ray has no end.
    """
    generator = torch.Generator().manual_seed(3)
    cases: dict[str, list[tuple[Tensor, Tensor]]] = {}
    for count in (1, 64, 4096):
        even = torch.linspace(0.5, 3.5, count + 1).expand(8, -1)
        drawn = 0.5 + 3 * torch.rand((8, count + 1), generator=generator).sort(dim=-1).values
        drawn[:, 1::3] = drawn[:, 0:-1:3]  # every third interval has no length
        density = 10 ** (16 * torch.rand((8, count), generator=generator) - 8)
        thin = 10 ** (8 * torch.rand((8, count), generator=generator) - 8) / count
        opaque_first, opaque_amid = thin.clone(), thin.clone()
        opaque_first[:, 0] = opaque_amid[:, [count // 2, 3 * count // 4]] = 1e8
        for name, values, edges in (
            (f"thin, {count} samples", thin, even),
            ("empty", torch.zeros_like(thin), even),
            ("opaque first", opaque_first, even),
            ("opaque amid", opaque_amid, even),
            ("mixed, with lengths of 0", density, drawn),
        ):
            cases.setdefault(name, []).append((values, edges))
        for last in LAST_EDGES if count > 1 else ():
            endless = [
                torch.cat([edges[:, :-1], torch.full((8, 1), last)], dim=-1) for edges in (even, drawn)
            ]
            given = [(values, endless[0]) for values in (thin, opaque_amid)]
            cases.setdefault(f"last edge at {last:g}", []).extend([*given, (density, endless[1])])
    return cases


def colours(like: Tensor) -> Tensor:
    return torch.rand(like.shape, generator=torch.Generator().manual_seed(1))


def weight_error(weights: Weights, cases: Cases) -> Errors:
    return {
        name: max(largest(weights(depth), ours(depth.double())) for depth in depths)
        for name, depths in cases.items()
    }


def relative_opacity_error(weights: Weights, cases: Cases) -> Errors:
    """Of the sum of weights, in shares of it."""

    def error(depth: Tensor) -> float:
        opacity = -torch.expm1(-depth.double().sum(dim=-1))
        return largest(weights(depth).sum(dim=-1), opacity, opacity)

    return {name: max(map(error, depths)) for name, depths in cases.items()}


def gradient_error(weights: Weights, cases: Cases) -> Errors:
    """Of a pixel's colour by the optical depths, in shares of the largest colour."""

    def error(depth: Tensor) -> float:
        colour = colours(depth)
        found = gradient(lambda x: weights(x) * colour, depth)
        return largest(found, gradient(lambda x: ours(x) * colour, depth.double()))

    return {name: max(map(error, depths)) for name, depths in cases.items()}


# a pixel from densities, edges, colours and background


@dataclass(frozen=True, kw_only=True)
class Ray:
    """What a pixel is made of; gradients are asked by each of it."""

    density: Tensor
    edges: Tensor
    colour: Tensor
    background: Tensor

    def of(self, dtype: torch.dtype) -> "Ray":
        given = (self.density, self.edges, self.colour, self.background)
        density, edges, colour, background = (x.detach().to(dtype).requires_grad_() for x in given)
        return Ray(density=density, edges=edges, colour=colour, background=background)


Pixel = Callable[[Ray], Tensor]


def our_pixel(ray: Ray) -> Tensor:
    return composite(log_pass_of_density(ray.density, ray.edges), ray.colour, ray.background)


def usual_pixel(weights: Weights) -> Pixel:
    """By other weights; the background gets what they leave."""

    def pixel(ray: Ray) -> Tensor:
        found = weights(ray.density * ray.edges.diff(dim=-1))
        left = 1 - found.sum(dim=-1, keepdim=True)
        return (found[..., None] * ray.colour).sum(dim=1) + left * ray.background

    return pixel


def rays() -> dict[str, list[Ray]]:
    return {
        name: [
            Ray(
                density=density,
                edges=edges,
                colour=torch.rand((*density.shape, 3), generator=torch.Generator().manual_seed(4)),
                background=torch.rand((len(density), 3), generator=torch.Generator().manual_seed(5)),
            )
            for density, edges in cases
        ]
        for name, cases in densities_and_edges().items()
    }


def slopes(pixel: Pixel, ray: Ray, dtype: torch.dtype) -> tuple[Tensor, ...]:
    """Of the sum of a pixel's channels by density, edges, colour and background."""
    given = ray.of(dtype)
    return torch.autograd.grad(
        pixel(given).sum(), (given.density, given.edges, given.colour, given.background)
    )


def relative(found: Tensor, exact: Tensor, digits: Tensor) -> float:
    """In shares of the exact, which is none below 1e-30."""
    there = exact > 1e-30
    found, exact = torch.where(there, found, 0.0), torch.where(there, exact, 0.0)
    return largest(found, exact, digits * exact.clamp(min=1e-30))


def density_and_edge_error(pixel: Pixel) -> Errors:
    """Of the gradients by densities and edges, in shares of the interval and the largest density."""

    def error(ray: Ray) -> float:
        by_density, by_edge, *_ = slopes(pixel, ray, torch.float32)
        exact_by_density, exact_by_edge, *_ = slopes(our_pixel, ray, torch.float64)
        length = ray.edges.double().diff(dim=-1).clamp(min=1e-4)
        density = ray.density.double().amax(dim=-1, keepdim=True).clamp(min=1e-8)
        return max(largest(by_density, exact_by_density, length), largest(by_edge, exact_by_edge, density))

    return {name: max(map(error, of_name)) for name, of_name in rays().items()}


def colour_and_background_error(pixel: Pixel) -> Errors:
    """Of the gradients by colours and background, which are weights and what passes, in shares of them.

    As a multiple of 1 + optical depth, to whose last digit an exponential is known; where 1e-30 is left.
    """

    def error(ray: Ray) -> float:
        *_, by_colour, by_background = slopes(pixel, ray, torch.float32)
        *_, weight, through = slopes(our_pixel, ray, torch.float64)
        upto = (ray.density.double() * ray.edges.double().diff(dim=-1)).cumsum(dim=-1)
        before = torch.nn.functional.pad(upto[:, :-1], (1, 0))[..., None]
        return max(
            relative(by_colour, weight, 1 + before), relative(by_background, through, 1 + upto[:, -1:])
        )

    return {name: max(map(error, of_name)) for name, of_name in rays().items()}


# a pixel of what is opaque alone


def our_mean_colour(depth: Tensor, colour: Tensor) -> Tensor:
    """As the default has it: what is behind has no part, and a ray of little opacity is darker."""
    return mean_colour(-depth, colour)


def plain_mean_colour(depth: Tensor, colour: Tensor) -> Tensor:
    """Over the opacity as it is."""
    weights = by_running_product(depth)
    return torch.einsum("ri,ric->rc", weights, colour) / weights.sum(dim=-1)[:, None]


def mean_colour_error(mean_colour: Callable[[Tensor, Tensor], Tensor]) -> Errors:
    """Of the value and, in shares of its largest size, of the gradient by optical depths.

    Against the same in float64, with 8 intervals to a ray as the default has them.
    """
    cases = {
        "empty": [0.0],
        "faint": [1e-12, 1e-8, 1e-6, 1e-4],
        "some": [1e-2, 0.3, 1.0, 5.0],
        "opaque": [1e8],
    }
    share = torch.rand((16, 8), generator=torch.Generator().manual_seed(6))
    share = share / share.sum(dim=-1, keepdim=True)
    colour = torch.rand((16, 8, 3), generator=torch.Generator().manual_seed(7))

    def error(depth: Tensor) -> float:
        found = gradient(lambda x: mean_colour(x, colour), depth)
        exact = gradient(lambda x: mean_colour(x, colour.double()), depth.double())
        size = exact.abs().max().clamp(min=1.0)
        value = largest(mean_colour(depth, colour), mean_colour(depth.double(), colour.double()))
        return max(value, largest(found, exact, size))

    return {name: max(error(depth * share) for depth in depths) for name, depths in cases.items()}


# masks


def plain_cross_entropy(log_pass: Tensor, coverage: Tensor) -> Tensor:
    """Of the opacity as the sum of weights, with no bound."""
    opacity = by_running_product(-log_pass).sum(dim=-1)
    return -(coverage * opacity.log() + (1 - coverage) * (1 - opacity).log()).mean()


def mask_error(loss: Callable[[Tensor, Tensor], Tensor]) -> Errors:
    """Of the value, in shares of 1 + the depth, and of its derivative, in shares of the steepest, 1000."""
    cases = {"empty": 0.0, "1e-8": 1e-8, "1": 1.0, "50": 50.0, "opaque": 1e8}
    errors = {}
    for name, depth in cases.items():
        log_pass = torch.full((2, 64), -depth / 64)
        coverage = torch.tensor([0.0, 1.0])
        exact_pass = log_pass.double().sum(dim=-1)
        opacity = 1e-3 - torch.expm1(exact_pass) * (1 - 1e-3)
        exact = (-(1 - coverage) * exact_pass - coverage * opacity.log()).mean()
        found = gradient(lambda x, c=coverage: loss(x, c), log_pass)
        by_pass = -(1 - coverage) + coverage * (1 - 1e-3) * exact_pass.exp() / opacity
        errors[name] = max(
            largest(loss(log_pass, coverage), exact, 1 + depth),
            largest(found, (0.5 * by_pass)[:, None].expand_as(found), 1e3),
        )
    return errors


def our_mask_loss(log_pass: Tensor, coverage: Tensor) -> Tensor:
    return silhouette(log_transparency(log_pass), coverage)


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
        usual_holds=("even, up to 1024 samples", "even, 4096 samples", "opaque first", "empty"),
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
        usual_holds=("empty",),
    ),
    Sweep(
        what="gradient by densities and ends of intervals, in shares of its length and largest density",
        usual_formula="running sum of log(1 - alpha)",
        usual=lambda: density_and_edge_error(usual_pixel(by_logs_of_alpha)),
        ours=lambda: density_and_edge_error(our_pixel),
        tolerance=2e-6,
        usual_holds=("thin, 1 samples", "thin, 64 samples", "empty"),
    ),
    Sweep(
        what="gradient by colours and background, relative to it and 1 + optical depth",
        usual_formula="alpha = 1 - exp(-x), running product; the background gets 1 - sum of weights",
        usual=lambda: colour_and_background_error(usual_pixel(by_running_product)),
        ours=lambda: colour_and_background_error(our_pixel),
        tolerance=1e-6,
        usual_holds=("empty", "opaque first"),
    ),
    Sweep(
        what="mean colour of what is opaque and its gradient by optical depths of 0 to 1e8",
        usual_formula="running product of 1 - alpha + 1e-10, over the opacity as it is",
        usual=lambda: mean_colour_error(plain_mean_colour),
        ours=lambda: mean_colour_error(our_mean_colour),
        tolerance=1e-6,
        usual_holds=("opaque",),
    ),
    Sweep(
        what="cross-entropy of opacity and mask and its derivative, optical depth 0 to 1e8",
        usual_formula="logs of the sum of weights and of what it leaves",
        usual=lambda: mask_error(plain_cross_entropy),
        ours=lambda: mask_error(our_mask_loss),
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
    for depth in chain(*optical_depths().values()):
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
