"""Whether given cameras are of upright photographs or of the pixels as their files store them.

Of photographs that were taken upside down no shape tells: programs that find cameras may have turned them.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from ...errors import ReconstructionError
from ...scene import Decision, Photo
from .known_cameras import may_be_unturned, read_placement
from .lenses import Placement

PRECISE_PX = 0.5
"""Of points that count. To 2 px, where all photographs of an arc are upside down, 70 % of the right ones have
a place too: seen so, a thing that bulges is a hollow."""
_CLEARLY_MORE, _FEWEST_POINTS = 3, 30


def read_placement_that_fits(
    photos: Sequence[Photo],
    given: Path,
    visibility: Callable[[Placement], Bool[np.ndarray, "points placed"]],
) -> Placement:
    """The cameras as `read_placement` reads them, or as of stored pixels where that clearly fits better.

    visibility: of points that photographs share and that have a place in the world with these cameras.
    """
    upright = read_placement(photos, given)
    if not may_be_unturned(given) or all(photo.exif_orientation == 1 for photo in photos):
        return upright
    try:
        stored = read_placement(photos, given, as_stored=True)
    except ReconstructionError:  # they are mirrored: no camera took that
        return upright
    pairs = zip(upright.placed, stored.placed, strict=True)
    differs = np.array([not np.array_equal(a.camera_from_world, b.camera_from_world) for a, b in pairs])
    if not differs.any():
        return upright
    rivals = [
        (int(visibility(placement)[:, differs].any(axis=1).sum()), choice, placement)
        for choice, placement in (
            ("of upright photographs", upright),
            ("of pixels as they are stored", stored),
        )
    ]
    (fewer, _, _), (most, choice, fitting) = sorted(rivals, key=lambda rival: rival[0])
    if most < max(_FEWEST_POINTS, _CLEARLY_MORE * fewer):
        return upright
    because = f"so {most} points that photographs share have a place, and else {fewer}"
    decision = Decision(what="which way up the cameras are", choice=choice, because=because)
    return replace(fitting, way_up_told=True, decisions=(*fitting.decisions, decision))
