"""The first-order step to where two photographs show the same: closed forms and laws."""

import math

import pytest
import torch

from backend.maths.brightness import (
    channels_of,
    depth_steps,
    exposure_ratio,
    grain,
    means_of_cells,
    median_deviation,
    slopes_along,
)

EVERYWHERE = torch.ones((2, 9, 11), dtype=torch.bool)


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


def test_a_highlight_of_the_light_s_colour_changes_brightness_alone() -> None:
    matt = torch.tensor([[0.6], [0.3], [0.1]])
    one, other = channels_of(matt), channels_of(matt + 0.2)
    assert float(other[0] - one[0]) == pytest.approx(0.2)
    torch.testing.assert_close(other[1:], one[1:])
    torch.testing.assert_close(channels_of(2 * matt), 2 * one)  # shading changes all


def test_a_linear_difference_is_solved_exactly() -> None:
    slope = torch.rand((2, 9, 11), generator=torch.Generator().manual_seed(0)) + 0.5
    found = depth_steps(0.03 * slope, slope, EVERYWHERE, 1)
    torch.testing.assert_close(found.step, torch.full((9, 11), 0.03))
    assert float(found.left_over.max()) < 1e-4  # what float32 leaves of squares of 0.03


def test_the_step_is_that_of_least_squares_over_each_window() -> None:
    generator = torch.Generator().manual_seed(1)
    slope, difference = (torch.randn((1, 9, 11), generator=generator) for _ in range(2))
    where = torch.rand((1, 9, 11), generator=generator) < 0.7
    found = depth_steps(difference, slope, where, 1)
    for row, column in ((0, 0), (4, 5), (8, 3)):
        window = (0, slice(max(row - 1, 0), row + 2), slice(max(column - 1, 0), column + 2))
        a, b = slope[window][where[window]], difference[window][where[window]]
        solved = torch.linalg.lstsq(a[:, None].double(), b[:, None].double()).solution[0, 0]
        torch.testing.assert_close(found.step[row, column].double(), solved, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(
            found.left_over[row, column], (b - solved.float() * a).square().mean().sqrt()
        )
        torch.testing.assert_close(found.slope[row, column], a.square().mean().sqrt())


def test_channels_count_by_what_they_say() -> None:
    """Each as its mean square slope; one without slope neither moves the step nor is asked what is left."""
    slope = torch.tensor([3.0, 1.0, 0.0])[:, None, None].expand(3, 9, 11)
    wanted = torch.tensor([0.02, 0.06, 0.0])[:, None, None]
    difference = slope * wanted + torch.tensor([0.0, 0.0, 5.0])[:, None, None]
    found = depth_steps(difference, slope, EVERYWHERE[:1].expand(3, -1, -1), 1)
    step = (9 * 0.02 + 1 * 0.06) / 10
    torch.testing.assert_close(found.step, torch.full((9, 11), step))
    torch.testing.assert_close(found.slope, torch.full((9, 11), 10.0).sqrt())
    left = (9 * (3 * (0.02 - step)) ** 2 + 1 * (0.06 - step) ** 2) / 10
    torch.testing.assert_close(found.left_over, torch.full((9, 11), left).sqrt(), rtol=1e-3, atol=1e-5)


def test_pixels_not_known_have_no_part_in_it() -> None:
    slope, difference = torch.ones((2, 9, 11)), torch.full((2, 9, 11), 0.02)
    where = EVERYWHERE.clone()
    where[:, 4, 5] = False
    where[1, 6] = False  # of one channel alone
    slope[~where], difference[~where] = torch.nan, 1e6
    found = depth_steps(difference, slope, where, 1)
    torch.testing.assert_close(found.step, torch.full((9, 11), 0.02))


def test_exposure_is_the_median_of_ratios() -> None:
    here = torch.tensor([[0.1, 0.2, 0.4, 0.5, 0.0], [0.3, -0.1, 0.1, 0.2, 0.6]])
    there = torch.tensor([[1.7], [0.8]]) * here
    there[:, 2] = 1.0  # a glint
    assert exposure_ratio(here, there).tolist() == pytest.approx([1.7, 0.8])


def test_places_weigh_by_how_much_they_show() -> None:
    """Of a colour that is hardly there, what is noise says nothing of its exposure."""
    here = torch.tensor([[0.5, 0.6, 0.7], [0.001, 0.3, -0.001]])
    there = torch.tensor([[1.0, 1.2, 1.4], [0.1, 0.6, 0.1]])
    assert exposure_ratio(here, there).tolist() == pytest.approx([2.0, 2.0])


@pytest.mark.parametrize(("exposure", "changed"), [(1.0, False), (1.003, False), (1.03, True), (0.97, True)])
def test_exposures_are_alike_unless_more_than_chance_says_otherwise(exposure: float, changed: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    here = 0.2 + 0.5 * torch.rand((3, 40), generator=generator)
    there = exposure * here * (1 + 0.01 * torch.randn((3, 40), generator=generator))
    ratio = exposure_ratio(here, there)
    if changed:
        torch.testing.assert_close(ratio, torch.full((3,), exposure), rtol=0.006, atol=0)
    else:
        assert ratio.tolist() == [1.0, 1.0, 1.0]


def test_means_are_those_of_cells_with_enough_places() -> None:
    values = torch.tensor([[1.0, 3.0, 10.0, 5.0, 6.0, 7.0], [0.0, 4.0, 1.0, 3.0, 0.0, 0.0]])
    cell = torch.tensor([0, 0, 1, 2, 2, 2])
    assert means_of_cells(values, cell, 2).tolist() == [[2.0, 6.0], [2.0, 1.0]]
    assert means_of_cells(values, cell, 4).tolist() == [[], []]
    assert means_of_cells(values[:, :0], cell[:0], 1).tolist() == [[], []]


def test_a_median_deviation_is_that_of_a_normal_law_whatever_the_worst_are() -> None:
    off = torch.randn(2, 20_001, generator=torch.Generator().manual_seed(0)) * torch.tensor([[0.1], [3.0]])
    torch.testing.assert_close(median_deviation(off), torch.tensor([0.1, 3.0]), rtol=0.03, atol=0)
    worse = torch.where(off.abs() > off.abs().median(dim=-1, keepdim=True).values, 1e6 * off, off)
    torch.testing.assert_close(median_deviation(worse), median_deviation(off), rtol=0, atol=0)


def test_grain_is_what_goes_from_pixel_to_pixel() -> None:
    """Neither what changes slowly, nor an edge, nor what is not known."""
    size, radius = 60, 4
    noise = torch.randn((2, size, size), generator=torch.Generator().manual_seed(0))
    difference = noise * torch.tensor([0.1, 2.0])[:, None, None] + torch.linspace(-0.3, 0.3, size)
    difference[:, :15, 30:] += 7.0
    where = torch.ones((size, size), dtype=torch.bool)
    where[:, 40:] = False
    difference[:, :, 40:] += 100.0
    expected = torch.tensor([0.1, 2.0]) * math.sqrt(1 - 1 / (2 * radius + 1) ** 2)
    torch.testing.assert_close(grain(difference, where, radius), expected, rtol=0.1, atol=0)
