"""Facts that any correct rendering of a signed distance must satisfy."""

from itertools import pairwise

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


def weights_one_by_one(distance: Tensor, sharpness: float) -> Tensor:
    """NeuS's definition, interval by interval, in float64: slow and plain."""
    light, weights = 1.0, []
    for before, after in pairwise(torch.sigmoid(sharpness * distance.double()).tolist()):
        alpha = max((before - after) / before, 0.0)
        weights.append(light * alpha)
        light *= 1.0 - alpha
    return torch.tensor(weights)


def test_matches_the_definition() -> None:
    distance = torch.randn(50, 9, generator=torch.Generator().manual_seed(0))
    expected = torch.stack([weights_one_by_one(row, 4.0) for row in distance])
    log_pass = log_transmittance(distance, 4.0)
    torch.testing.assert_close(blending_weights(log_pass), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("sharpness", "at", "alpha", "slope"),
    [
        (64.0, 0.20, 3.5e-7, -2.3e-5),
        (64.0, -0.20, 0.120, -2.0e-5),
        (512.0, -0.05, 0.641, -1.5e-9),
        (2048.0, -0.01, 0.983, -3e-7),
    ],
)
def test_hard_cases_where_the_quotient_of_sigmoids_fails(
    sharpness: float, at: float, alpha: float, slope: float
) -> None:
    """float32 against the quotient in float64; the numbers in the table are rounded to two places."""
    shift = torch.zeros(1, requires_grad=True)
    distance = (at + shift + torch.tensor([0.001, -0.001]))[None]
    weight = blending_weights(log_transmittance(distance, sharpness)).sum()
    (gradient,) = torch.autograd.grad(weight, shift)

    exact_shift = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    phi = torch.sigmoid(sharpness * (distance.detach().double() + exact_shift))[0]
    exact = (phi[0] - phi[1]) / phi[0]
    (exact_gradient,) = torch.autograd.grad(exact, exact_shift)

    assert weight.item() == pytest.approx(exact.item(), rel=1e-4)
    assert weight.item() == pytest.approx(alpha, rel=0.02)
    assert gradient.item() == pytest.approx(exact_gradient.item(), rel=0.01, abs=1e-6)
    assert exact_gradient.item() == pytest.approx(slope, rel=0.3)


@pytest.mark.parametrize("sharpness", [10.0, 100.0, 1e4])
def test_mean_depth_of_a_sphere_is_the_first_hit(sharpness: float) -> None:
    """Along the axis from z = -2 a sphere of radius 0.5 is first met after 1.5."""
    edges = torch.linspace(0, 4, 2001)
    weights = blending_weights(log_transmittance(((edges - 2).abs() - 0.5)[None], sharpness))
    middles = (edges[1:] + edges[:-1]) / 2
    assert weights.sum().item() == pytest.approx(1.0, abs=0.02)
    depth = (weights * middles).sum() / weights.sum()
    assert depth.item() == pytest.approx(1.5, abs=2 / sharpness + 0.002)


def test_weights_and_transparency_share_all_the_light() -> None:
    distance = torch.randn(200, 17, generator=torch.Generator().manual_seed(1))
    log_pass = log_transmittance(distance, 30.0)
    weights = blending_weights(log_pass)
    torch.testing.assert_close(weights.sum(dim=-1) + log_transparency(log_pass).exp(), torch.ones(200))
    assert (weights >= 0).all()


@pytest.mark.parametrize("thick", [-1e4, -1e7])
def test_an_opaque_interval_leaves_the_light_before_it_alone(thick: float) -> None:
    log_pass = torch.tensor([[-0.1, thick, -0.5]])
    weights = blending_weights(log_pass)
    before = torch.tensor(-0.1).exp()
    torch.testing.assert_close(weights, torch.stack([1 - before, before, torch.tensor(0.0)])[None])


def test_a_ray_that_moves_away_is_clear() -> None:
    log_pass = log_transmittance(torch.linspace(-0.3, 0.3, 20)[None], 50.0)
    assert (log_pass == 0).all()
    assert (blending_weights(log_pass) == 0).all()


