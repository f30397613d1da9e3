"""A picture read between its pixels, compiled for the CPU: all channels of a place at once."""

import numpy as np
from numpy.typing import NDArray

from .compiled import Doubles, Floats, compiled


@compiled
def read_bilinear(image: Floats | Doubles | NDArray[np.uint8], pixels: Doubles, values: Doubles) -> None:
    """Write the `values` (places, channels) of an image (height, width, channels) at pixels (x, y).

    Beyond the border, and where a place is not a number, the nearest or first pixel counts.
    """
    height, width, channels = image.shape
    for place in range(len(pixels)):
        x, y = pixels[place, 0] - 0.5, pixels[place, 1] - 0.5
        x = min(x, width - 1.0) if x > 0 else 0.0  # false where x is not a number
        y = min(y, height - 1.0) if y > 0 else 0.0
        left, top = int(x), int(y)
        right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
        to_right, down = x - left, y - top
        for channel in range(channels):
            above = (1 - to_right) * image[top, left, channel] + to_right * image[top, right, channel]
            below = (1 - to_right) * image[bottom, left, channel] + to_right * image[bottom, right, channel]
            values[place, channel] = (1 - down) * above + down * below


def error_of_a_slope() -> float:
    """How far a place between four pixels is read from what a slope has there."""
    image = (np.arange(4)[:, None] + 2.0 * np.arange(5)).astype(np.float32)[..., None]
    values = np.empty((2, 1))
    read_bilinear(image, np.array([[2.75, 1.25], [-1.0, 9.0]]), values)
    return float(np.abs(values[:, 0] - [5.25, 3.0]).max())
