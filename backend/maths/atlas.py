"""How a mesh is laid out in a picture: which faces lie side by side, and where each chart goes.

A chart is a connected part of the surface that is drawn in one piece. All lengths are pixels of the picture,
(x, y) with y downwards, (0, 0) the outer corner of the top left pixel.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int32, Int64
from scipy.sparse import coo_array

from ..kernels.face_drawing import draw_faces
from ..kernels.side_by_side import side_by_side

_ROOM = 1.1
"""Area of the picture for the charts' boxes; what they need beyond its width makes it higher."""


@dataclass(frozen=True, kw_only=True)
class Texels:
    """The pixels of a picture that belong to a mesh, row by row."""

    covered: Bool[np.ndarray, "height width"]
    face: Int32[np.ndarray, "texels"]
    weights: Float32[np.ndarray, "texels 2"]
    """Of the face's first two corners at the pixel's centre; what is left of 1 is the third's."""

    def barycentric(
        self, which: Bool[np.ndarray, "texels"] | Int64[np.ndarray, "some"] | slice = slice(None)
    ) -> Float64[np.ndarray, "some 3"]:
        """Weights of all three corners of some texels, summing to 1."""
        first, second = self.weights[which].T.astype(np.float64)
        return np.stack([first, second, np.clip(1 - first - second, 0, 1)], axis=1)


def neighbours(faces: Int64[np.ndarray, "faces 3"]) -> Int64[np.ndarray, "2 pairs"]:
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


def faces_at(corners_px: Float[np.ndarray, "faces 3 2"], width: int, height: int) -> Texels:
    """Which pixels' centres lie in a face, and in which; where faces overlap, in one of them."""
    corners = np.ascontiguousarray(corners_px, np.float64)
    face, weights = np.full((height, width), -1, np.int32), np.zeros((height, width, 2), np.float32)
    threads = torch.get_num_threads()
    ends = np.linspace(0, height, threads + 1).astype(int).tolist()
    side_by_side(lambda rows: draw_faces(rows, corners, face, weights), list(pairwise(ends)), threads)
    covered = face >= 0
    return Texels(covered=covered, face=face[covered], weights=weights[covered])
