"""Colours of a picture between its pixels, and over several of them."""

import numpy as np
from jaxtyping import Float, Float64, Shaped


def bilinear(
    image: Shaped[np.ndarray, "height width channels"], pixels: Float[np.ndarray, "points 2"]
) -> Float64[np.ndarray, "points channels"]:
    """Values at places (x, y), in pixels; beyond the border the nearest pixel counts."""
    height, width = image.shape[:2]
    place = np.clip(pixels - 0.5, 0, [width - 1, height - 1])
    left, top = np.floor(place).astype(np.intp).T
    right, below = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    s, t = (place - np.stack([left, top], axis=1)).T[..., None]
    flat = image.reshape(height * width, -1)
    upper = flat[top * width + left] * (1 - s) + flat[top * width + right] * s
    lower = flat[below * width + left] * (1 - s) + flat[below * width + right] * s
    return np.asarray(upper * (1 - t) + lower * t)


def shrunk(
    image: Shaped[np.ndarray, "height width channels"], times: int
) -> Shaped[np.ndarray, "new_height new_width channels"]:
    """Means over squares of so many pixels; the last of a row or column are means of what there is."""
    if times == 1:
        return image
    total = image.astype(np.float32)
    for axis in (0, 1):
        starts = np.arange(0, image.shape[axis], times)
        shape = (-1, 1, 1) if axis == 0 else (1, -1, 1)
        count = np.diff(np.append(starts, image.shape[axis])).reshape(shape)
        total = np.asarray(np.add.reduceat(total, starts, axis=axis) / count, np.float32)
    return total
