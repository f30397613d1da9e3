"""The plane that most of some points lie on, whatever the others do."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

_TRIALS = 300
"""Planes through three points. Where 60 % of all lie on one plane, a fifth of the trials are of these."""
_REFINED = 2
"""How often the plane is fitted to the points near it."""


@dataclass(frozen=True, kw_only=True)
class Plane:
    """All x with normal . (x - middle) = 0."""

    normal: Float64[np.ndarray, "3"]
    """Of unit length and either sign."""
    middle: Float64[np.ndarray, "3"]
    """Mean of the points within the tolerance."""
    within: Bool[np.ndarray, "points"]
    """Which points those are."""

    def distance(self, points: Float64[np.ndarray, "*batch 3"]) -> Float64[np.ndarray, "*batch"]:
        """Signed, along the normal."""
        return np.asarray((points - self.middle) @ self.normal)


def plane_of_most(points: Float64[np.ndarray, "points 3"], tolerance: float) -> Plane | None:
    """The plane that the most points lie within `tolerance` of; None where all lie on a line.

    Random sample consensus (Fischler and Bolles, "Random Sample Consensus", CACM 1981), then least squares
    over the points found. The same points have the same plane: the draw is fixed.
    """
    draw = np.random.default_rng(0).integers(0, len(points), (3, _TRIALS))
    first, second, third = points[draw]
    normals = np.cross(second - first, third - first)
    lengths = np.linalg.norm(normals, axis=1)
    spans = lengths > tolerance**2
    if not spans.any():
        return None
    normals, first = normals[spans] / lengths[spans, None], first[spans]
    off = np.abs(points @ normals.T - (normals * first).sum(axis=1))
    best = (off < tolerance).sum(axis=0).argmax()
    plane = Plane(normal=normals[best], middle=first[best], within=off[:, best] < tolerance)
    for _ in range(_REFINED):
        plane = _least_squares(points, plane.within, tolerance)
    return plane


def _least_squares(
    points: Float64[np.ndarray, "points 3"], within: Bool[np.ndarray, "points"], tolerance: float
) -> Plane:
    middle = points[within].mean(axis=0)
    normal = np.linalg.svd(points[within] - middle, full_matrices=False)[2][-1]
    return Plane(normal=normal, middle=middle, within=np.abs((points - middle) @ normal) < tolerance)
