"""Whether anything confirms estimated cameras: points that three photographs see.

Points of two photographs follow them wherever they are put, but for their epipolar lines; only a third
that sees the same point can contradict.
"""

import numpy as np
from jaxtyping import Bool, Int64

from ..scene import SolvedCameras

FEWEST_CONFIRMING = 30
"""Of the photograph with the fewest. Measured (docs/benchmarks.md): with 35 and more, orientations were right
to 1.7 degrees, with 19 and fewer wrong by 1 to 60."""


def num_confirming(visibility: Bool[np.ndarray, "points views"]) -> Int64[np.ndarray, "views"]:
    """Of the points that each photograph sees: those seen by three or more."""
    return np.asarray(visibility[visibility.sum(axis=1) >= 3].sum(axis=0), np.int64)


def unconfirmed(solved: SolvedCameras) -> str | None:
    """For a person: which photograph's camera hangs on too little, and what helps; None if none does.

    Cameras that were given, or estimated by an earlier job, are not judged.
    """
    if solved.evidence is None:
        return None
    confirming = num_confirming(solved.sparse_visibility)
    weakest = int(confirming.argmin())
    if confirming[weakest] >= FEWEST_CONFIRMING:
        return None
    return (
        f"The cameras may be wrong, and the shape with them: of {solved.views[weakest].name} only "
        f"{confirming[weakest]} points are seen by three photographs ({FEWEST_CONFIRMING} confirm a camera). "
        "Photographs 10 to 20 degrees apart, and something with texture around the subject, would help."
    )
