"""Places nearest to lines, and where lines pass nearest to each other."""

import numpy as np
from jaxtyping import Float64, Int64


def nearest_to_lines(
    origins: Float64[np.ndarray, "lines 3"],
    directions: Float64[np.ndarray, "lines 3"],
    of: Int64[np.ndarray, "lines"] | None = None,
) -> Float64[np.ndarray, "places 3"]:
    """The places with the least squared distance to their lines, of unit directions.

    `of` numbers each line's place from 0 on; without it there is one. Where all lines of a place are
    parallel, it is the one nearest to the world's origin.
    """
    of = np.zeros(len(origins), np.int64) if of is None else of
    num_places = int(of.max(initial=-1)) + 1
    across = np.eye(3) - directions[:, :, None] * directions[:, None]
    left, right = np.zeros((num_places, 3, 3)), np.zeros((num_places, 3))
    np.add.at(left, of, across)
    np.add.at(right, of, np.einsum("kab,kb->ka", across, origins))
    return np.asarray(np.einsum("pab,pb->pa", np.linalg.pinv(left, rcond=1e-9, hermitian=True), right))


def nearest_along(
    apart: Float64[np.ndarray, "*lines 3"],
    directions: Float64[np.ndarray, "lines 3"],
    others: Float64[np.ndarray, "lines 3"],
) -> Float64[np.ndarray, "lines"]:
    """How far along its direction, in lengths of that, each line passes nearest to another; 0 if parallel.

    `apart` leads from the line's origin to the other's. By cross products, because 1 - cosine^2 has no digits
    left where lines are nearly parallel.
    """
    across = np.cross(directions, others)
    sine2 = (across**2).sum(axis=1)
    along = (np.cross(apart, others) * across).sum(axis=1) * (1 / np.where(sine2 > 0, sine2, 1.0))
    return np.asarray(along)
