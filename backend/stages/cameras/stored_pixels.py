"""Cameras of the pixels as a file stores them, turned as EXIF turns its photograph.

COLMAP, and who builds on it, does not look at the EXIF orientation; photographs are upright here.
"""

from dataclasses import replace
from types import MappingProxyType

import numpy as np
import PIL.Image  # noqa: F401 - pycolmap loaded before Pillow corrupts memory when Pillow next saves
import pycolmap

from ...errors import ErrorCode, ReconstructionError
from ...images import same_shape
from ...scene import Photo
from .lenses import PlacedPhoto

_CLOCKWISE_QUARTERS = MappingProxyType({3: 2, 6: 1, 8: 3})
"""By the EXIF orientations that turn a photograph and do not mirror it."""

_TURNED_FROM_STORED = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""Camera axes of a picture turned clockwise by a quarter, from those before."""

_VECTORS = MappingProxyType(
    {
        "OPENCV": ((7, 6),),
        "FULL_OPENCV": ((7, 6),),
        "THIN_PRISM_FISHEYE": ((7, 6), (10, 11)),
        "RAD_TAN_THIN_PRISM_FISHEYE": ((10, 11), (12, 14), (13, 15)),
    }
)
"""Places of the parameters that are x and y of a vector in the picture; all other distortion is radial."""


def is_of_stored_pixels(photo: Photo, lens: pycolmap.Camera, *, where_both_fit: bool) -> bool:
    """Whether the lens is that of the file's own pixels, and EXIF turns these.

    Its shape tells of a photograph taken on its side; `where_both_fit` is the answer where it does not.
    """
    width, height = photo.original_width, photo.original_height
    stored = (width, height) if photo.exif_orientation < 5 else (height, width)
    if photo.exif_orientation == 1 or not same_shape(lens.width, lens.height, *stored):
        return False
    return where_both_fit or not same_shape(lens.width, lens.height, width, height)


def turned_upright(photo: Photo, placed: PlacedPhoto) -> PlacedPhoto:
    """The camera of the upright photograph, from that of its file's own pixels.

    Raises ReconstructionError(CAMERAS_UNUSABLE) where these are mirrored: no camera took them.
    """
    if photo.exif_orientation not in _CLOCKWISE_QUARTERS:
        text = (
            f"{photo.name} is stored mirrored, as its EXIF orientation says: so is the world of its camera."
        )
        remedy = "Save the photographs as they are to be seen, and compute the cameras again."
        raise ReconstructionError(ErrorCode.CAMERAS_UNUSABLE, text, remedy)
    for _ in range(_CLOCKWISE_QUARTERS[photo.exif_orientation]):
        pose = _TURNED_FROM_STORED @ placed.camera_from_world
        placed = replace(placed, lens=turned_clockwise(placed.lens), camera_from_world=pose)
    return placed


def turned_clockwise(lens: pycolmap.Camera) -> pycolmap.Camera:
    """The lens of the picture turned by a quarter: what was on the right is below."""
    params = lens.params.copy()
    focal, centre = lens.focal_length_idxs(), lens.principal_point_idxs()
    params[focal] = params[focal[::-1]]
    params[centre] = lens.height - params[centre[1]], params[centre[0]]
    for x, y in _VECTORS.get(lens.model.name, ()):
        params[[x, y]] = -params[y], params[x]
    return pycolmap.Camera(model=lens.model, width=lens.height, height=lens.width, params=params)
