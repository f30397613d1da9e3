"""Whether the measured surface says that cameras are wrong: for a person, since nothing is mended by it.

Given cameras are taken at their word, and a photograph whose camera is far off agrees with no other.
"""

from collections.abc import Sequence

import numpy as np

from ...maths.outline_fit import outlines_miss_px
from ...maths.posed_views import posed_views
from ...maths.silhouette import silhouettes_or_none
from ...scene import SolvedCameras, StereoResult, View
from ...wire.photographs import first_names

_HARDLY_ANY = 0.02
"""Of the points that the photograph with the most has."""
_MISFIT_WIDTHS, _LEAST_MISFIT_PX = 5e-4, 0.1
"""Of the longer side of a picture: with calibrated cameras patches lie 0.4e-4 to 2e-4 of it beside their
epipolar lines; with a camera moved by 10 degrees, or focal lengths ten times too long, 8e-4 and more."""

_MISS_WIDTHS = 1.5e-3
"""Of the longer side: outlines of rendered masks miss each other by less than 1e-4 with true cameras, by 4e-4
where masks are off by a pixel of 800, by 3.4e-3 with cameras that are 9 degrees off."""


def disagreement(solved: SolvedCameras, stereo: StereoResult) -> tuple[str, ...]:
    """What to tell of photographs that agree with no other, and of given cameras that do not fit."""
    alone = agreeing_with_none(solved, stereo)
    texts = [_alone_text(alone)] if alone else []
    beside_px = stereo.beside_lines_px
    longest_px = max(max(view.camera.width, view.camera.height) for view in solved.views)
    misfit_px = max(_MISFIT_WIDTHS * longest_px, _LEAST_MISFIT_PX)
    if not solved.estimated and beside_px is not None and beside_px >= misfit_px:
        texts.append(
            "The cameras that were given do not fit the photographs: patches of surface lie "
            f"{beside_px:.2g} px beside where these cameras see them, and the shape is wrong by it. "
            "Check positions, directions and focal lengths in the cameras file, or let FewView find them; "
            "a subject that was moved between photographs, but not its surroundings, looks the same."
        )
    exact = not solved.estimated and not solved.masks_cut_out
    miss_px = outlines_of_masks_miss_px(solved.views) if exact else None
    if miss_px is not None and miss_px >= _MISS_WIDTHS * longest_px:
        texts.append(
            f"With the cameras that were given the outlines of the masks miss each other by {miss_px:.2g} "
            "px: cameras or masks are wrong, and the shape with them. Check that the masks show the same "
            "thing in all photographs, and all of it; check the cameras file, or let FewView find them."
        )
    return tuple(texts)


def outlines_of_masks_miss_px(views: Sequence[View]) -> float | None:
    """How far outlines of one subject miss each other; None unless three masks and all show it whole."""
    silhouettes = silhouettes_or_none(view.mask for view in views)
    if silhouettes is None:
        return None
    return outlines_miss_px(posed_views([view.camera for view in views]), silhouettes)


def agreeing_with_none(solved: SolvedCameras, stereo: StereoResult) -> list[str]:
    """Names of photographs that measured hardly a point while others did."""
    counts = np.bincount(stereo.points.view_index, minlength=len(solved.views))
    pairs = zip(solved.views, counts, strict=True)
    return [view.name for view, count in pairs if count < _HARDLY_ANY * counts.max()]


def _alone_text(names: Sequence[str]) -> str:
    return (
        f"Hardly anything that {first_names(names)} shows is found at the same place by another photograph: "
        "its camera is wrong, it is blurred, something moved, or no other shows that side. "
        "Leave it out, or take photographs between it and the others."
    )
