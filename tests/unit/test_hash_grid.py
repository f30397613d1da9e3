"""Features of hash grids: trilinear where every node has its row, repeatable and in range where not."""

import pytest
import torch
from torch import Tensor

from backend.maths.grid import interpolate, locate
from backend.maths.hash_grid import corner_rows, encode, level_cells, table_rows

CELLS = (2, 5, 9)
MOST = 400
"""Rows: the finest of the levels, with 1000 nodes, shares them."""


def tables(seed: int = 0) -> list[Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return [
        torch.randn(table_rows(cells, MOST), 2, generator=generator, dtype=torch.float64) for cells in CELLS
    ]


def random_points(num: int, seed: int = 1) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(num, 3, generator=generator, dtype=torch.float64) * 1.98 - 0.99


def test_levels_grow_by_one_factor() -> None:
    assert level_cells(5, 4, 64) == (4, 8, 16, 32, 64)
    assert level_cells(1, 4, 64) == (4,)
    published = level_cells(32, 4, 2048)
    assert (published[0], published[-1], len(published)) == (4, 2048, 32)
    assert list(published) == sorted(published)


def test_small_levels_have_a_row_for_each_node() -> None:
    assert [table_rows(cells, MOST) for cells in CELLS] == [27, 216, 400]


def test_dense_levels_are_trilinear_grids() -> None:
    points = random_points(300)
    encoded = encode(tables(), CELLS, points, 2)
    for level, (table, cells) in enumerate(zip(tables()[:2], CELLS[:2], strict=True)):
        nodes = cells + 1
        for channel in range(2):
            grid = table[:, channel].reshape(nodes, nodes, nodes)
            expected = interpolate(grid, locate(points, nodes))
            torch.testing.assert_close(encoded[:, 2 * level + channel], expected)


def test_at_a_node_a_hashed_level_is_the_row_of_its_hash() -> None:
    """Instant-NGP, eq. 4, node by node in whole numbers of Python."""
    table, cells = tables()[2], CELLS[2]
    nodes = torch.tensor([[0, 0, 0], [1, 2, 3], [8, 0, 4], [7, 8, 5]])
    points = nodes.double() * 2 / cells - 1 + 1e-9  # on the upper side of the node
    found = encode(tables(), CELLS, points, 3)[:, 4:]
    for (x, y, z), row in zip(nodes.tolist(), found, strict=True):
        expected = table[(x ^ (y * 2654435761) ^ (z * 805459861)) % MOST]
        torch.testing.assert_close(row, expected, atol=1e-6, rtol=0)


def test_hashes_are_in_range_even_in_the_finest_published_grid() -> None:
    low = torch.randint(0, 2048, (5000, 3), generator=torch.Generator().manual_seed(3))
    rows = corner_rows(low, 2048, 2**19)
    assert rows.min() >= 0
    assert rows.max() < 2**19
    assert len(rows.unique()) > 0.95 * 2**19 * (1 - torch.exp(torch.tensor(-40_000 / 2**19)))
    assert torch.equal(rows, corner_rows(low, 2048, 2**19))


def test_levels_that_are_not_active_are_silent_and_learn_nothing() -> None:
    learned = [table.requires_grad_() for table in tables()]
    points = random_points(50)
    encoded = encode(learned, CELLS, points, 1)
    assert encoded.shape == (50, 6)
    assert (encoded[:, 2:] == 0).all()
    torch.testing.assert_close(encoded[:, :2], encode(learned, CELLS, points, 3)[:, :2])
    encoded.sum().backward()  # type: ignore[no-untyped-call]
    assert learned[0].grad is not None
    assert [table.grad for table in learned[1:]] == [None, None]


def test_nothing_active_is_nothing() -> None:
    assert (encode(tables(), CELLS, random_points(5), 0) == 0).all()


@pytest.mark.parametrize("outside", [1.0, 1.5, 1e6])
def test_points_outside_are_those_on_the_side(outside: float) -> None:
    point = torch.tensor([[outside, -outside, 0.3]], dtype=torch.float64)
    on_side = point.clamp(-1, 1)
    torch.testing.assert_close(encode(tables(), CELLS, point, 3), encode(tables(), CELLS, on_side, 3))


def test_gradients_agree_with_finite_differences() -> None:
    """In tables and points, once and twice: normals by differentiation need the second."""
    small = [table[:, :1].clone().requires_grad_() for table in tables()[:1]]
    points = random_points(4).requires_grad_()

    def encoded(points: Tensor, table: Tensor) -> Tensor:
        return encode([table], CELLS[:1], points, 1)

    assert torch.autograd.gradcheck(encoded, (points, small[0]))
    assert torch.autograd.gradgradcheck(encoded, (points, small[0]))


def test_hashed_levels_have_the_gradients_of_finite_differences() -> None:
    table = torch.randn(50, 2, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    points = random_points(4).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x, t: encode([t], (6,), x, 1), (points, table.requires_grad_()), fast_mode=True
    )


def test_float32_is_exact_enough_at_the_finest_published_level() -> None:
    """A place in a cell of 1 / 2048 is known to 2^-13 of the cell: 2048 cells leave 13 of 24 bits."""
    cells, most = 2048, 2**12
    table = torch.rand(most, 1, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    points = random_points(2000).float()
    exact = encode([table], (cells,), points.double(), 1)
    single = encode([table.float()], (cells,), points, 1)
    assert (single - exact).abs().max() < 3 * 3 * 2**-13
