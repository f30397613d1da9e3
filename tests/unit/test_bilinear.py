"""Bilinear reading: what is linear comes back exactly, at the border as inside."""

import numpy as np
import pytest

from backend.maths.bilinear import bilinear, shrunk


def ramp(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.stack([2 * x - y, 0.5 * y + 1], axis=-1)


def picture(width: int = 7, height: int = 5) -> np.ndarray:
    y, x = np.mgrid[:height, :width] + 0.5
    return ramp(x, y)


def test_a_plane_comes_back_between_pixel_centres() -> None:
    places = np.random.default_rng(0).uniform([0.5, 0.5], [6.5, 4.5], (50, 2))
    np.testing.assert_allclose(bilinear(picture(), places), ramp(*places.T), atol=1e-12)


@pytest.mark.parametrize(
    ("place", "nearest"), [((-3, 2.5), (0.5, 2.5)), ((9, 99), (6.5, 4.5)), ((3.5, 0.1), (3.5, 0.5))]
)
def test_beyond_the_centres_at_the_border_the_nearest_counts(
    place: tuple[float, float], nearest: tuple[float, float]
) -> None:
    both = bilinear(picture(), np.array([place, nearest], np.float64))
    np.testing.assert_allclose(both[0], both[1])


def test_a_picture_of_one_pixel_is_that_everywhere() -> None:
    one = np.full((1, 1, 3), 7, np.uint8)
    np.testing.assert_array_equal(bilinear(one, np.array([[0.0, 0.0], [0.5, 3.0]])), np.full((2, 3), 7.0))


@pytest.mark.parametrize("place", [(np.nan, 2.5), (3.5, np.nan), (np.inf, -np.inf), (1e300, 1e300)])
def test_a_place_that_is_nowhere_is_read_from_within_the_picture(place: tuple[float, float]) -> None:
    values = bilinear(picture(), np.array([place]))
    assert picture().min() <= values.min() <= values.max() <= picture().max()


def test_pixels_of_any_kind_and_places_of_any_shape_are_read() -> None:
    places = np.random.default_rng(0).uniform(0, 4, (3, 2, 4))[:, ::-1, ::2]  # with gaps in memory
    image = np.arange(24, dtype=np.uint8).reshape(4, 2, 3).swapaxes(0, 1)
    found = bilinear(image, places)
    assert found.shape == (3, 2, 3)
    for kind in (np.float32, np.float64):
        np.testing.assert_allclose(bilinear(image.astype(kind), places), found)
    np.testing.assert_allclose(bilinear(image, places.reshape(-1, 2)), found.reshape(-1, 3))


@pytest.mark.parametrize("times", [1, 2, 3, 10])
def test_a_smaller_picture_has_the_means(times: int) -> None:
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    small = shrunk(image, times)
    assert small.shape == (-(-5 // times), -(-7 // times), 3)
    for row, column in np.ndindex(small.shape[:2]):
        block = image[row * times : (row + 1) * times, column * times : (column + 1) * times]
        np.testing.assert_allclose(small[row, column], block.mean(axis=(0, 1)), rtol=1e-5)


def test_places_of_a_smaller_picture_are_those_of_the_whole_divided() -> None:
    places = np.random.default_rng(0).uniform([4, 4], [36, 26], (40, 2))
    found = bilinear(shrunk(picture(40, 30), 2), places / 2)
    np.testing.assert_allclose(found, ramp(*places.T), rtol=1e-5)
