"""The smooth fit against a dense solve, and what it must leave alone."""

import numpy as np
import pytest
import torch
from torch import Tensor

from backend.maths.grid import laplacian
from backend.maths.smooth_fit import fit_smooth

NODES = 5


def measurements() -> tuple[Tensor, Tensor]:
    """Values at a third of the nodes, of uneven weight, in float64."""
    generator = torch.Generator().manual_seed(0)
    target = torch.randn(NODES, NODES, NODES, generator=generator, dtype=torch.float64)
    weight = torch.rand(NODES, NODES, NODES, generator=generator, dtype=torch.float64)
    return target, torch.where(weight > 0.67, weight, 0.0)


def dense_laplacian() -> np.ndarray:
    """Minus the graph Laplacian of the grid's edges, built edge by edge."""
    matrix = np.zeros((NODES**3, NODES**3))
    for node in np.ndindex(NODES, NODES, NODES):
        for axis in range(3):
            other = tuple(i + (a == axis) for a, i in enumerate(node))
            if other[axis] < NODES:
                here, there = (np.ravel_multi_index(x, (NODES,) * 3) for x in (node, other))
                matrix[here, here] -= 1
                matrix[there, there] -= 1
                matrix[here, there] += 1
                matrix[there, here] += 1
    return matrix


def energy(f: Tensor, smoothness: float) -> float:
    target, weight = measurements()
    return float((weight * (f - target) ** 2).sum() + smoothness * laplacian(f).square().sum())


@pytest.mark.parametrize("smoothness", [0.01, 1.0])
def test_matches_a_dense_solve(smoothness: float) -> None:
    target, weight = measurements()
    bending = dense_laplacian()
    matrix = np.diag(weight.flatten().numpy()) + smoothness * bending.T @ bending
    expected = np.linalg.solve(matrix, (weight * target).flatten().numpy()).reshape((NODES,) * 3)
    found = fit_smooth(target, weight, torch.zeros_like(target), smoothness=smoothness, steps=300)
    torch.testing.assert_close(found, torch.tensor(expected), atol=1e-6, rtol=0)


def test_more_steps_lower_the_energy() -> None:
    target, weight = measurements()
    start = torch.zeros_like(target)
    values = [energy(fit_smooth(target, weight, start, smoothness=0.1, steps=n), 0.1) for n in (0, 2, 5, 20)]
    assert values == sorted(values, reverse=True)
    assert values[-1] < 0.9 * values[0]


def test_no_step_is_the_start_and_the_start_is_kept() -> None:
    target, weight = measurements()
    start = torch.ones_like(target)
    assert (fit_smooth(target, weight, start, smoothness=0.1, steps=0) == 1).all()
    fit_smooth(target, weight, start, smoothness=0.1, steps=5)
    assert (start == 1).all()


def test_one_measurement_says_all_of_a_constant() -> None:
    weight = torch.zeros(NODES, NODES, NODES, dtype=torch.float64)
    weight[1, 2, 3] = 0.5
    target = torch.where(weight > 0, 2.0, -9.0).double()
    found = fit_smooth(target, weight, torch.zeros_like(weight), smoothness=1.0, steps=200)
    torch.testing.assert_close(found, torch.full_like(found, 2.0), atol=1e-5, rtol=0)


def test_a_solution_is_stable() -> None:
    """Steps after convergence must not divide 0 by 0."""
    weight = torch.ones(NODES, NODES, NODES)
    constant = torch.full_like(weight, 0.3)
    torch.testing.assert_close(fit_smooth(constant, weight, constant, smoothness=1.0, steps=50), constant)
    nothing = fit_smooth(constant, 0 * weight, constant, smoothness=1.0, steps=50)
    torch.testing.assert_close(nothing, constant)
    far = fit_smooth(1e4 * constant, weight, -1e4 * constant, smoothness=1.0, steps=300)
    torch.testing.assert_close(far, 1e4 * constant)
