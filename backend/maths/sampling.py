"""Colours of points in the world, read from the photographs that show them."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from ..scene import View
from .projection import in_picture, projected

_UNSEEN_GREY = 128


def colours_at(view: View, points: Float64[np.ndarray, "points 3"]) -> Float64[np.ndarray, "points 4"]:
    """Bilinear sRGB colours (0 to 1) and mask of the photograph where it shows the points (world frame).

    The points lie in front of the camera; beyond the border the nearest pixel counts.
    """
    pixel = projected(points, view.camera)[0] - 0.5
    limit = np.array([view.camera.width - 1, view.camera.height - 1])
    low = np.clip(np.floor(pixel), 0, np.maximum(limit - 1, 0)).astype(int)
    t = np.clip(pixel - low, 0, 1)
    (x, y), (s, u) = low.T, t.T[..., None]
    mask = np.ones(view.image_srgb.shape[:2], np.float32) if view.mask is None else view.mask
    image, right, down = (
        np.dstack([view.image_srgb, mask]),
        np.minimum(x + 1, limit[0]),
        np.minimum(y + 1, limit[1]),
    )
    upper = image[y, x] * (1 - s) + image[y, right] * s
    lower = image[down, x] * (1 - s) + image[down, right] * s
    return np.asarray(upper * (1 - u) + lower * u, np.float64)


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
