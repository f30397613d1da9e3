"""Where each loss is zero, what it equals elsewhere, and that it stays finite."""

import math

import pytest
import torch
from torch import Tensor

from backend.maths import losses


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def gradient_of(value: Tensor, at: Tensor) -> Tensor:
    (gradient,) = torch.autograd.grad(value.sum(), at)
    return gradient


def test_taylor_residuals_vanish_on_a_plane() -> None:
    """With f(q) = n . (q - p) both residuals are 0 wherever the query lies."""
    normal = torch.nn.functional.normalize(draw(40, 3), dim=-1)
    p_minus_q = draw(40, 3, seed=1)
    distance = -(normal * p_minus_q).sum(dim=-1)
    zero = torch.zeros(40, dtype=torch.float64)
    torch.testing.assert_close(losses.taylor_at_point(distance, normal, p_minus_q), zero)
    torch.testing.assert_close(losses.taylor_at_query(distance, normal, p_minus_q), zero)


def test_taylor_residuals_of_a_sphere_are_of_second_order() -> None:
    """f = |q| - 1; away from the point by e along the tangent, by e outwards: known in closed form."""
    apart = 0.1
    query = torch.tensor([[1 + apart, 0.0, 0.0], [1.0, apart, 0.0]], dtype=torch.float64)
    point = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    reach = query.norm(dim=-1)
    at_point = losses.taylor_at_point(reach - 1, point.expand(2, 3), point - query)
    torch.testing.assert_close(at_point, torch.tensor([0.0, math.hypot(1, apart) - 1], dtype=torch.float64))
    at_query = losses.taylor_at_query(reach - 1, query / reach[:, None], point - query)
    tangent = 1 / math.hypot(1, apart) - 1
    torch.testing.assert_close(at_query, torch.tensor([0.0, tangent], dtype=torch.float64))


def test_charbonnier_is_a_square_near_zero_and_a_distance_far_away() -> None:
    scale = 0.02
    near, far = torch.tensor(1e-4, dtype=torch.float64), torch.tensor(-1e4, dtype=torch.float64)
    assert losses.charbonnier(near, scale).item() == pytest.approx(1e-8 / (2 * scale), rel=1e-4)
    assert losses.charbonnier(far, scale).item() == pytest.approx(1e4 - scale, rel=1e-9)
    residual = draw(30)
    torch.testing.assert_close(losses.charbonnier(residual, scale), losses.charbonnier(-residual, scale))


def test_charbonnier_is_right_where_one_plus_its_square_is_one() -> None:
    residual = torch.tensor([1e-3, 1e-6, 1e-12])
    torch.testing.assert_close(losses.charbonnier(residual, 10.0), residual.square() / 20, rtol=1e-6, atol=0)


def test_charbonnier_pulls_no_harder_than_one() -> None:
    residual = torch.tensor([-1e4, -1.0, 0.0, 1.0, 1e4], requires_grad=True)
    value = losses.charbonnier(residual, 0.02)
    gradient = gradient_of(value, residual)
    torch.testing.assert_close(gradient, torch.tensor([-1.0, -1.0, 0.0, 1.0, 1.0]), atol=1e-3, rtol=0)


def test_eikonal_measures_the_length_of_gradients() -> None:
    unit = torch.nn.functional.normalize(draw(20, 3), dim=-1)
    assert losses.eikonal(unit).item() == pytest.approx(0, abs=1e-12)
    assert losses.eikonal(3 * unit).item() == pytest.approx(4)
    assert losses.eikonal(0 * unit).item() == pytest.approx(1, abs=1e-5)


def test_eikonal_is_finite_where_the_gradient_vanishes() -> None:
    gradient = torch.tensor([[0.0, 0, 0], [1e-20, 0, 0], [1e4, -1e4, 1e4]], requires_grad=True)
    value = losses.eikonal(gradient)
    assert value.isfinite()
    slope = gradient_of(value, gradient)
    assert slope.isfinite().all()
    assert slope.abs().max() < 1e5


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_silhouette_is_the_cross_entropy(share: float) -> None:
    """Against the plain formula, far from 0 and 1, where the bound of a thousandth hardly shows."""
    transparency = torch.linspace(0.1, 0.9, 9, dtype=torch.float64)
    coverage = torch.full_like(transparency, share)
    plain = -(1 - coverage) * transparency.log() - coverage * (1 - transparency).log()
    value = losses.silhouette(transparency.log(), coverage)
    assert value.item() == pytest.approx(plain.mean().item(), abs=3e-3)


def test_silhouette_is_zero_where_mask_and_ray_agree() -> None:
    log_pass, coverage = torch.tensor([0.0, -1e4]), torch.tensor([0.0, 1.0])
    assert losses.silhouette(log_pass, coverage).item() == pytest.approx(0, abs=1e-6)


def test_silhouette_stays_finite_where_they_disagree_entirely() -> None:
    """Fully clear on the subject, fully opaque off it; and it still says which way to go."""
    log_pass = torch.tensor([0.0, -1e4], requires_grad=True)
    value = losses.silhouette(log_pass, torch.tensor([1.0, 0.0]))
    gradient = gradient_of(value, log_pass)
    assert value.isfinite()
    assert gradient.isfinite().all()
    assert gradient[0] > 0  # less transparency lowers the loss
    assert gradient[1] < 0


