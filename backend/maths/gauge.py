"""Uncertainty of cameras that nothing ties to the world: covariances without an arbitrary choice of frame.

Photographs alone tell cameras up to a shift, a turn and a scale of the whole. An adjustment must fix these
seven numbers somehow (the gauge), and how sure a camera looks depends on how: one that is held still is
perfectly sure. Here the whole is taken as the frame: of all gauges the one with the smallest sum of
variances, a turn of one radian counted as much as a shift by `length_world`.

A camera's six coordinates are the rotation vector of its orientation (world axes, radians), then the shift
of its centre (world units). Baarda, "S-transformations and criterion matrices" (1973); Triggs, McLauchlan,
Hartley and Fitzgibbon, "Bundle adjustment: a modern synthesis" (1999), 9.
"""

import numpy as np
from jaxtyping import Float64


def cross_matrix(vectors: Float64[np.ndarray, "*batch 3"]) -> Float64[np.ndarray, "*batch 3 3"]:
    """[a] of each, so that [a] b is the cross product of a and b."""
    half = np.zeros((*vectors.shape, 3))
    half[..., 1, 0], half[..., 2, 1], half[..., 0, 2] = vectors[..., 2], vectors[..., 0], vectors[..., 1]
    return np.asarray(half - np.swapaxes(half, -1, -2))


def similarity_motions(positions: Float64[np.ndarray, "cameras 3"]) -> Float64[np.ndarray, "coordinates 7"]:
    """How cameras move, to first order, as the world is shifted (3), turned about 0 (3) and scaled (1)."""
    motions = np.zeros((len(positions), 6, 7))
    motions[:, :3, 3:6] = motions[:, 3:, :3] = np.eye(3)
    motions[:, 3:, 3:6] = [-cross_matrix(position) for position in positions]
    motions[:, 3:, 6] = positions
    return motions.reshape(-1, 7)


def in_gauge_of_the_whole(
    covariance: Float64[np.ndarray, "coordinates coordinates"],
    positions: Float64[np.ndarray, "cameras 3"],
    length_world: float,
) -> Float64[np.ndarray, "coordinates coordinates"]:
    """The joint covariance of all cameras, known in any gauge, in that of the cameras as a whole.

    It is projected off the motions of the whole, in coordinates without units, where the projection is an
    orthogonal one. `positions` are at least two different centres.
    """
    units = np.tile(np.repeat([1.0, length_world], 3), len(positions))
    motions, _ = np.linalg.qr(similarity_motions(positions / length_world))
    across = np.eye(len(units)) - motions @ motions.T
    free = across @ (covariance / np.outer(units, units)) @ across * np.outer(units, units)
    return np.asarray((free + free.T) / 2, np.float64)
