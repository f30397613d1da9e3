"""Points that photographs share, where the cameras are known: they say where the subject is."""

from pathlib import Path

import numpy as np
import PIL.Image
import pycolmap
from jaxtyping import Bool, Float64

from ...images import fitted_size, resized
from ...maths.lines import nearest_along
from ...scene import Camera, Progress, View, within
from .features import (
    LensGroup,
    brightness,
    extract_features,
    match_pictures,
    picture_index,
    picture_name,
    register_pictures,
)

_MAX_SIDE_PX = 800
_NUM_FEATURES = 2_000
_LARGEST_ERROR_PX = 2.0
_SMALLEST_ANGLE_DEG = 1.5


def triangulate(
    views: tuple[View, ...],
    *,
    workdir: Path,
    seed: int,
    progress: Progress,
    largest_error_px: float = _LARGEST_ERROR_PX,
) -> tuple[Float64[np.ndarray, "points 3"], Bool[np.ndarray, "points views"]]:
    """Positions (world frame) of features that two views share, and by which views.

    A feature shared by three views comes twice: the points are to locate the subject, not to be counted.
    """
    folder, database = workdir / "known", workdir / "known.db"
    folder.mkdir(parents=True, exist_ok=True)
    database.unlink(missing_ok=True)
    cameras = []
    for index, view in enumerate(views):
        width, height = fitted_size(view.camera.width, view.camera.height, _MAX_SIDE_PX)
        grey = brightness(resized(view.image_srgb, width, height))
        PIL.Image.fromarray(grey).save(folder / picture_name(index), compress_level=1)
        cameras.append(view.camera.resized(width, height))
    groups = [
        LensGroup(names=(picture_name(i),), width=c.width, height=c.height, focal_px=c.fx_px)
        for i, c in enumerate(cameras)
    ]
    register_pictures(database, folder, groups)
    extract_features(database, folder, groups, _NUM_FEATURES, progress=within(progress, 0.0, 0.5))
    match_pictures(database, seed=seed, progress=within(progress, 0.5, 1.0))
    return _points_of_pairs(database, cameras, largest_error_px)


def _points_of_pairs(
    database: Path, cameras: list[Camera], largest_error_px: float
) -> tuple[Float64[np.ndarray, "points 3"], Bool[np.ndarray, "points views"]]:
    positions, visibility = [np.zeros((0, 3))], [np.zeros((0, len(cameras)), bool)]
    with pycolmap.Database.open(database) as opened:
        ids = {picture_index(image.name): image.image_id for image in opened.read_all_images()}
        pixels = {
            i: np.asarray(opened.read_keypoints(ids[i]), np.float64)[:, :2] for i in range(len(cameras))
        }
        for i in range(len(cameras)):
            for j in range(i + 1, len(cameras)):
                matches = np.asarray(opened.read_two_view_geometry(ids[i], ids[j]).inlier_matches)
                if len(matches):
                    first, second = pixels[i][matches[:, 0]], pixels[j][matches[:, 1]]
                    points, good = two_view_points(cameras[i], cameras[j], first, second, largest_error_px)
                    seen = np.zeros((int(good.sum()), len(cameras)), bool)
                    seen[:, [i, j]] = True
                    positions.append(points[good])
                    visibility.append(seen)
    return np.concatenate(positions), np.concatenate(visibility)


def two_view_points(
    a: Camera,
    b: Camera,
    pixels_a: Float64[np.ndarray, "points 2"],
    pixels_b: Float64[np.ndarray, "points 2"],
    largest_error_px: float = _LARGEST_ERROR_PX,
) -> tuple[Float64[np.ndarray, "points 3"], Bool[np.ndarray, "points"]]:
    """The middle of the shortest line between two rays (world frame), and where that is a point.

    It is one where both rays pass within a few pixels of it, in front of both cameras, at an angle.
    """
    ray_a, ray_b = _rays(a, pixels_a), _rays(b, pixels_b)
    apart = b.position - a.position
    along_a, along_b = nearest_along(apart, ray_a, ray_b), nearest_along(-apart, ray_b, ray_a)
    on_a, on_b = a.position + along_a[:, None] * ray_a, b.position + along_b[:, None] * ray_b
    gap = np.linalg.norm(on_a - on_b, axis=1) / 2
    good = (along_a > 0) & (along_b > 0)
    # else it is no point anyway: cameras in one place have all of them at 0
    far_a, far_b = np.where(good, along_a, 1.0), np.where(good, along_b, 1.0)
    good &= np.maximum(gap * a.fx_px / far_a, gap * b.fx_px / far_b) < largest_error_px
    sine2 = (np.cross(ray_a, ray_b) ** 2).sum(axis=1)
    good &= sine2 > np.sin(np.deg2rad(_SMALLEST_ANGLE_DEG)) ** 2
    return (on_a + on_b) / 2, good


def _rays(camera: Camera, pixels: Float64[np.ndarray, "points 2"]) -> Float64[np.ndarray, "points 3"]:
    """Unit directions, world frame."""
    homogeneous = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)
    directions = homogeneous @ np.linalg.inv(camera.intrinsics).T @ camera.camera_from_world[:3, :3]
    unit: Float64[np.ndarray, "points 3"] = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return unit
