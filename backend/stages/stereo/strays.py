"""Measured points that lie in no surface with their neighbours, left out where they are many."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float64

from ...maths.neighbours import trusts
from ...scene import Decision, SurfacePoints

MOST_STRAYS = 1 / 3
"""Share of the points; fewer are outweighed by those that agree. Measured: 0.001 to 0.1 of
the points of photographs, a half where as many again lie anywhere."""
_ASKED = 5000
"""Points drawn to see whether strays are many: asking all of them takes seconds."""
_TRUSTED = 0.5


def without_strays(points: SurfacePoints) -> SurfacePoints:
    """The points without strays if those are more than `MOST_STRAYS`, with a decision; else as they are.

    A point weighs by how sure its own photographs are; nothing else asks whether its neighbours agree.
    """
    positions = points.positions.astype(np.float64)
    if not len(positions):
        return points
    asked = positions[np.linspace(0, len(positions) - 1, min(_ASKED, len(positions))).astype(int)]
    if strays(asked).mean() <= MOST_STRAYS:
        return points
    stray = strays(positions)
    if stray.mean() <= MOST_STRAYS or stray.all():
        return points
    decision = Decision(
        what="stray points",
        choice=f"{int(stray.sum())} of {len(stray)} left out",
        because=f"{stray.mean():.0%} of the measured points lie in no surface with those around them: "
        "check the cameras and that the subject did not move",
    )
    return replace(points.chosen(~stray), decisions=(*points.decisions, decision))


def strays(positions: Float64[np.ndarray, "points 3"]) -> Bool[np.ndarray, "points"]:
    """True for those that are neither in a crowd nor in a sheet."""
    return np.asarray(trusts(positions) < _TRUSTED)
