"""Colours of a picture between its pixels, and over several of them."""

import numpy as np
from jaxtyping import Float, Float64, Shaped

from ..kernels.bilinear_reading import read_bilinear


def bilinear(
    image: Shaped[np.ndarray, "height width channels"], pixels: Float[np.ndarray, "*places 2"]
) -> Float64[np.ndarray, "*places channels"]:
    """Values at places (x, y), in pixels; beyond the border the nearest pixel counts."""
    values = np.empty((*pixels.shape[:-1], image.shape[-1]))
    flat = np.ascontiguousarray(pixels.reshape(-1, 2), np.float64)
    read_bilinear(np.ascontiguousarray(image), flat, values.reshape(-1, image.shape[-1]))
    return values


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
