"""Against SciPy's median, which sorts."""

import numpy as np
import pytest
import torch
from scipy.ndimage import median_filter

from backend.maths.median import median_3x3


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (2, 2), (37, 50)])
def test_it_is_the_median_of_nine(shape: tuple[int, int]) -> None:
    values = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    assert np.array_equal(median_3x3(torch.tensor(values)).numpy(), median_filter(values, 3, mode="nearest"))


def test_equal_values_and_single_outliers() -> None:
    values = torch.ones(9, 9)
    values[4, 4], values[0, 0], values[8, 3] = torch.inf, -torch.inf, 1e30
    assert torch.equal(median_3x3(values), torch.ones(9, 9))
