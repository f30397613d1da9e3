"""How a mesh is laid out in a picture: which faces lie side by side, and where each chart goes.

A chart is a connected part of the surface that is drawn in one piece. All lengths are pixels of the picture,
(x, y) with y downwards, (0, 0) the outer corner of the top left pixel.
"""

import math

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64
from scipy.sparse import coo_array

from .raycast import RayCaster, RayHits

_ROOM = 1.1
"""Area of the picture for the charts' boxes; what they need beyond its width makes it higher."""
_STRIP_PX = 2**20
"""Pixels that are looked up at a time."""


def side_by_side(faces: Int64[np.ndarray, "faces 3"]) -> Int64[np.ndarray, "2 pairs"]:
    """Pairs of faces that share an edge; where more than two do, the neighbours in their order."""
    ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    same = (ends[order[1:]] == ends[order[:-1]]).all(axis=1)
    owner = order // 3
    return np.stack([owner[:-1][same], owner[1:][same]])


def spread(
    values: Float64[np.ndarray, "faces channels"], pairs: Int64[np.ndarray, "2 pairs"], rounds: int
) -> Float64[np.ndarray, "faces channels"]:
    """Values of faces, so many times the mean of a face and its neighbours."""
    count = len(values)
    both = np.concatenate([pairs, pairs[::-1]], axis=1)
    beside = coo_array((np.ones(both.shape[1]), both), shape=(count, count)).tocsr()
    number = 1.0 + np.bincount(both[0], minlength=count)[:, None]
    for _ in range(rounds):
        values = (values + beside @ values) / number
    return values


def packed(
    sizes: Int64[np.ndarray, "charts 2"],
) -> tuple[Int64[np.ndarray, "charts 2"], tuple[int, int]]:
    """Top left corners of boxes of these (width, height) that do not overlap, and (width, height) around all.

    On shelves: the highest first, side by side until the picture is as wide as it is high.
    """
    width = max(int(sizes[:, 0].max()), math.ceil(math.sqrt(_ROOM * int(sizes.prod(axis=1).sum()))))
    corners = np.zeros_like(sizes)
    x = y = shelf = 0
    for chart in np.argsort(-sizes[:, 1], kind="stable"):
        if x + sizes[chart, 0] > width:
            x, y = 0, y + shelf
        if x == 0:
            shelf = int(sizes[chart, 1])
        corners[chart] = x, y
        x += int(sizes[chart, 0])
    return corners, (width, y + shelf)


def faces_at(
    corners_px: Float[np.ndarray, "faces 3 2"], width: int, height: int
) -> tuple[Bool[np.ndarray, "height width"], RayHits]:
    """Which pixels' centres lie in a face, and in which, where: the hits of these, row by row.

    Where faces overlap, one of them.
    """
    flat = np.zeros((corners_px.size // 2, 3))
    flat[:, :2] = corners_px.reshape(-1, 2)
    caster = RayCaster(flat, np.arange(len(flat)).reshape(-1, 3))
    covered, strips = np.zeros((height, width), bool), []
    rows = max(1, _STRIP_PX // width)
    for top in range(0, height, rows):
        y, x = np.mgrid[top : min(top + rows, height), :width] + 0.5
        above = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
        hits = caster.cast(above, np.broadcast_to([0.0, 0.0, -1.0], above.shape))
        covered[top : top + rows] = hits.hit.reshape(x.shape)
        strips.append((hits.face[hits.hit], hits.barycentric[hits.hit]))
    face = np.concatenate([face for face, _ in strips])
    barycentric = np.concatenate([weights for _, weights in strips])
    return covered, RayHits(distance=np.ones(len(face)), face=face, barycentric=barycentric)
