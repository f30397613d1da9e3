"""Trilinear grids against scipy and in laws: transposes, symmetry, exactness on linear functions."""

import numpy as np
import pytest
import torch
from scipy.interpolate import RegularGridInterpolator
from torch import Tensor

from backend.maths.grid import (
    interpolate,
    interpolate_features,
    laplacian,
    laplacian_at,
    locate,
    near_surface,
    node_positions,
    read,
    refined,
    spacing,
    splat,
    value_and_gradient,
)

CPU = torch.device("cpu")
NODES = 7


def random_grid(seed: int = 0, nodes: int = NODES) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(nodes, nodes, nodes, generator=generator, dtype=torch.float64)


def random_points(num: int, seed: int = 1) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(num, 3, generator=generator, dtype=torch.float64) * 1.98 - 0.99


def test_nodes_span_the_cube() -> None:
    positions = node_positions(5, CPU)
    assert positions[0, 2, 4].tolist() == [-1.0, 0.0, 1.0]
    assert spacing(5) == (positions[1, 0, 0, 0] - positions[0, 0, 0, 0]).item() == 0.5


def test_interpolation_agrees_with_scipy() -> None:
    grid, points = random_grid(), random_points(200)
    steps = np.linspace(-1, 1, NODES)
    expected = RegularGridInterpolator((steps, steps, steps), grid.numpy())(points.numpy())
    torch.testing.assert_close(interpolate(grid, locate(points, NODES)), torch.tensor(expected))


@pytest.mark.parametrize("num", [0, 1, 8, 203])
def test_reading_is_interpolation(num: int) -> None:
    """Also outside the cube."""
    grid, points = random_grid(), 1.2 * random_points(num)
    torch.testing.assert_close(read(grid, points), interpolate(grid, locate(points, NODES)))


def test_weights_sum_to_one_and_slopes_to_zero() -> None:
    corners = locate(random_points(50), NODES)
    torch.testing.assert_close(corners.weight.sum(dim=1), torch.ones(50, dtype=torch.float64))
    torch.testing.assert_close(corners.slope.sum(dim=1), torch.zeros(50, 3, dtype=torch.float64))


def test_value_at_a_node_is_the_nodes() -> None:
    grid = random_grid().float()
    nodes = node_positions(NODES, CPU).reshape(-1, 3)
    torch.testing.assert_close(interpolate(grid, locate(nodes, NODES)), grid.flatten(), atol=1e-5, rtol=0)


def test_gradient_is_the_derivative_of_the_value() -> None:
    """Central differences within a cell are exact: the function is linear along each axis there."""
    grid, h = random_grid(), 1e-6
    _, gradient = value_and_gradient(grid, locate(random_points(100), NODES))
    for axis in range(3):
        shift = torch.zeros(3, dtype=torch.float64)
        shift[axis] = h
        ahead, _ = value_and_gradient(grid, locate(random_points(100) + shift, NODES))
        behind, _ = value_and_gradient(grid, locate(random_points(100) - shift, NODES))
        torch.testing.assert_close((ahead - behind) / (2 * h), gradient[:, axis], atol=1e-6, rtol=1e-6)


def test_a_linear_function_and_its_gradient_are_exact() -> None:
    slope = torch.tensor([0.3, -1.2, 2.0], dtype=torch.float64)
    grid = node_positions(NODES, CPU).double() @ slope + 0.4
    value, gradient = value_and_gradient(grid, locate(random_points(50), NODES))
    torch.testing.assert_close(value, random_points(50) @ slope + 0.4, atol=1e-6, rtol=0)
    torch.testing.assert_close(gradient, slope.expand(50, 3), atol=1e-6, rtol=0)


def test_values_and_gradients_are_differentiable_in_the_grid() -> None:
    corners = locate(random_points(6), 3)
    grid = random_grid(nodes=3).requires_grad_()
    assert torch.autograd.gradcheck(lambda g: value_and_gradient(g, corners), grid)


def test_points_outside_take_the_value_of_the_side() -> None:
    grid = random_grid().float()
    far = torch.tensor([[1e9, -1e9, 0.3], [-5.0, 1.0, 5.0]])
    near = far.clamp(-1, 1)
    value, gradient = value_and_gradient(grid, locate(far, NODES))
    torch.testing.assert_close(value, interpolate(grid, locate(near, NODES)))
    assert gradient.isfinite().all()


