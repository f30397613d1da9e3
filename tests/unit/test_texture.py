"""Where in a patch its texture lies: against least squares pixel by pixel, and closed forms."""

import numpy as np
import pytest
import torch
from torch import Tensor

from backend.maths.texture import leverage

NOISE = 1e-3
THINNEST = 0.5
"""Variance that the texture of every patch has in each direction, in square pixels."""


def everywhere(image: Tensor) -> Tensor:
    return torch.ones_like(image, dtype=torch.bool)


def by_least_squares(image: Tensor, radius: int, noise: float, row: int, column: int) -> float:
    """The variance of a plane's value in the middle, as a share of that of a plane without slope."""
    values = image.double().numpy()
    rows, columns = np.mgrid[row - radius : row + radius + 1, column - radius : column + radius + 1]
    along = (values[rows, columns + 1] - values[rows, columns - 1]) / 2
    down = (values[rows + 1, columns] - values[rows - 1, columns]) / 2
    weight = (along**2 + down**2 + (0.5 * noise) ** 2).ravel()
    design = np.stack([np.ones(weight.size), (columns - column).ravel(), (rows - row).ravel()], axis=1)
    information = design.T @ (weight[:, None] * design)
    information[1:, 1:] += THINNEST * weight.sum() * np.eye(2)
    return float(np.linalg.inv(information)[0, 0] * weight.sum())


@pytest.mark.parametrize("radius", [2, 3])
@pytest.mark.parametrize("noise", [NOISE, 0.3])
def test_it_is_the_variance_of_the_middle_of_a_weighted_fit(radius: int, noise: float) -> None:
    image = torch.rand(24, 24, generator=torch.Generator().manual_seed(0)) ** 6
    found = leverage(image, everywhere(image), radius, noise)
    for row, column in ((6, 7), (12, 9), (17, 15), (9, 16)):
        assert found[row, column].item() == pytest.approx(
            by_least_squares(image, radius, noise, row, column), rel=1e-4
        )
    assert (found >= 1).all()


def test_beside_an_edge_it_grows_with_the_square_of_the_distance() -> None:
    """Two columns of gradient, half a pixel to either side of the step."""
    image = torch.zeros(20, 40)
    image[:, 20:] = 1.0
    found = leverage(image, everywhere(image), 3, NOISE)
    for column in (17, 18, 19, 20, 21, 22):
        distance_px = abs(column - 19.5)
        assert found[10, column].item() == pytest.approx(1 + distance_px**2 / (0.25 + THINNEST), rel=1e-3)


def test_where_there_is_noise_alone_it_lies_evenly() -> None:
    image = torch.full((20, 20), 0.3)
    torch.testing.assert_close(leverage(image, everywhere(image), 3, NOISE)[4:-4, 4:-4], torch.ones(12, 12))


def test_the_outline_of_the_subject_is_no_texture() -> None:
    image = torch.zeros(20, 40)
    image[:, :20] = 0.5
    subject = everywhere(image)
    subject[:, 20:] = False
    found = leverage(image, subject, 3, NOISE)
    torch.testing.assert_close(found[4:-4, 4:20], torch.ones(12, 16), atol=1e-5, rtol=0)
