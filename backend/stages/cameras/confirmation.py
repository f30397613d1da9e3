"""Whether anything confirms estimated cameras: points that three photographs see.

Points of two photographs follow them wherever they are put, but for their epipolar lines; only a third
that sees the same point can contradict, and only from a place of its own: one more from beside the first says
what the first says.
"""

import numpy as np
from jaxtyping import Bool, Float64, Int64

from ...scene import SolvedCameras

FEWEST_CONFIRMING = 30
"""Of the photograph with the fewest. Measured (docs/benchmarks.md): with 35 and more, orientations were right
to 1.7 degrees, with 19 and fewer wrong by 1 to 60."""

_ONE_PLACE = 0.015
"""Of the distance to the points: cameras nearer to each other, as those of a burst, stand in one place. They
see a point less than a degree apart."""


def num_confirming(
    visibility: Bool[np.ndarray, "points views"], place: Int64[np.ndarray, "views"] | None = None
) -> Int64[np.ndarray, "views"]:
    """Of the points that each photograph sees: those seen from three places or more, of `places`.

    Without these each photograph counts as taken from a place of its own.
    """
    place = np.arange(visibility.shape[1]) if place is None else place
    seen_from = [visibility[:, place == number].any(axis=1) for number in np.unique(place)]
    return np.asarray(visibility[np.sum(seen_from, axis=0) >= 3].sum(axis=0), np.int64)


def places(
    centres: Float64[np.ndarray, "views 3"], positions: Float64[np.ndarray, "points 3"]
) -> Int64[np.ndarray, "views"]:
    """For each camera the first one that stands where it stands, as seen from the points' middle."""
    if not len(positions):
        return np.arange(len(centres))
    reach = _ONE_PLACE * np.linalg.norm(centres - np.median(positions, axis=0), axis=1)
    place: list[int] = []
    for index, centre in enumerate(centres):
        beside = (first for first in place if np.linalg.norm(centres[first] - centre) < reach[first])
        place.append(next(beside, index))
    return np.array(place, np.int64)


def unconfirmed(solved: SolvedCameras) -> str | None:
    """For a person: which photograph's camera hangs on too little, and what helps; None if none does.

    Cameras that were given, or estimated by an earlier job, are not judged.
    """
    if solved.evidence is None:
        return None
    centres = np.array([view.camera.position for view in solved.views])
    confirming = num_confirming(solved.sparse_visibility, places(centres, solved.sparse_positions))
    weakest = int(confirming.argmin())
    if confirming[weakest] >= FEWEST_CONFIRMING:
        return None
    few = f"of {solved.views[weakest].name} only {confirming[weakest]} points are seen by three photographs"
    enough = f"from different places ({FEWEST_CONFIRMING} confirm a camera)"
    if solved.suit_outlines:
        return (
            f"The cameras rest on the subject's outlines and may be a degree or two off: {few} {enough}. "
            "More photographs, or something with texture around the subject, would help."
        )
    masks = "" if all(view.mask is not None for view in solved.views) else ", or masks of the whole subject"
    return (
        f"The cameras may be wrong, and the shape with them: {few} {enough}. "
        "Photographs 10 to 20 degrees apart, and something with texture around the subject"
        f"{masks}, would help."
    )
