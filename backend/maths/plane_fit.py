"""The plane that most of some points lie on, whatever the others do."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64

_TRIALS = 300
"""Planes through three points. Where 60 % of all lie on one plane, a fifth of the trials are of these."""
_TRIALS_UNDER = 20_000
"""Where 6 % of all lie on one plane, four of the trials are of these."""
_AT_A_TIME = 1000
"""Planes that are held against all points."""
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
    normals, offsets = _planes_through_three(points, tolerance, _TRIALS)
    if not len(normals):
        return None
    near = np.abs(points @ normals.T - offsets) < tolerance
    return _refined(points, near[:, near.sum(axis=0).argmax()], tolerance)


def plane_under_most(
    points: Float64[np.ndarray, "points 3"],
    eyes: Float64[np.ndarray, "eyes 3"],
    tolerance: float,
    most_below: float,
) -> Plane | None:
    """The plane that the most points lie on, of those with all `eyes` above them and few points below.

    Few are `most_below` times as many as lie on it, further off than the tolerance. Its normal points up.
    Found as by `plane_of_most`; None where no three points have such a plane.
    """
    normals, offsets = _planes_through_three(points, tolerance, _TRIALS_UNDER)
    upwards = np.sign(eyes[:1] @ normals.T - offsets)[0]
    normals, offsets = upwards[:, None] * normals, upwards * offsets
    seen = (eyes @ normals.T - offsets > tolerance).all(axis=0)
    normals, offsets = normals[seen], offsets[seen]
    num_near = np.zeros(len(normals), np.int64)
    for start in range(0, len(normals), _AT_A_TIME):
        part = slice(start, start + _AT_A_TIME)
        height = points @ normals[part].T - offsets[part]
        near = (np.abs(height) < tolerance).sum(axis=0)
        num_near[part] = np.where((height <= -tolerance).sum(axis=0) <= most_below * near, near, 0)
    if not num_near.any():
        return None
    best = num_near.argmax()
    plane = _refined(points, np.abs(points @ normals[best] - offsets[best]) < tolerance, tolerance)
    if plane.normal @ normals[best] > 0:
        return plane
    return replace(plane, normal=-plane.normal)


def _planes_through_three(
    points: Float64[np.ndarray, "points 3"], tolerance: float, trials: int
) -> tuple[Float64[np.ndarray, "planes 3"], Float64[np.ndarray, "planes"]]:
    """Unit normals, and what they give with a point of their planes; of points nearly on a line none."""
    draw = np.random.default_rng(0).integers(0, len(points), (3, trials))
    first, second, third = points[draw]
    normals = np.cross(second - first, third - first)
    lengths = np.linalg.norm(normals, axis=1)
    spans = lengths > tolerance**2
    normals = normals[spans] / lengths[spans, None]
    return normals, (normals * first[spans]).sum(axis=1)


def _refined(
    points: Float64[np.ndarray, "points 3"], within: Bool[np.ndarray, "points"], tolerance: float
) -> Plane:
    """By least squares over the points within, and over those that are then."""
    for _ in range(_REFINED):
        middle = points[within].mean(axis=0)
        normal = np.linalg.svd(points[within] - middle, full_matrices=False)[2][-1]
        plane = Plane(normal=normal, middle=middle, within=np.abs((points - middle) @ normal) < tolerance)
        within = plane.within
    return plane
