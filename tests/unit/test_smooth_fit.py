"""The smooth fit against a dense solve, and what it must leave alone."""

import numpy as np
import pytest
import torch
from torch import Tensor

from backend.maths.grid import laplacian
from backend.maths.smooth_fit import fit_smooth, in_torch

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
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-6), (torch.float32, 1e-4)])
def test_matches_a_dense_solve(smoothness: float, dtype: torch.dtype, tolerance: float) -> None:
    target, weight = measurements()
    bending = dense_laplacian()
    matrix = np.diag(weight.flatten().numpy()) + smoothness * bending.T @ bending
    expected = np.linalg.solve(matrix, (weight * target).flatten().numpy()).reshape((NODES,) * 3)
    given = target.to(dtype), weight.to(dtype), torch.zeros_like(target, dtype=dtype)
    found = fit_smooth(*given, smoothness=smoothness, steps=300)
    assert found.dtype == dtype
    torch.testing.assert_close(found.double(), torch.tensor(expected), atol=tolerance, rtol=0)


@pytest.mark.parametrize(("nodes", "threads"), [(2, 1), (3, 1), (33, 3), (70, 1), (70, 3)])
def test_compiled_as_in_torch(nodes: int, threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Single precision, compiled, beside double precision in torch."""
    generator = torch.Generator().manual_seed(1)
    target, start = torch.randn((2, nodes, nodes, nodes), generator=generator)
    weight = 0.01 + torch.rand((nodes, nodes, nodes), generator=generator) ** 8
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    kept = start.clone()
    found = fit_smooth(target, weight, start, smoothness=0.1, steps=6)
    reference = in_torch(target.double(), weight.double(), start.double(), smoothness=0.1, steps=6)
    torch.testing.assert_close(found.double(), reference, atol=1e-5, rtol=0)
    assert (start == kept).all()


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
