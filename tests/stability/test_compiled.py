"""What is compiled, against double precision: the soft maximum's exponential, sums over many rows."""

import numpy as np
import pytest

from backend.kernels.compiled import Floats
from backend.kernels.patch_correlation import correlate, exponential

NOWHERE_ELSE = (np.eye(3, dtype=np.float32), np.zeros(3, np.float32))
FLOOR = np.float32(1e-5)
RADIUS = 3


def test_the_exponential_is_within_2e5_of_itself() -> None:
    x = np.concatenate([np.linspace(-14, 0, 20_001), [-1e-30, -1e-7]]).astype(np.float32)
    found = np.array([exponential(value) for value in x], np.float64)
    np.testing.assert_allclose(found, np.exp(x.astype(np.float64)), rtol=2e-5)
    assert exponential(np.float32(0)) == 1
    assert exponential(np.float32(-1e30)) > 0  # a weight of a sum that holds a 1


def correlation_in_double(image: Floats, other: Floats) -> np.ndarray:
    """Of patches that lie in the image as a whole."""
    size = 2 * RADIUS + 1
    one, two = (
        np.lib.stride_tricks.sliding_window_view(values.astype(np.float64), (size, size))
        for values in (image, other)
    )
    one = one - one.mean(axis=(2, 3), keepdims=True)
    two = two - two.mean(axis=(2, 3), keepdims=True)
    of_one, of_two = (one**2).mean(axis=(2, 3)), (two**2).mean(axis=(2, 3))
    scores: np.ndarray = (one * two).mean(axis=(2, 3)) / np.sqrt((of_one + FLOOR) * (of_two + FLOOR))
    return scores


@pytest.mark.parametrize("bright", [1.0, 1e3])
def test_a_bright_band_leaves_nothing_behind(bright: float) -> None:
    """Sums that rows join and leave, in one tile of 400 rows: what lies below a band is not worse for it."""
    rng = np.random.default_rng(3)
    image, other = rng.normal(0, 0.02, (2, 400, 40)).astype(np.float32)
    image[150:160] += np.float32(bright)
    other[150:160] -= np.float32(bright)
    size = 2 * RADIUS + 1
    windows = np.lib.stride_tricks.sliding_window_view(image.astype(np.float64), (size, size))
    count, mean, variance = np.full((3, *image.shape), size * size, np.float32)
    inner = slice(RADIUS, -RADIUS)
    mean[inner, inner], variance[inner, inner] = windows.mean(axis=(2, 3)), windows.var(axis=(2, 3))
    scores = np.empty((1, 400, 40), np.float32)
    patches = (image, np.ones_like(image), count, mean, variance)
    depth = np.ones((1, *image.shape), np.float32)
    correlate((0, 400, 0, 40), RADIUS, patches, other, NOWHERE_ELSE, FLOOR, depth, scores)
    expected = correlation_in_double(image, other)
    error = np.abs(scores[0, inner, inner] - expected)
    away = np.r_[:140, 170 - RADIUS : error.shape[0]]
    assert error[away].max() < 1e-5


def test_sums_that_rows_join_and_leave_in_single_precision_do() -> None:
    """The usual running sum: what a band of 1000 adds and takes away leaves a hundredth of small values."""
    rng = np.random.default_rng(3)
    values = rng.normal(0, 0.02, 400).astype(np.float32)
    values[150:160] += np.float32(1e3)
    running, worst = np.float32(0), 0.0
    for row, value in enumerate(values):
        running += value - (values[row - 7] if row >= 7 else np.float32(0))
        if row >= 170:
            worst = max(worst, abs(float(running) - values[row - 6 : row + 1].sum(dtype=np.float64)))
    assert worst > 2e-5
