"""What a mask tells of the outline of its subject."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.ndimage import distance_transform_edt
from scipy.spatial import ConvexHull
from skimage.measure import find_contours

from .pieces import along_border

_FEWEST = 3
"""Outlines of two photographs hardly say anything of each other."""
_RAYS = 60
"""Through each outline."""
_SHORTEST_PX = 30
"""Of a piece of outline: less is a speck."""
_EDGE_PX = 1.2
"""From the outline, where a soft mask tells it finer than by pixels."""


@dataclass(frozen=True, kw_only=True)
class Silhouette:
    """Of the subject in one photograph, which shows it whole."""

    outline_px: Float64[np.ndarray, "outline 2"]
    """Places along it."""
    hull_px: Float64[np.ndarray, "corners 2"]
    """Corners of its convex hull."""
    off_px: Float64[np.ndarray, "height width"]
    """Signed distance to the outline, > 0 off the subject."""


def silhouettes_or_none(
    masks: Iterable[Float32[np.ndarray, "height width"] | None],
) -> tuple[Silhouette, ...] | None:
    """Of three masks or more that all show their subject whole; else None."""
    found = [silhouette_or_none(mask) for mask in masks]
    silhouettes = tuple(silhouette for silhouette in found if silhouette is not None)
    return silhouettes if len(silhouettes) >= max(len(found), _FEWEST) else None


def silhouette_or_none(mask: Float32[np.ndarray, "height width"] | None) -> Silhouette | None:
    """Of a mask that shows the subject whole, clear of the picture's border; else None."""
    if mask is None:
        return None
    on = mask > 0.5
    contours = find_contours(mask, 0.5)  # type: ignore[no-untyped-call]
    pieces = [contour for contour in contours if len(contour) > _SHORTEST_PX]
    if along_border(on).any() or not pieces:
        return None
    outline = np.concatenate(pieces)[:, ::-1] + 0.5
    off = outline_distance_px(on)
    soft = (mask > 0) & (mask < 1) & (np.abs(off) < _EDGE_PX)
    return Silhouette(
        outline_px=outline[np.linspace(0, len(outline) - 1, _RAYS).astype(np.int64)],
        hull_px=outline[ConvexHull(outline).vertices],
        off_px=np.where(soft, 0.5 - mask, off),
    )


def outline_distance_px(on: Bool[np.ndarray, "height width"]) -> Float64[np.ndarray, "height width"]:
    """Signed distance to the outline of what is set, > 0 off it; there are pixels of both kinds."""
    signed = distance_transform_edt(~on) - distance_transform_edt(on)
    # the transform counts from pixel centre to pixel centre; the outline lies half a pixel between them
    return np.asarray(signed - 0.5 * np.sign(signed))
