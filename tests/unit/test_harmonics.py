"""Spherical harmonics by the laws that make them what they are."""

import math

import numpy as np
import pytest
import torch
from scipy.special import eval_legendre
from torch import Tensor

from backend.maths.harmonics import NUM_HARMONICS, spherical_harmonics

DEGREES = torch.repeat_interleave(torch.arange(4), torch.tensor([1, 3, 5, 7]))
"""Of each of the functions."""


def unit(num: int, seed: int) -> Tensor:
    draws = torch.randn(num, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.nn.functional.normalize(draws, dim=-1)


def quadrature() -> tuple[Tensor, Tensor]:
    """Directions and weights that integrate polynomials up to degree 15 over the sphere exactly."""
    z, weights = (torch.from_numpy(part) for part in np.polynomial.legendre.leggauss(8))
    turn = torch.arange(16, dtype=torch.float64) * (2 * math.pi / 16)
    across = (1 - z * z).sqrt()[:, None]
    x, y = across * turn.cos(), across * turn.sin()
    directions = torch.stack([x, y, z[:, None].expand_as(x)], dim=-1).reshape(-1, 3)
    return directions, (weights[:, None] * (2 * math.pi / 16)).expand_as(x).reshape(-1)


def test_they_are_orthonormal_over_the_sphere() -> None:
    directions, weights = quadrature()
    values = spherical_harmonics(directions)
    assert values.shape[1] == NUM_HARMONICS
    products = values.T @ (weights[:, None] * values)
    torch.testing.assert_close(products, torch.eye(NUM_HARMONICS, dtype=torch.float64), rtol=0, atol=1e-13)


@pytest.mark.parametrize("degree", range(4))
def test_those_of_a_degree_add_up_to_a_legendre_polynomial(degree: int) -> None:
    """sum_m Y_lm(a) Y_lm(b) = (2 l + 1) / 4 pi P_l(a . b): the same however the axes are turned."""
    one, other = unit(200, 0), unit(200, 1)
    mine = degree == DEGREES
    found = (spherical_harmonics(one)[:, mine] * spherical_harmonics(other)[:, mine]).sum(dim=-1)
    polynomial = torch.from_numpy(eval_legendre(degree, (one * other).sum(dim=-1).numpy()))
    torch.testing.assert_close(found, (2 * degree + 1) / (4 * math.pi) * polynomial, rtol=0, atol=1e-13)


def test_orders_go_round_the_axis_as_cosines_and_sines() -> None:
    """Y_lm turned by an angle about z is a mix of Y_lm and Y_l-m alone, as cos m a and sin m a."""
    angle, directions = 0.7, unit(100, 2)
    cos, sin = math.cos(angle), math.sin(angle)
    about_z = torch.tensor([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], dtype=torch.float64)
    before, after = spherical_harmonics(directions), spherical_harmonics(directions @ about_z.T)
    for degree in range(4):
        middle = degree * degree + degree
        for order in range(degree + 1):
            c, s = math.cos(order * angle), math.sin(order * angle)
            even, odd = before[:, middle + order], before[:, middle - order]
            torch.testing.assert_close(after[:, middle + order], c * even - (s * odd if order else 0))
            torch.testing.assert_close(after[:, middle - order], c * odd + (s * even if order else 0))


def test_the_opposite_direction_changes_the_sign_of_odd_degrees() -> None:
    directions = unit(50, 3)
    signs = torch.where(DEGREES % 2 == 0, 1.0, -1.0).double()
    assert torch.equal(spherical_harmonics(-directions), signs * spherical_harmonics(directions))


def test_in_single_precision_nothing_is_lost() -> None:
    directions = unit(1000, 4).float()
    exact = spherical_harmonics(directions.double())
    assert (spherical_harmonics(directions) - exact).abs().max() < 5e-7
