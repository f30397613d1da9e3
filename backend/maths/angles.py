"""Angles that keep their digits where directions are nearly the same, or nearly opposite."""

import numpy as np
from jaxtyping import Float64


def angles_between(
    a: Float64[np.ndarray, "*#batch 3"], b: Float64[np.ndarray, "*#batch 3"]
) -> Float64[np.ndarray, "*#batch"]:
    """Angles between unit vectors, radians: 2 atan2(|a - b|, |a + b|).

    Kahan, "How futile are mindless assessments of roundoff in floating-point computation?" (2006), 12. The
    arc cosine of a scalar product knows no angle below 1e-8.
    """
    apart, together = np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)
    return np.asarray(2 * np.arctan2(apart, together), np.float64)


def widest_angle_deg(directions: Float64[np.ndarray, "rays 3"]) -> float:
    """The widest angle between any two unit directions."""
    return float(np.degrees(angles_between(directions[:, None], directions[None]).max()))


def triangulation_angle_deg(
    position: Float64[np.ndarray, "3"], centres: Float64[np.ndarray, "cameras 3"]
) -> float:
    """The widest angle at a point between the rays to the cameras' centres."""
    rays = centres - position
    return widest_angle_deg(rays / np.linalg.norm(rays, axis=1, keepdims=True))
