"""Waves of coordinates: against float64, and against the formula that rounds before it turns."""

import math

import pytest
import torch
from torch import Tensor

from backend.maths.encoding import positional_encoding, wave_window

FREQUENCIES = 20


def points() -> Tensor:
    return torch.rand((500, 3), generator=torch.Generator().manual_seed(0)) * 4 - 2


def plain(x: Tensor, frequencies: int) -> Tensor:
    """NeRF's formula as it is usually written, in the type of x."""
    waves = [x * (math.pi * 2.0**k) for k in range(frequencies)]
    return torch.cat([w.sin() for w in waves] + [w.cos() for w in waves], dim=-1)


def test_the_order_is_sines_then_cosines_each_by_frequency() -> None:
    quarter = torch.tensor([[0.25, 0.5]])
    root = math.sqrt(0.5)
    expected = torch.tensor([[root, 1.0, 1.0, 0.0, root, 0.0, 0.0, -1.0]])
    torch.testing.assert_close(positional_encoding(quarter, 2), expected, rtol=0, atol=5e-7)


def test_exact_at_high_frequencies_where_the_plain_formula_is_not() -> None:
    x = points()
    exact = plain(x.double(), FREQUENCIES)
    assert (positional_encoding(x, FREQUENCIES) - exact).abs().max() < 5e-7
    assert (plain(x, FREQUENCIES) - exact).abs().max() > 0.05


def test_gradients_are_those_of_float64() -> None:
    """d sin(2^k pi x) / dx = 2^k pi cos(2^k pi x), also where whole turns are taken off."""
    x = points().requires_grad_()
    generator = torch.Generator().manual_seed(1)
    shares = torch.randn((500, 6 * FREQUENCIES), generator=generator)
    (gradient,) = torch.autograd.grad((positional_encoding(x, FREQUENCIES) * shares).sum(), x)
    x64 = x.detach().double().requires_grad_()
    (exact,) = torch.autograd.grad((plain(x64, FREQUENCIES) * shares).sum(), x64)
    assert (gradient - exact).abs().max() < 1e-5 * math.pi * 2.0**FREQUENCIES


@pytest.mark.parametrize("x", [0.0, -1.0, 1e-38, 1e30, -1e30])
def test_values_lie_between_minus_one_and_one(x: float) -> None:
    encoded = positional_encoding(torch.full((1, 3), x), 10)
    assert encoded.abs().max() <= 1
    torch.testing.assert_close(encoded[:, :30].square() + encoded[:, 30:].square(), torch.ones(1, 30))


def test_waves_open_from_the_longest_on() -> None:
    """Two and a half of four: for both coordinates, sines and cosines, in the order of the encoding."""
    expected = torch.tensor([1.0, 1, 1, 1, 0.5, 0.5, 0, 0]).repeat(2)
    torch.testing.assert_close(wave_window(4, 2, 2.5), expected)
    encoded = positional_encoding(torch.tensor([[0.3, 0.3]]), 4)
    assert len(wave_window(4, 2, 4.0)) == encoded.shape[1]
    assert (wave_window(4, 2, 4.0) == 1).all()
