"""Which points a photograph shows on its mask, and which beside it."""

import numpy as np
from jaxtyping import Bool, Float64
from scipy.ndimage import distance_transform_edt

from ..scene import View
from .projection import projected, shown

_OUTLINE_SHARE, _OUTLINE_PX = 0.004, 1.5
"""Of the photograph's longer side, or pixels where that is less: this near to a mask a point may lie on the
outline."""


def on_and_beside_mask(
    view: View, points: Float64[np.ndarray, "points 3"]
) -> tuple[Bool[np.ndarray, "points"], Bool[np.ndarray, "points"]]:
    """Points (world frame) that the view shows on its mask or its outline, and those clear of it."""
    assert view.mask is not None
    pixels, depth = projected(points, view.camera)
    visible = shown(pixels, depth, view.camera)
    column, row = pixels[visible].astype(int).T
    distance_px = np.full(len(points), np.nan)
    distance_px[visible] = distance_transform_edt(view.mask <= 0.5)[row, column]
    outline_px = max(_OUTLINE_SHARE * max(view.mask.shape), _OUTLINE_PX)
    return distance_px <= outline_px, distance_px > outline_px
