"""Two rays give back the point they come from, or say that they do not meet."""

import numpy as np
import pytest

from backend.scene import Camera, transform_points
from backend.stages.cameras.triangulation import two_view_points


def camera_at(x: float) -> Camera:
    """A camera at (x, 0, -4) that looks along z."""
    pose = np.eye(4)
    pose[:3, 3] = [-x, 0, 4]
    return Camera(
        camera_from_world=pose, fx_px=500.0, fy_px=480.0, cx_px=310.0, cy_px=250.0, width=640, height=480
    )


def pixels(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Where the camera sees world points."""
    homogeneous = transform_points(camera.camera_from_world, points) @ camera.intrinsics.T
    return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:])


POINTS = np.random.default_rng(0).uniform(-1, 1, (50, 3))


def test_exact_pixels_give_the_points() -> None:
    a, b = camera_at(-0.5), camera_at(0.7)
    found, good = two_view_points(a, b, pixels(a, POINTS), pixels(b, POINTS))
    assert good.all()
    np.testing.assert_allclose(found, POINTS, atol=1e-9)


@pytest.mark.parametrize("shift_px", [8.0, -8.0])
def test_rays_that_pass_each_other_are_no_point(shift_px: float) -> None:
    a, b = camera_at(-0.5), camera_at(0.7)
    _, good = two_view_points(a, b, pixels(a, POINTS), np.add(pixels(b, POINTS), [0, shift_px]))
    assert not good.any()


def test_a_point_behind_the_cameras_is_none() -> None:
    a, b = camera_at(-0.5), camera_at(0.7)
    _, good = two_view_points(a, b, np.add(pixels(a, POINTS), [-200, 0]), np.add(pixels(b, POINTS), [200, 0]))
    assert not good.any()


def test_nearly_parallel_rays_are_none() -> None:
    a, b = camera_at(0.0), camera_at(0.02)
    _, good = two_view_points(a, b, pixels(a, POINTS), pixels(b, POINTS))
    assert not good.any()


def test_cameras_in_one_place_see_no_point() -> None:
    a = camera_at(0.0)
    _, good = two_view_points(a, a, pixels(a, POINTS), np.add(pixels(a, POINTS), [3, 2]))
    assert not good.any()
