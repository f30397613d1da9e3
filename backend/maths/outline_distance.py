"""How far pixels lie from an outline."""

import numpy as np
from jaxtyping import Bool, Float64
from scipy.ndimage import distance_transform_edt


def outline_distance_px(on: Bool[np.ndarray, "height width"]) -> Float64[np.ndarray, "height width"]:
    """Signed distance to the outline of what is set, > 0 off it; there are pixels of both kinds."""
    signed = distance_transform_edt(~on) - distance_transform_edt(on)
    # the transform counts from pixel centre to pixel centre; the outline lies half a pixel between them
    return np.asarray(signed - 0.5 * np.sign(signed))
