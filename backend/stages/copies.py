"""Photographs that are copies of others.

A copy shows nothing new, and would pass for one more photograph that confirms what the others say.
"""

from collections.abc import Sequence

import numpy as np

from ..scene import Photo

_STEP = 16
"""Rows and columns between the pixels that are compared first: different photographs differ there."""


def originals_of_copies(photos: Sequence[Photo]) -> dict[int, int]:
    """By the index of each photograph with the same pixels as an earlier one, the index of the first such.

    Evenly coloured ones are no copies: they show nothing at all.
    """
    found: dict[int, int] = {}
    for index, photo in enumerate(photos):
        firsts = (first for first in range(index) if first not in found)
        first = next((first for first in firsts if _is_same(photos[first], photo)), None)
        if first is not None:
            found[index] = first
    return found


def _is_same(one: Photo, other: Photo) -> bool:
    a, b = one.image_srgb, other.image_srgb
    if a.shape != b.shape or not np.array_equal(a[::_STEP, ::_STEP], b[::_STEP, ::_STEP]):
        return False
    return np.array_equal(a, b) and bool(a.min() < a.max())