def test_an_interval_split_in_two_passes_as_much() -> None:
    """The sum telescopes, so that the number of samples does not change a ray's opacity."""
    coarse = torch.linspace(0.1, -0.1, 5, dtype=torch.float64)[None]
    fine = torch.linspace(0.1, -0.1, 9, dtype=torch.float64)[None]
    torch.testing.assert_close(
        log_transparency(log_transmittance(coarse, 40.0)), log_transparency(log_transmittance(fine, 40.0))
    )


@pytest.mark.parametrize("distance", [(1e4, -1e4), (1e4, 1e3), (-1e3, -1e4), (0.0, 0.0), (-1e4, 1e4)])
def test_values_and_gradients_stay_finite_far_inside_and_far_outside(distance: tuple[float, float]) -> None:
    along = torch.linspace(*distance, 33)[None].requires_grad_()
    log_pass = log_transmittance(along, 1e3)
    value = blending_weights(log_pass).square().sum() + log_transparency(log_pass).sum()
    (gradient,) = torch.autograd.grad(value, along)
    assert value.isfinite()
    assert gradient.isfinite().all()


def test_gradients_agree_with_finite_differences() -> None:
    distance = torch.linspace(0.5, -0.5, 7, dtype=torch.float64)[None].requires_grad_()
    assert torch.autograd.gradcheck(lambda f: blending_weights(log_transmittance(f, 3.0)), distance)


def test_from_the_middles_of_a_plane_it_is_the_same() -> None:
    """There a distance continued by its slope is the distance at the ends."""
    edges = torch.rand(20, 9, generator=torch.Generator().manual_seed(2), dtype=torch.float64).cumsum(dim=-1)
    slope = torch.linspace(-1, 1, 20, dtype=torch.float64)[:, None]
    middles = slope * (edges[:, 1:] + edges[:, :-1]) / 2 - 0.5
    found = log_transmittance_of_middles(middles, slope.expand(20, 8), edges, 30.0)
    torch.testing.assert_close(found, log_transmittance(slope * edges - 0.5, 30.0))


@pytest.mark.parametrize("sharpness", [1.0, 64.0, 2048.0])
def test_from_middles_it_is_the_published_opacity_without_its_epsilon(sharpness: float) -> None:
    """(p - n + 1e-5) / (p + 1e-5) in float64, the 1e-5 left out, where neither is 0."""
    distance = torch.linspace(-0.25, 0.25, 101)[None]
    slope, edges = torch.full_like(distance, -0.7), 0.01 * torch.arange(102.0)[None]
    exact = distance.double()
    before, after = (torch.sigmoid(sharpness * (exact + side * 0.35 * 0.01)) for side in (1, -1))
    opacity = -torch.expm1(log_transmittance_of_middles(distance, slope, edges, sharpness))
    torch.testing.assert_close(opacity.double(), (before - after) / before, rtol=1e-4, atol=1e-6)


def test_the_sharpness_can_be_learned() -> None:
    """Also where the surface is far, at both ends of what is learned."""
    along = torch.linspace(-1.5, 1.5, 31, dtype=torch.float64)[None]
    edges = torch.linspace(0, 3.1, 32, dtype=torch.float64)[None]
    slope = torch.full_like(along, -1.0)

    def weights(log_sharpness: Tensor) -> Tensor:
        log_pass = log_transmittance_of_middles(along, slope, edges, log_sharpness.exp())
        return blending_weights(log_pass)

    for sharpness in (10.0, 2048.0):
        log_sharpness = torch.tensor(sharpness, dtype=torch.float64).log().requires_grad_()
        assert torch.autograd.gradcheck(weights, log_sharpness)


def test_slopes_are_annealed_from_all_sides_to_the_near_one() -> None:
    slope = torch.tensor([[-1.0, -0.5, 0.0, 0.5, 1.0]])
    torch.testing.assert_close(annealed_slope(slope, 0.0), torch.tensor([[-1.0, -0.75, -0.5, -0.25, 0.0]]))
    torch.testing.assert_close(annealed_slope(slope, 1.0), torch.tensor([[-1.0, -0.5, 0.0, 0.0, 0.0]]))
    between = (annealed_slope(slope, 0.0) + annealed_slope(slope, 1.0)) / 2
    torch.testing.assert_close(annealed_slope(slope, 0.5), between)