def test_entropy_of_side_is_that_of_a_coin() -> None:
    distance = torch.linspace(-0.5, 0.5, 21, dtype=torch.float64)
    inside = torch.sigmoid(-8 * distance)
    plain = -inside * inside.log() - (1 - inside) * (1 - inside).log()
    torch.testing.assert_close(losses.entropy_of_side(distance, 8.0), plain)
    assert losses.entropy_of_side(torch.zeros(1), 8.0).item() == pytest.approx(math.log(2))


@pytest.mark.parametrize("logit", [-60.0, -20.0, 20.0, 60.0])
def test_entropy_of_side_is_right_where_a_side_is_nearly_sure(logit: float) -> None:
    """To first order (1 + x) e^-x, which float32 holds to its last digits."""
    value = losses.entropy_of_side(torch.tensor([logit / 4]), 4.0).item()
    assert value == pytest.approx((1 + abs(logit)) * math.exp(-abs(logit)), rel=1e-6, abs=0)


def test_entropy_of_side_is_finite_far_away() -> None:
    distance = torch.tensor([-1e4, -1.0, 0.0, 1.0, 1e4], requires_grad=True)
    value = losses.entropy_of_side(distance, 512.0)
    assert value.isfinite().all()
    assert gradient_of(value, distance).isfinite().all()
    assert value[[0, -1]].abs().max() == 0


def test_gradients_agree_with_finite_differences() -> None:
    f, g, n = draw(4).requires_grad_(), draw(4, 3, seed=1).requires_grad_(), draw(4, 3, seed=2)
    t, m = (-draw(4, seed=3).abs() - 0.1).requires_grad_(), draw(4, seed=4).sigmoid()
    check = torch.autograd.gradcheck
    assert check(lambda f, g: losses.taylor_at_query(f, g, n), (f, g))
    assert check(lambda f: losses.taylor_at_point(f, n, n), f)
    assert check(lambda f: losses.charbonnier(f, 0.1), f)
    assert check(losses.eikonal, g)
    assert check(lambda t: losses.silhouette(t, m), t)
    assert check(lambda f: losses.entropy_of_side(f, 3.0), f)


def test_a_pull_along_the_true_distance_ends_on_the_nearest_point() -> None:
    """f = |q| - 1: q - f grad f is q / |q|. From any other point the loss is the distance to that."""
    query = draw(50, 3)
    reach = query.norm(dim=-1)
    nearest = query / reach[:, None]
    torch.testing.assert_close(
        losses.pull(reach - 1, 5 * nearest, nearest - query), torch.zeros(50, dtype=torch.float64)
    )
    other = torch.nn.functional.normalize(draw(50, 3, seed=1), dim=-1)
    expected = (nearest - other).norm(dim=-1)
    torch.testing.assert_close(losses.pull(reach - 1, nearest, other - query), expected)


def test_a_newton_pull_is_the_same_for_a_field_of_any_slope() -> None:
    query = draw(50, 3)
    reach = query.norm(dim=-1)
    nearest = query / reach[:, None]
    off = losses.newton_pull(7 * (reach - 1), 7 * nearest, nearest - query, least_slope=0.1)
    torch.testing.assert_close(off, torch.zeros(50, dtype=torch.float64))


@pytest.mark.parametrize("kind", ["pull", "newton"])
def test_pulls_are_bounded_with_finite_derivatives_where_the_gradient_vanishes(kind: str) -> None:
    gradient = torch.zeros(1, 3, requires_grad=True)
    value, apart = torch.ones(1), torch.tensor([[3.0, 4.0, 0.0]])
    if kind == "pull":
        off = losses.pull(value, gradient, apart)
    else:
        off = losses.newton_pull(value, gradient, apart, least_slope=0.1)
    assert off.item() == pytest.approx(5.0)
    assert gradient_of(off, gradient).isfinite().all()


def test_the_worst_offset_raises_a_linear_loss_by_radius_times_slope() -> None:
    """And no other offset of the same length raises it more."""
    slope, radius = (
        draw(20, 3),
        torch.rand(20, dtype=torch.float64, generator=torch.Generator().manual_seed(2)),
    )
    offset = losses.worst_offset(slope, radius)
    rise = (slope * offset).sum(dim=-1)
    torch.testing.assert_close(rise, radius * slope.norm(dim=-1))
    others = radius[:, None] * torch.nn.functional.normalize(draw(1000, 20, 3, seed=3), dim=-1)
    assert ((slope * others).sum(dim=-1) <= rise + 1e-12).all()
    assert not losses.worst_offset(torch.zeros(4, 3), torch.ones(4)).any()


def test_log_mean_exp_lies_between_mean_and_maximum_and_reaches_both() -> None:
    drawn = draw(7, 30).abs()
    middle = losses.log_mean_exp(drawn, 0.3)
    assert (middle > drawn.mean(dim=0)).all()
    assert (middle < drawn.amax(dim=0)).all()
    torch.testing.assert_close(losses.log_mean_exp(drawn, 1e6), drawn.mean(dim=0), rtol=0, atol=1e-5)
    torch.testing.assert_close(losses.log_mean_exp(drawn, 1e-4), drawn.amax(dim=0), rtol=0, atol=1e-3)
    plain = 0.3 * torch.log(torch.exp(drawn / 0.3).mean(dim=0))
    torch.testing.assert_close(middle, plain)


def test_log_mean_exp_does_not_overflow() -> None:
    """Losses of a thousand temperatures: e^1000 is no number, the answer is."""
    drawn = torch.tensor([[1000.0], [999.0]])
    assert torch.isinf(torch.exp(drawn).mean())
    expected = 1000 + math.log((1 + math.exp(-1)) / 2)
    assert losses.log_mean_exp(drawn, 1.0).item() == pytest.approx(expected, rel=1e-6)
