"""Window sums and patch correlation against loops, and what correlation must not depend on."""

import numpy as np
import pytest
import scipy.ndimage
import torch
from torch import Tensor

from backend.maths.correlation import (
    correlation,
    patch_statistics,
    window_mean,
    window_sum,
    without_local_mean,
)


def noise_image(seed: int, *shape: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*(shape or (14, 18)), generator=generator, dtype=torch.float64)


def disc() -> Tensor:
    """A subject that covers the middle of the image."""
    rows, columns = torch.meshgrid(torch.arange(14.0), torch.arange(18.0), indexing="ij")
    return ((rows - 6).hypot(columns - 8) < 5).double()


@pytest.mark.parametrize("radius", [0, 1, 3])
def test_window_sum_is_a_box_filter(radius: int) -> None:
    values = noise_image(0, 3, 9, 12)
    box = np.ones((1, 2 * radius + 1, 2 * radius + 1))
    expected = scipy.ndimage.convolve(values.numpy(), box, mode="constant")
    torch.testing.assert_close(window_sum(values, radius), torch.tensor(expected))


def test_window_sum_reaches_over_an_image_smaller_than_the_window() -> None:
    values = noise_image(0, 3, 5)
    torch.testing.assert_close(window_sum(values, 4), values.sum().expand(3, 5))


def test_window_sum_does_not_care_for_what_is_far_away() -> None:
    """Differences of running sums are off by a millionth of all that is above and to the left."""
    values = noise_image(0, 9, 400).float()
    beside = torch.cat([1e7 * torch.ones(9, 50), values], dim=1)
    torch.testing.assert_close(window_sum(beside, 3)[:, 60:], window_sum(values, 3)[:, 10:])


def test_window_mean_counts_only_what_has_weight() -> None:
    values, weight = noise_image(0), noise_image(1).abs() * disc()
    mean = window_mean(values, weight, 2)
    near = slice(4, 9), slice(6, 11)
    expected = (values[near] * weight[near]).sum() / weight[near].sum()
    torch.testing.assert_close(mean[6, 8], expected)
    torch.testing.assert_close(mean[0, 17], torch.tensor(0.0, dtype=torch.float64))
    everywhere_seven = window_mean(torch.full_like(values, 7.0), torch.ones_like(values), 2)
    torch.testing.assert_close(everywhere_seven, torch.full_like(values, 7.0))


def test_local_mean_removes_brightness_on_the_subject_and_clears_what_lies_off_it() -> None:
    image, subject = noise_image(0), disc()
    flattened = without_local_mean(image, subject, 3)
    torch.testing.assert_close(without_local_mean(image + 5, subject, 3), flattened)
    assert (flattened[subject == 0] == 0).all()
    torch.testing.assert_close(without_local_mean(torch.ones_like(image), subject, 3), 0 * image)


def correlation_one_by_one(
    image: Tensor, subject: Tensor, warped: Tensor, radius: int, noise: float
) -> Tensor:
    """The definition, patch by patch."""
    result = torch.zeros_like(image)
    for row, column in np.ndindex(*image.shape):
        rows = slice(max(row - radius, 0), row + radius + 1)
        columns = slice(max(column - radius, 0), column + radius + 1)
        weight, a, b = subject[rows, columns], image[rows, columns], warped[rows, columns]
        if weight.sum() == 0:
            continue
        share = weight / weight.sum()
        a, b = a - (share * a).sum(), b - (share * b).sum()
        spread = ((share * a * a).sum() + noise**2) * ((share * b * b).sum() + noise**2)
        result[row, column] = (share * a * b).sum() / spread.sqrt()
    return result


def test_correlation_matches_the_definition() -> None:
    image, warped, subject = noise_image(0), noise_image(1, 2, 14, 18), disc()
    score = correlation(patch_statistics(image, subject, 2), warped, 0.1)
    expected = torch.stack([correlation_one_by_one(image, subject, one, 2, 0.1) for one in warped])
    torch.testing.assert_close(score, expected, atol=1e-9, rtol=0)


@pytest.mark.parametrize("gain", [0.3, 4.0, -1.0])
def test_correlation_does_not_depend_on_exposure(gain: float) -> None:
    image = noise_image(0)
    statistics = patch_statistics(image, torch.ones_like(image), 2)
    score = correlation(statistics, (gain * image + 0.7)[None], 1e-6)
    torch.testing.assert_close(score, torch.full_like(score, np.sign(gain)), atol=1e-6, rtol=0)


def test_correlation_does_not_depend_on_what_lies_off_the_subject() -> None:
    image, warped, subject = noise_image(0), noise_image(1, 1, 14, 18), disc()
    score = correlation(patch_statistics(image, subject, 2), warped, 0.1)
    backdrop = 3 * noise_image(2) * (1 - subject)
    other = correlation(patch_statistics(image + backdrop, subject, 2), warped - 2 * backdrop, 0.1)
    torch.testing.assert_close(other, score)
    assert not torch.allclose(
        correlation(patch_statistics(image + backdrop, torch.ones_like(subject), 2), warped, 0.1), score
    )


def test_flat_patches_score_low_whatever_they_are_compared_with() -> None:
    """Of a patch with itself the score is variance / (variance + noise^2)."""
    image = noise_image(0)
    for scale, noise in ((1e-3, 0.1), (1.0, 0.5)):
        statistics = patch_statistics(scale * image, torch.ones_like(image), 2)
        expected = statistics.variance / (statistics.variance + noise**2)
        torch.testing.assert_close(correlation(statistics, scale * image[None], noise)[0], expected)
    assert (
        correlation(patch_statistics(0 * image, torch.ones_like(image), 2), image[None], 0.1).abs().max()
        < 1e-9
    )


def test_empty_windows_score_zero_and_stay_finite() -> None:
    image = noise_image(0).float()
    statistics = patch_statistics(image, torch.zeros_like(image), 2)
    assert (correlation(statistics, image[None], 0.01) == 0).all()
    sparse = torch.zeros_like(image)
    sparse[3, 3] = 1.0
    assert correlation(patch_statistics(image, sparse, 2), image[None], 0.01).abs().max() <= 1
