"""Colours of points against photographs whose colour is a known function of the pixel."""

import numpy as np
import pytest

from backend.maths.sampling import colours_at, mean_colours
from backend.scene import Camera, View

WIDTH, HEIGHT, FOCAL_PX = 40, 30, 35.0


def view(position: tuple[float, float, float], level: float = 0.0, mask: np.ndarray | None = None) -> View:
    """A camera that looks along z; its picture is red by column and green by row, raised by `level`."""
    pose = np.eye(4)
    pose[:3, 3] = -np.array(position)
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    picture = np.stack([columns / WIDTH, rows / HEIGHT, np.zeros_like(rows)], axis=-1) / 2 + level
    camera = Camera(
        camera_from_world=pose,
        fx_px=FOCAL_PX,
        fy_px=FOCAL_PX,
        cx_px=WIDTH / 2,
        cy_px=HEIGHT / 2,
        width=WIDTH,
        height=HEIGHT,
    )
    return View(name="a.png", camera=camera, image_srgb=picture.astype(np.float32), mask=mask)


def test_colours_are_those_of_the_pixels_that_show_the_points() -> None:
    points = np.array([[0, 0, 5.0], [1.2, -0.7, 5.0], [-1.2, 1.4, 4.0]])
    columns = FOCAL_PX * points[:, 0] / points[:, 2] / WIDTH + 0.5
    rows = FOCAL_PX * points[:, 1] / points[:, 2] / HEIGHT + 0.5
    found = colours_at(view((0, 0, 0)), points)
    np.testing.assert_allclose(found[:, 0], columns / 2, atol=1e-6)
    np.testing.assert_allclose(found[:, 1], rows / 2, atol=1e-6)
    np.testing.assert_array_equal(found[:, 3], 1.0)


def test_the_mask_is_read_along() -> None:
    mask = np.zeros((HEIGHT, WIDTH), np.float32)
    mask[:, WIDTH // 2 :] = 1
    found = colours_at(view((0, 0, 0), mask=mask), np.array([[1.0, 0, 5], [-1.0, 0, 5], [0, 0, 5]]))
    np.testing.assert_allclose(found[:, 3], [1, 0, 0.5])


@pytest.mark.parametrize(
    ("seen", "level"),
    [((True, True), 0.2), ((True, False), 0.0), ((False, True), 0.4)],
)
def test_a_point_has_the_mean_colour_of_those_that_see_it(seen: tuple[bool, bool], level: float) -> None:
    views = [view((0, 0, 0)), view((0, 0, 0), level=0.4)]
    (found,) = mean_colours(views, np.array([[0.0, 0.0, 5.0]]), np.array([seen]))
    np.testing.assert_allclose(found, 255 * np.array([0.25 + level, 0.25 + level, level]), atol=0.6)


def test_what_no_photograph_shows_is_grey() -> None:
    """Behind the camera, beside the picture, seen by nobody."""
    points = np.array([[0, 0, -5.0], [50, 0, 5.0], [0, 0, 5.0]])
    seen = np.array([[True], [True], [False]])
    np.testing.assert_array_equal(mean_colours([view((0, 0, 0))], points, seen), 128)
    assert mean_colours([view((0, 0, 0))], points[:0], seen[:0]).shape == (0, 3)
