"""The first-order step to where two photographs are equally bright: closed forms and laws."""

import pytest
import torch

from backend.maths.brightness import depth_steps, exposure_ratio, means_of_cells, slopes_along

EVERYWHERE = torch.ones((9, 11), dtype=torch.bool)


def test_even_change_is_straight_and_its_slope_exact() -> None:
    found = slopes_along(torch.tensor([1.0]), torch.tensor([1.5]), torch.tensor([2.0]), 0.1)
    assert bool(found.straight)
    assert float(found.slope) == pytest.approx(5.0)


@pytest.mark.parametrize("here", [1.0, 1.3, 1.7, 2.5])
def test_what_bends_is_not_straight(here: float) -> None:
    """Each side's slope differs from their mean by 0.4 of it and more."""
    nearer, middle, farther = (torch.tensor([value]) for value in (1.0, here, 2.0))
    assert not bool(slopes_along(nearer, middle, farther, 0.1).straight)


def test_what_does_not_change_has_no_slope_to_go_by() -> None:
    same = torch.tensor([0.5])
    assert not bool(slopes_along(same, same, same, 0.1).straight)


def test_a_linear_difference_is_solved_exactly() -> None:
    slope = torch.rand((9, 11), generator=torch.Generator().manual_seed(0)) + 0.5
    found = depth_steps(0.03 * slope, slope, EVERYWHERE, 1)
    torch.testing.assert_close(found.step, torch.full((9, 11), 0.03))
    assert float(found.left_over.max()) < 1e-4  # what float32 leaves of squares of 0.03


def test_the_step_is_that_of_least_squares_over_each_window() -> None:
    generator = torch.Generator().manual_seed(1)
    slope, difference = (torch.randn((9, 11), generator=generator) for _ in range(2))
    where = torch.rand((9, 11), generator=generator) < 0.7
    found = depth_steps(difference, slope, where, 1)
    for row, column in ((0, 0), (4, 5), (8, 3)):
        window = (slice(max(row - 1, 0), row + 2), slice(max(column - 1, 0), column + 2))
        a, b = slope[window][where[window]], difference[window][where[window]]
        solved = torch.linalg.lstsq(a[:, None].double(), b[:, None].double()).solution[0, 0]
        torch.testing.assert_close(found.step[row, column].double(), solved, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(
            found.left_over[row, column], (b - solved.float() * a).square().mean().sqrt()
        )
        torch.testing.assert_close(found.slope[row, column], a.square().mean().sqrt())


def test_pixels_not_known_have_no_part_in_it() -> None:
    slope, difference = torch.ones((9, 11)), torch.full((9, 11), 0.02)
    where = EVERYWHERE.clone()
    where[4, 5] = False
    slope[4, 5], difference[4, 5] = torch.nan, 1e6
    found = depth_steps(difference, slope, where, 1)
    torch.testing.assert_close(found.step, torch.full((9, 11), 0.02))


def test_exposure_is_the_median_of_ratios() -> None:
    here = torch.tensor([0.1, 0.2, 0.4, 0.5, 0.0])
    there = 1.7 * here
    there[2] = 1.0  # a glint
    assert float(exposure_ratio(here, there)) == pytest.approx(1.7)


def test_means_are_those_of_cells_with_enough_places() -> None:
    values, cell = torch.tensor([1.0, 3.0, 10.0, 5.0, 6.0, 7.0]), torch.tensor([0, 0, 1, 2, 2, 2])
    assert means_of_cells(values, cell, 2).tolist() == [2.0, 6.0]
    assert means_of_cells(values, cell, 4).tolist() == []
    assert means_of_cells(values[:0], cell[:0], 1).tolist() == []
