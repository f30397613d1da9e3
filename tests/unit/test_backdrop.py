"""An empty backdrop is found where there is one, and only there."""

import torch

from backend.maths.backdrop import find_backdrop

EVERYWHERE = torch.ones((60, 80), dtype=torch.bool)


def picture(backdrop: float) -> torch.Tensor:
    """A textured square of 30 pixels before an even backdrop with a grain of two grey levels, 60 x 80."""
    grain = torch.rand((3, 60, 80), generator=torch.Generator().manual_seed(0)) * 2 / 255
    image = backdrop + grain
    image[:, 15:45, 25:55] = torch.rand((3, 30, 30), generator=torch.Generator().manual_seed(1)) * 0.5 + 0.4
    return image


def test_a_black_backdrop_is_all_that_is_not_the_subject() -> None:
    found = find_backdrop(picture(0.0), EVERYWHERE)
    assert found is not None
    empty = found.empty
    assert not empty[15:45, 25:55].any()
    assert empty.float().mean() > 0.95 * (1 - 900 / 4800)


def test_the_subject_is_what_is_far_from_the_backdrops_colour() -> None:
    image = picture(0.0)
    image[:, 0:10, 0:30] = 0.06  # a dark board at the side is neither
    found = find_backdrop(image, EVERYWHERE)
    assert found is not None
    assert found.subject[15:45, 25:55].all()
    assert found.subject.sum() == 900
    assert not found.empty[1:9, 1:29].any()


def test_a_gap_within_the_subject_shows_the_backdrop() -> None:
    image = picture(0.0)
    image[:, 25:35, 35:45] = 0.0
    found = find_backdrop(image, EVERYWHERE)
    assert found is not None
    empty = found.empty
    assert empty[26:34, 36:44].all()


def test_specks_of_the_backdrops_colour_are_not_holes() -> None:
    image = picture(0.0)
    image[:, 30:33, 40:43] = 0.0
    found = find_backdrop(image, EVERYWHERE)
    assert found is not None
    empty = found.empty
    assert not empty[15:45, 25:55].any()


def test_a_busy_border_is_no_backdrop() -> None:
    assert (
        find_backdrop(torch.rand((3, 60, 80), generator=torch.Generator().manual_seed(2)), EVERYWHERE) is None
    )


def test_a_slope_of_brightness_is_no_backdrop() -> None:
    assert find_backdrop(torch.linspace(0, 1, 80).expand(3, 60, 80), EVERYWHERE) is None


def test_a_picture_too_dark_to_tell_has_no_backdrop() -> None:
    assert find_backdrop(0.1 * picture(0.0), EVERYWHERE) is None
