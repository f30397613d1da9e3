"""Emission and absorption against integrals in closed form, and what a proposal is held to."""

import math

import pytest
import torch
from torch import Tensor

from backend.maths.radiance import composite, log_pass_of_density, proposal_loss, weight_bound
from backend.maths.volume import blending_weights, log_transparency


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def one_by_one(density: Tensor, edges: Tensor, colour: Tensor, background: Tensor) -> Tensor:
    """The sum of NeRF's eq. 3 for one ray: slow and plain."""
    light, seen = 1.0, torch.zeros(3, dtype=torch.float64)
    for index, sigma in enumerate(density):
        passed = math.exp(-float(sigma * (edges[index + 1] - edges[index])))
        seen += light * (1 - passed) * colour[index]
        light *= passed
    return seen + light * background


def test_matches_the_sum_as_it_is_written() -> None:
    density, edges = draw(7, 9), draw(7, 10, seed=1).cumsum(dim=-1)
    colour, background = draw(7, 9, 3, seed=2), draw(7, 3, seed=3)
    found = composite(log_pass_of_density(density, edges), colour, background)
    rows = zip(density, edges, colour, background, strict=True)
    torch.testing.assert_close(found, torch.stack([one_by_one(*row) for row in rows]))


def test_an_even_fog_darkens_as_beer_and_lambert_say_however_it_is_cut() -> None:
    """Through a length 3 of density 0.7 the background is seen by exp(-2.1), the fog by the rest."""
    for count in (1, 5, 4096):
        edges = torch.cat([torch.zeros(1), draw(count - 1).float().sort().values * 3, torch.tensor([3.0])])
        log_pass = log_pass_of_density(torch.full((1, count), 0.7), edges[None])
        seen = composite(log_pass, torch.ones(1, count, 3), torch.zeros(1, 3))
        torch.testing.assert_close(seen, torch.full((1, 3), 1 - math.exp(-2.1)), rtol=2e-6, atol=0)


@pytest.mark.parametrize("scale", [1e-8, 1e-4, 1.0, 1e4, 1e8])
@pytest.mark.parametrize("count", [1, 64, 4096])
def test_weights_and_background_share_all_the_light(scale: float, count: int) -> None:
    density = (scale * draw(20, count)).float()
    edges = draw(20, count + 1, seed=1).float().sort(dim=-1).values
    log_pass = log_pass_of_density(density, edges)
    one = blending_weights(log_pass).sum(dim=-1) + log_transparency(log_pass).exp()
    torch.testing.assert_close(one, torch.ones(20), rtol=0, atol=2e-6)


@pytest.mark.parametrize("scale", [1e-8, 1e-4, 1.0, 1e4, 1e8])
def test_values_and_gradients_in_float32_are_those_of_float64(scale: float) -> None:
    """With intervals without length, an empty one and an opaque one among them."""
    density = scale * draw(30, 17)
    density[:, 3], density[:10, 7], density[10:20, 0] = 0.0, 1e8, 1e8
    edges = draw(30, 18, seed=1).sort(dim=-1).values
    edges[:, 5] = edges[:, 6]
    colour, background, shares = draw(30, 17, 3, seed=2), draw(30, 3, seed=3), draw(30, 3, seed=4)

    def seen_and_gradient(dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        at = density.float().to(dtype).requires_grad_()
        log_pass = log_pass_of_density(at, edges.float().to(dtype))
        seen = composite(log_pass, colour.to(dtype), background.to(dtype))
        (gradient,) = torch.autograd.grad((seen * shares.to(dtype)).sum(), at)
        return seen.double(), gradient.double()

    seen, gradient = seen_and_gradient(torch.float32)
    exact_seen, exact_gradient = seen_and_gradient(torch.float64)
    torch.testing.assert_close(seen, exact_seen, rtol=0, atol=2e-6)
    torch.testing.assert_close(gradient, exact_gradient, rtol=0, atol=2e-6)
    assert (gradient[:, 5] == 0).all(), "an interval without length gives nothing"


def test_gradients_agree_with_finite_differences() -> None:
    edges = draw(2, 6, seed=1).sort(dim=-1).values
    density = (5 * draw(2, 5)).requires_grad_()
    colour = draw(2, 5, 3, seed=2).requires_grad_()
    background = draw(1, 3, seed=3).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda sigma, c, b: composite(log_pass_of_density(sigma, edges), c, b), (density, colour, background)
    )


# the proposal


def bound_one_by_one(edges: Tensor, proposal_edges: Tensor, proposal_weights: Tensor) -> Tensor:
    """mip-NeRF 360, eq. 12, for one ray."""
    found = torch.zeros(len(edges) - 1, dtype=torch.float64)
    for i in range(len(edges) - 1):
        for j, weight in enumerate(proposal_weights):
            shared = min(edges[i + 1], proposal_edges[j + 1]) - max(edges[i], proposal_edges[j])
            found[i] += weight if shared > 0 else 0
    return found


def test_the_bound_sums_what_overlaps() -> None:
    edges, proposal_edges = draw(20, 9).sort(dim=-1).values, draw(20, 6, seed=1).sort(dim=-1).values
    edges[:10, 3] = proposal_edges[:10, 2]  # shared edges, which overlap in nothing
    edges = edges.sort(dim=-1).values
    weights = draw(20, 5, seed=2)
    found = weight_bound(edges, proposal_edges, weights)
    expected = [bound_one_by_one(*row) for row in zip(edges, proposal_edges, weights, strict=True)]
    torch.testing.assert_close(found, torch.stack(expected))


def test_a_histogram_of_the_same_light_costs_nothing_and_one_with_less_costs_what_is_missing() -> None:
    """Coarser or the same: 0. A tenth less in the same intervals: a hundredth of the light."""
    edges, weights = draw(20, 13).sort(dim=-1).values, draw(20, 12, seed=1)
    coarse = weights.reshape(20, 4, 3).sum(dim=-1)
    at_thirds = edges[:, ::3].contiguous()
    assert proposal_loss(weights, weight_bound(edges, at_thirds, coarse)).item() == 0
    assert proposal_loss(weights, weight_bound(edges, edges, weights)).item() < 1e-20
    less = proposal_loss(weights, weight_bound(edges, edges, 0.9 * weights))
    assert less.item() == pytest.approx(0.01 * weights.sum(dim=-1).mean().item())


@pytest.mark.parametrize("size", [0.0, 1e-45, 1e-30, 1e-8, 1.0])
def test_the_loss_of_missing_weight_and_its_gradient_are_right_for_the_smallest_weights(size: float) -> None:
    """(w - b)^2 / w at b = w / 4 is 9 w / 16, with derivative -3/2 in b; at w = 0 all is 0."""
    weights = torch.tensor([[size]], dtype=torch.float64).requires_grad_()
    bound = (weights.detach() / 4).requires_grad_()
    loss = proposal_loss(weights, bound)
    (gradient,) = torch.autograd.grad(loss, bound)
    assert loss.item() == pytest.approx(9 * size / 16)
    assert gradient.item() == pytest.approx(-1.5 if size else 0.0)


def test_the_field_is_not_moved_by_the_proposal() -> None:
    weights = draw(3, 4).requires_grad_()
    loss = proposal_loss(weights, torch.zeros(3, 4, dtype=torch.float64))
    assert not loss.requires_grad
