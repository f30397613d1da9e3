"""Photographs that are copies of others.

A copy shows nothing new, and would pass for one more photograph that confirms what the others say.
"""

from collections.abc import Sequence

import numpy as np

from ...scene import Photo, View
from .lenses import PlacedPhoto

_STEP = 16
"""Rows and columns between the pixels that are compared first: different photographs differ there."""

_SAME_PLACE = 0.01
"""Of the largest distance between cameras. Pictures of a turned vase are the same from all around it."""


def originals_of_copies(photos: Sequence[Photo | View]) -> dict[int, int]:
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


def originals_of_placed_copies(photos: Sequence[Photo], placed: Sequence[PlacedPhoto]) -> dict[int, int]:
    """The same of photographs with cameras, but for those that stand apart from the first such."""
    centres = np.array([np.linalg.inv(one.camera_from_world)[:3, 3] for one in placed]).reshape(-1, 3)
    distances = np.linalg.norm(centres[:, None] - centres, axis=-1)
    near = distances <= _SAME_PLACE * distances.max(initial=0.0)
    return {copy: first for copy, first in originals_of_copies(photos).items() if near[copy, first]}


def copies_apart_text(views: Sequence[View]) -> str:
    """What to say of one picture under two names whose cameras are not the same; empty without any."""
    for copy, first in originals_of_copies(views).items():
        names = f"{views[first].name} and {views[copy].name}"
        return (
            f"{names} are the same picture, though their cameras stand apart: "
            "one of them may be the wrong file. Replace it, or leave it out."
        )
    return ""


def _is_same(one: Photo | View, other: Photo | View) -> bool:
    a, b = one.image_srgb, other.image_srgb
    if a.shape != b.shape or not np.array_equal(a[::_STEP, ::_STEP], b[::_STEP, ::_STEP]):
        return False
    return np.array_equal(a, b) and bool(a.min() < a.max())
