"""Undistortion against a scene whose colour is a known function of the ray."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image  # noqa: F401 - before pycolmap
import pycolmap
import pytest

from backend.errors import ErrorCode, ReconstructionError
from backend.scene import Photo
from backend.stages.cameras.lenses import (
    SMALLEST_ZOOM,
    PlacedPhoto,
    is_pinhole,
    photo_lens,
    rescaled_lens,
    smallest_filled_zoom_or_none,
    source_pixels,
    undistorted_view,
)

WIDTH, HEIGHT = 160, 120

LENSES = {
    "barrel": ("SIMPLE_RADIAL", [150.0, 80.0, 60.0, -0.2]),
    "pincushion": ("RADIAL", [150.0, 82.0, 57.0, 0.15, 0.02]),
    "tangential": ("OPENCV", [150.0, 153.0, 78.0, 61.0, -0.15, 0.03, 0.004, -0.003]),
    "six coefficients": ("FULL_OPENCV", [150.0, 150.0, 80.0, 60.0, -0.2, 0.05, 0, 0, 0.01, 0, 0, 0]),
    "fisheye": ("OPENCV_FISHEYE", [90.0, 91.0, 80.0, 60.0, 0.02, -0.01, 0.0, 0.0]),
    "plain fisheye": ("OPENCV_FISHEYE", [90.0, 90.0, 80.0, 60.0, 0.0, 0.0, 0.0, 0.0]),
    "field of view": ("FOV", [100.0, 100.0, 80.0, 60.0, 0.8]),
    "thin prism": ("THIN_PRISM_FISHEYE", [90.0, 90.0, 80.0, 60.0, 0.01, 0, 0.001, 0.002, 0, 0, 0.001, 0]),
}


@pytest.fixture(params=LENSES.values(), ids=LENSES.keys())
def lens(request: pytest.FixtureRequest) -> pycolmap.Camera:
    model, params = request.param
    return pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params)


def colour(rays: np.ndarray) -> np.ndarray:
    """A smooth colour for each ray (x, y) with z = 1."""
    x, y = rays[..., 0], rays[..., 1]
    return np.stack([np.sin(5 * x + 1), np.cos(4 * y), np.sin(3 * x * y + 2 * y)], axis=-1) / 2.5 + 0.5


def pixel_centres() -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), axis=-1)


def photograph(lens: pycolmap.Camera) -> Photo:
    """Taken through the lens: each pixel's ray found by the lens's own inverse."""
    rays = lens.cam_from_img(pixel_centres().reshape(-1, 2)).reshape(HEIGHT, WIDTH, 2)
    image = colour(rays).astype(np.float32)
    return Photo(
        name="a.jpg",
        path=Path("a.jpg"),
        image_srgb=image,
        mask=image[..., 0].copy(),
        original_width=WIDTH,
        original_height=HEIGHT,
        focal_px=None,
    )


def placed(lens: pycolmap.Camera) -> PlacedPhoto:
    return PlacedPhoto(index=0, lens=lens, camera_from_world=np.eye(4))


def test_undistorted_as_a_pinhole_would_have_seen_it(lens: pycolmap.Camera) -> None:
    view = undistorted_view(photograph(lens), placed(lens))
    camera = view.camera
    rays = (pixel_centres() - (camera.cx_px, camera.cy_px)) / (camera.fx_px, camera.fy_px)
    np.testing.assert_allclose(view.image_srgb, colour(rays), atol=4e-3)
    assert view.mask is not None
    np.testing.assert_allclose(view.mask, colour(rays)[..., 0], atol=4e-3)


def test_no_blank_border_and_no_more_zoom_than_it_needs(lens: pycolmap.Camera) -> None:
    camera = undistorted_view(photograph(lens), placed(lens)).camera
    margins = np.concatenate(
        [source_pixels(lens, camera) - 0.5, (WIDTH, HEIGHT) - source_pixels(lens, camera) - 0.5]
    )
    assert margins.min() > -0.6, "blank"
    at_the_limit = camera.fx_px == pytest.approx(SMALLEST_ZOOM * lens.focal_length_x, rel=1e-6)
    assert at_the_limit or margins.min() < 0.6, "cut off"


def test_world_points_fall_where_the_lens_put_them(lens: pycolmap.Camera) -> None:
    camera = undistorted_view(photograph(lens), placed(lens)).camera
    sources = source_pixels(lens, camera)
    for row, column in [(0, 0), (60, 80), (119, 30), (17, 159)]:
        ray = np.linalg.inv(camera.intrinsics) @ [column + 0.5, row + 0.5, 1.0]
        np.testing.assert_allclose(sources[row, column], lens.img_from_cam(7.0 * ray), atol=1e-6)


def test_the_size_at_which_the_lens_was_measured_does_not_matter(lens: pycolmap.Camera) -> None:
    photo = photograph(lens)
    view = undistorted_view(photo, placed(lens))
    other = undistorted_view(photo, placed(rescaled_lens(lens, 2 * WIDTH, 2 * HEIGHT)))
    np.testing.assert_allclose(other.camera.intrinsics, view.camera.intrinsics, rtol=1e-2)
    assert (other.camera.width, other.camera.height) == (WIDTH, HEIGHT)


def test_a_pinhole_changes_nothing() -> None:
    lens = pycolmap.Camera(model="PINHOLE", width=WIDTH, height=HEIGHT, params=[150.0, 140.0, 70.0, 66.0])
    photo = replace(photograph(lens), mask=None)
    view = undistorted_view(photo, placed(lens))
    assert view.image_srgb is photo.image_srgb
    assert view.mask is None
    np.testing.assert_array_equal(view.camera.intrinsics, [[150, 0, 70], [0, 140, 66], [0, 0, 1]])


def test_a_fisheye_without_coefficients_is_no_pinhole() -> None:
    model, params = LENSES["plain fisheye"]
    assert not is_pinhole(pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params))


@pytest.mark.parametrize("params", [[150.0, 80.0, 60.0, -900.0], [150.0, -500.0, 60.0, -0.1]])
def test_a_senseless_lens_is_refused(params: list[float]) -> None:
    lens = pycolmap.Camera(model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=params)
    assert smallest_filled_zoom_or_none(lens) is None
    image = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    straight = pycolmap.Camera(model="PINHOLE", width=WIDTH, height=HEIGHT, params=[9.0, 9.0, 80.0, 60.0])
    photo = replace(photograph(straight), image_srgb=image)
    with pytest.raises(ReconstructionError, match=r"a\.jpg") as caught:
        undistorted_view(photo, placed(lens))
    assert caught.value.code == ErrorCode.CAMERAS_UNUSABLE


def test_the_view_ends_before_the_lens_folds() -> None:
    """r (1 - r^2) turns back at r = 0.58, inside the picture: beyond, the scene would repeat mirrored."""
    lens = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=[150.0, 80.0, 60.0, -1.0]
    )
    sources = source_pixels(lens, undistorted_view(photograph(lens), placed(lens)).camera)
    radii = np.linalg.norm(sources - (80.0, 60.0), axis=-1)
    outwards = np.stack([radii[60 - step, 80 - step * 4 // 3] for step in range(0, 60, 3)])
    assert (np.diff(outwards) > 0).all()


def test_each_side_scales_the_focal_length_along_it() -> None:
    """A picture of 101x67 scaled to 50x33 is lowered less than narrowed; a lens follows both."""
    lens = pycolmap.Camera(model="SIMPLE_RADIAL", width=101, height=67, params=[90.0, 50.0, 33.0, -0.1])
    photo = replace(photograph(lens), original_width=50, original_height=33)
    found = photo_lens(photo, placed(lens))
    across, down = 50 / 101, 33 / 67
    assert (found.model, found.width, found.height) == ("OPENCV", 50, 33)
    np.testing.assert_allclose(
        found.params, [90 * across, 90 * down, 50 * across, 33 * down, -0.1, 0, 0, 0], rtol=1e-12
    )
