"""Measured surface that hangs in the air, left out: where all is shown, what nothing carries is not there.

Photographs without masks show the room behind the subject. Pixels that show it have no depth in the region,
and where no other photograph shows the same part of the room, some agree by chance: with twelve photographs
all around a table 0.3 % of the points were of a few lumps above it.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from scipy.ndimage import binary_dilation, generate_binary_structure, label

from ...maths.geometry import pinhole_in_object, seen_places
from ...scene import Decision, DepthMap, Region, StereoResult, View

_CELLS = 40
"""Along each axis of the cube around the region; what lies farther than two of them apart is not joined."""
_LEAST_SHARE = 0.003
"""Of the largest piece's confidence, in all. Lumps had up to 0.0004; a patch of print on a plain cup that
stands on a table has more."""


def without_hanging(stereo: StereoResult, views: tuple[View, ...], region: Region) -> StereoResult:
    """Without small pieces that are joined to nothing, with a decision; as it is where there are none.

    With masks it stays: they say what is subject. The views' cameras are those of the depth maps.
    """
    points = stereo.points
    if any(view.mask is not None for view in views) or not len(points.positions):
        return stereo
    occupied = np.zeros((_CELLS,) * 3, np.bool_)
    cells = _cells(points.positions)
    occupied[tuple(cells.T)] = True
    around = generate_binary_structure(3, 3)
    piece, _ = label(occupied, around)
    weight = np.bincount(piece[tuple(cells.T)], weights=points.confidence)
    hangs = (weight < _LEAST_SHARE * weight.max())[piece] & occupied
    hanging = hangs[tuple(cells.T)]
    if not hanging.any():
        return stereo
    decision = Decision(
        what="surface in the air",
        choice="left out",
        because=f"{int(hanging.sum())} of {len(hanging)} measured points are joined to nothing else",
    )
    # depth maps may hold more of a piece than points, and no other piece is in a cell beside it
    hangs = binary_dilation(hangs, around)
    maps = zip(stereo.depth_maps, views, strict=True)
    return replace(
        stereo,
        points=points.chosen(~hanging),
        depth_maps=tuple(_without(map_, view, region, hangs) for map_, view in maps),
        decisions=(*stereo.decisions, decision),
    )


def _cells(positions: Float[np.ndarray, "*batch 3"]) -> Int64[np.ndarray, "*batch 3"]:
    """Of the cube around the region, in which points of the object frame lie."""
    return np.clip((positions + 1) * (_CELLS / 2), 0, _CELLS - 1).astype(np.int64)


def _without(
    map_: DepthMap, view: View, region: Region, hangs: Bool[np.ndarray, "cells cells cells"]
) -> DepthMap:
    camera = pinhole_in_object(view.camera, region, torch.device("cpu"))
    places = seen_places(camera, torch.from_numpy(map_.depth)).numpy()
    return map_.measured_where(~hangs[tuple(np.moveaxis(_cells(places), -1, 0))])
