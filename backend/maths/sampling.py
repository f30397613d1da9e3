"""Colours of points in the world, read from the photographs that show them."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from ..scene import View, transform_points
from .bilinear import bilinear
from .projection import in_picture, in_pixels

_UNSEEN_GREY = 128


def colours_at(view: View, points: Float64[np.ndarray, "points 3"]) -> Float64[np.ndarray, "points 4"]:
    """Bilinear sRGB colours (0 to 1) and mask of the photograph where it shows the points (world frame).

    The points lie in front of the camera; beyond the border the nearest pixel counts.
    """
    return colours_in_camera(view, transform_points(view.camera.camera_from_world, points))


def colours_in_camera(
    view: View, in_camera: Float64[np.ndarray, "points 3"]
) -> Float64[np.ndarray, "points 4"]:
    """The same of points in the camera's axes."""
    pixels = in_pixels(in_camera, view.camera)
    return np.column_stack([bilinear(view.image_srgb, pixels), mask_at(view, pixels)])


def mask_at(view: View, pixels: Float64[np.ndarray, "points 2"]) -> Float64[np.ndarray, "points"]:
    """Mask of a photograph at places of it; 1 where it has none."""
    return np.ones(len(pixels)) if view.mask is None else bilinear(view.mask[..., None], pixels)[:, 0]


def mean_colours(
    views: Sequence[View],
    points: Float64[np.ndarray, "points 3"],
    seen: Bool[np.ndarray, "points views"],
) -> UInt8[np.ndarray, "points 3"]:
    """Mean sRGB colour of each point in the photographs that see it; mid grey where none shows it."""
    total, count = np.zeros((len(points), 3)), np.zeros(len(points))
    for column, view in enumerate(views):
        mine = np.flatnonzero(seen[:, column] & in_picture(points, view.camera))
        total[mine] += 255 * colours_at(view, points[mine])[:, :3]
        count[mine] += 1
    total[count == 0] = _UNSEEN_GREY
    return np.clip(total / np.maximum(count, 1)[:, None] + 0.5, 0, 255).astype(np.uint8)
