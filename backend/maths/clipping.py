"""A mesh cut along a line that runs across its faces."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64, Shaped

_NEAREST = 0.02
"""Of an edge: nearer to its ends it is not cut, so that no face is a sliver."""


@dataclass(frozen=True, kw_only=True)
class Clipped:
    """The part of a mesh on one side of a line."""

    faces: Int64[np.ndarray, "faces 3"]
    """Over the vertices of the mesh, and after them those of the line."""
    ends: Int64[np.ndarray, "new 2"]
    """The edges that the vertices of the line lie on."""
    share: Float64[np.ndarray, "new"]
    """Of the second end."""

    def extended(self, values: Shaped[np.ndarray, "vertices *shape"]) -> np.ndarray:
        """Values of the vertices, and after them those of the line, between their ends'."""
        share = self.share.reshape(-1, *[1] * (values.ndim - 1))
        first, second = values[self.ends[:, 0]], values[self.ends[:, 1]]
        return np.concatenate([values, ((1 - share) * first + share * second).astype(values.dtype)])


def clipped(faces: Int64[np.ndarray, "faces 3"], beyond: Float64[np.ndarray, "vertices"]) -> Clipped:
    """Where a function of the vertices, linear on each face, is at most 0."""
    outside = beyond > 0
    number = outside[faces].sum(axis=1)
    # the vertex that is alone on its side comes first
    tip, stump = _from(faces[number == 2], ~outside), _from(faces[number == 1], outside)
    cut = np.concatenate([tip, stump])
    edges = np.sort(np.concatenate([cut[:, [0, 1]], cut[:, [0, 2]]]), axis=1)
    ends, number_of = np.unique(edges, axis=0, return_inverse=True)
    on_first, on_second = np.split(len(beyond) + number_of.reshape(-1), 2)
    kept_tips = np.stack([tip[:, 0], on_first[: len(tip)], on_second[: len(tip)]], axis=1)
    left, right = on_first[len(tip) :], on_second[len(tip) :]
    near, far = stump[:, 1], stump[:, 2]
    halves = [np.stack([left, near, far], axis=1), np.stack([left, far, right], axis=1)]
    first, second = beyond[ends].T
    share = np.clip(first / (first - second), _NEAREST, 1 - _NEAREST)
    return Clipped(faces=np.concatenate([faces[number == 0], kept_tips, *halves]), ends=ends, share=share)


def _from(
    faces: Int64[np.ndarray, "faces 3"], chosen: Shaped[np.ndarray, "vertices"]
) -> Int64[np.ndarray, "faces 3"]:
    """The same faces, each beginning with its first chosen vertex."""
    start = chosen[faces].argmax(axis=1)
    return np.take_along_axis(faces, (start[:, None] + np.arange(3)) % 3, axis=1)
