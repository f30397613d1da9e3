"""Which points a photograph shows on its mask, and which beside it."""

import numpy as np
from jaxtyping import Bool, Float64
from scipy.ndimage import distance_transform_edt

from ..scene import Camera, Mask
from .projection import projected, shown

FEWEST_MASKS = 2
"""That must show a place on the subject: one has a whole cone on it."""
_OUTLINE_SHARE, _OUTLINE_PX = 0.004, 1.5
"""Of the photograph's longer side, or pixels where that is less: this near to a mask a point may lie on the
outline."""


def from_mask_px(mask: Mask) -> Float64[np.ndarray, "height width"]:
    """Distance of each pixel from the nearest one on the mask; 0 on it."""
    return np.asarray(distance_transform_edt(mask <= 0.5))


def on_and_beside_mask(
    camera: Camera, distance_px: Float64[np.ndarray, "height width"], points: Float64[np.ndarray, "points 3"]
) -> tuple[Bool[np.ndarray, "points"], Bool[np.ndarray, "points"]]:
    """Points (world frame) that the camera shows on its mask or the outline of that, and those clear of it.

    `distance_px` is `from_mask_px` of the mask.
    """
    pixels, depth = projected(points, camera)
    visible = shown(pixels, depth, camera)
    column, row = pixels[visible].astype(int).T
    of_points_px = np.full(len(points), np.nan)
    of_points_px[visible] = distance_px[row, column]
    outline_px = max(_OUTLINE_SHARE * max(distance_px.shape), _OUTLINE_PX)
    return of_points_px <= outline_px, of_points_px > outline_px
