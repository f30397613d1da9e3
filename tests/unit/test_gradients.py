"""Gradients of fields that are functions: against closed forms, at kinks, and at the cube's sides."""

import torch
from torch import Tensor

from backend.maths.gradients import analytic_gradient, central_gradient


def random_points(num: int, seed: int = 1) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(num, 3, generator=generator, dtype=torch.float64) * 1.9 - 0.95


def quadratic(points: Tensor) -> Tensor:
    x, y, z = points.unbind(-1)
    return x * x - 2 * y * z + z


def gradient_of_quadratic(points: Tensor) -> Tensor:
    x, y, z = points.unbind(-1)
    return torch.stack([2 * x, -2 * z, 1 - 2 * y], dim=-1)


def test_both_agree_with_the_closed_form() -> None:
    points = random_points(50).requires_grad_()
    expected = gradient_of_quadratic(points.detach())
    torch.testing.assert_close(analytic_gradient(quadratic(points), points).detach(), expected)
    differenced = central_gradient(quadratic, points.detach(), 0.01)
    torch.testing.assert_close(differenced, expected)


def test_differences_are_those_of_the_closed_form_at_the_cubes_sides() -> None:
    """A tap that is moved to the side must not make the field look flatter there: linear is exact.

    And the field is asked nowhere else: it is not defined there.
    """
    slope = torch.tensor([3.0, -2.0, 0.5], dtype=torch.float64)
    points = torch.tensor([[1.0, -1.0, 0.99], [0.95, 0.0, -1.0]], dtype=torch.float64)
    asked: list[Tensor] = []

    def linear(x: Tensor) -> Tensor:
        asked.append(x)
        return x @ slope

    torch.testing.assert_close(central_gradient(linear, points, 0.1), slope.expand(2, 3))
    assert torch.cat(asked).abs().max() <= 1


def test_wide_differences_bridge_a_kink() -> None:
    """|x| has slope -1 or 1; differences over a kink lie between, in proportion."""
    points = torch.tensor([[-0.2, 0.0, 0.0], [0.025, 0.0, 0.0], [0.2, 0.0, 0.0]], dtype=torch.float64)
    differenced = central_gradient(lambda x: x[:, 0].abs(), points, 0.1)
    expected = torch.tensor([-1.0, 0.25, 1.0], dtype=torch.float64)
    torch.testing.assert_close(differenced[:, 0], expected)


def test_the_analytic_gradient_can_be_learned_through() -> None:
    """d/dw of |grad(w x)|^2 = 2 w."""
    weight = torch.tensor(3.0, dtype=torch.float64, requires_grad=True)
    points = random_points(1).requires_grad_()
    gradient = analytic_gradient(weight * points[:, 0], points)
    (slope,) = torch.autograd.grad(gradient.square().sum(), weight)
    assert slope.item() == 6.0