@pytest.mark.parametrize("nodes", [2, 65, 257, 513])
def test_every_point_has_a_cell_in_the_grid(nodes: int) -> None:
    """In float32 the last cell must not be rounded away."""
    corners = locate(torch.tensor([[1.0, 1.0, 1.0], [-1.0, -1.0, -1.0], [0.9999999, 1, -1]]), nodes)
    assert corners.index.min() == 0
    assert corners.index.max() == nodes**3 - 1


def test_splat_is_the_transpose_of_interpolation() -> None:
    """<interpolate(g), v> = <g, splat(v)> for every g and v."""
    corners = locate(random_points(40), NODES)
    values = random_points(40, seed=2)
    features = random_grid(3, nodes=NODES)[..., None].flatten(0, 2) * torch.tensor([1.0, -2.0, 0.5]).double()
    forwards = (interpolate_features(features, corners) * values).sum()
    backwards = (features * splat(values, corners, NODES)).sum()
    torch.testing.assert_close(forwards, backwards)
    assert forwards.abs() > 1e-3


def test_every_channel_is_interpolated_alike() -> None:
    corners = locate(random_points(40), NODES)
    grids = [random_grid(seed) for seed in range(3)]
    features = torch.stack([grid.flatten() for grid in grids], dim=-1)
    expected = torch.stack([interpolate(grid, corners) for grid in grids], dim=-1)
    torch.testing.assert_close(interpolate_features(features, corners), expected)


@pytest.mark.parametrize(("coarse", "fine"), [(5, 9), (5, 12), (9, 4)])
def test_refining_keeps_linear_functions(coarse: int, fine: int) -> None:
    slope = torch.tensor([0.3, -1.2, 2.0])
    torch.testing.assert_close(
        refined(node_positions(coarse, CPU) @ slope, fine), node_positions(fine, CPU) @ slope
    )


def test_refining_is_interpolation() -> None:
    grid = random_grid().float()
    expected = interpolate(grid, locate(node_positions(11, CPU).reshape(-1, 3), NODES))
    torch.testing.assert_close(refined(grid, 11).flatten(), expected, atol=1e-5, rtol=0)


def test_laplacian_is_symmetric_and_never_positive() -> None:
    f, g = random_grid(0), random_grid(1)
    torch.testing.assert_close((f * laplacian(g)).sum(), (g * laplacian(f)).sum())
    assert (f * laplacian(f)).sum() < 0


def test_laplacian_of_constants_is_zero_and_of_squares_six() -> None:
    assert (laplacian(torch.full((NODES,) * 3, 5.0)) == 0).all()
    squares = (node_positions(NODES, CPU) / spacing(NODES)).square().sum(dim=-1)
    torch.testing.assert_close(laplacian(squares)[1:-1, 1:-1, 1:-1], torch.full((NODES - 2,) * 3, 6.0))


def test_laplacian_conserves_the_sum() -> None:
    assert laplacian(random_grid()).sum().item() == pytest.approx(0, abs=1e-10)


def test_laplacian_at_chosen_nodes_is_the_same() -> None:
    """Also at the sides, where a neighbour by number may be a node of the next row."""
    grid = random_grid()
    chosen = torch.arange(NODES**3).flip(0)
    at = laplacian_at(lambda index: grid.flatten()[index], chosen, NODES)
    torch.testing.assert_close(at, laplacian(grid).flatten()[chosen])


@pytest.mark.parametrize("cells", [1, 2])
def test_near_surface_is_a_box_around_a_change_of_sign(cells: int) -> None:
    grid = random_grid(4) + 2.2
    expected = torch.zeros_like(grid, dtype=torch.bool)
    for node in np.ndindex(*grid.shape):
        box = grid[tuple(slice(max(i - cells, 0), i + cells + 1) for i in node)]
        expected[node] = bool((box < 0).any() and (box >= 0).any())
    found = near_surface(grid, cells)
    assert (found == expected).all()
    assert 0 < found.sum() < found.numel()


def test_a_grid_without_a_surface_has_nothing_near() -> None:
    assert not near_surface(torch.ones(5, 5, 5), 2).any()
    assert not near_surface(-torch.ones(5, 5, 5), 2).any()
