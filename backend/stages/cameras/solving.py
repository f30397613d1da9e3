"""Second stage: where each photograph was taken, and the photographs without their lens distortion."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from ...errors import ErrorCode, ReconstructionError
from ...scene import Photo, Progress, SolvedCameras, Unplaced
from .copies import originals_of_copies, originals_of_placed_copies
from .lenses import Placement, photo_lens, undistorted_view
from .structure_from_motion import estimate_placement
from .triangulation import triangulate
from .which_way_up import PRECISE_PX, read_placement_that_fits


@dataclass(frozen=True, kw_only=True)
class CamerasConfig:
    """How much of the photographs is looked at to place the cameras."""

    sfm_max_side_px: int = 1600
    """Features are found on photographs scaled down until their longer side is this."""
    max_features: int = 8192
    """Per photograph; fewer where there are many photographs."""


def solve_cameras(
    photos: Sequence[Photo],
    given: Path | None,
    config: CamerasConfig,
    *,
    workdir: Path,
    seed: int,
    progress: Progress,
) -> SolvedCameras:
    """Cameras read from `given` or, without it, found from the photographs, and the undistorted views.

    `given` is a nerfstudio transforms.json, a COLMAP model, or a folder with one of them. Cameras that
    FewView's own cameras.json says were estimated are so again, with the points of the sparse.ply beside it.
    Copies of others are left out, where cameras are given those that stand where the other does.
    Files are written to workdir alone. The same seed gives the same cameras to the bit.
    Raises ReconstructionError: CAMERAS_UNUSABLE, NO_OVERLAP, NO_PARALLAX, TOO_FEW_PHOTOS, TOO_FEW_PLACED.
    """

    def visibility_with(placement: Placement) -> Bool[np.ndarray, "points placed"]:
        views = tuple(undistorted_view(photos[placed.index], placed) for placed in placement.placed)
        _, visibility = triangulate(
            views, workdir=workdir, seed=seed, progress=progress, largest_error_px=PRECISE_PX
        )
        return visibility

    photos, copies = _without_copies(photos) if given is None else (photos, ())
    if given is not None:
        placement = read_placement_that_fits(photos, given, visibility_with)
        placement = _without_placed_copies(photos, placement)
    else:
        placement = estimate_placement(
            photos,
            max_side_px=config.sfm_max_side_px,
            max_features=config.max_features,
            workdir=workdir,
            seed=seed,
            progress=lambda share, text: progress(0.9 * share, text),
        )
    if len(placement.placed) < 2:
        text = f"Only {len(placement.placed)} of {len(photos)} photographs has a camera."
        remedy = "Give cameras for at least two of the photographs, by file name."
        raise ReconstructionError(ErrorCode.TOO_FEW_PLACED, text, remedy)
    views = []
    for number, placed in enumerate(placement.placed):
        progress(0.9 + 0.1 * number / len(placement.placed), "Removing lens distortion")
        views.append(undistorted_view(photos[placed.index], placed))
    positions, visibility = placement.sparse_positions, placement.sparse_visibility
    if not len(positions) and all(view.mask is None for view in views):
        positions, visibility = triangulate(tuple(views), workdir=workdir, seed=seed, progress=progress)
    return SolvedCameras(
        views=tuple(views),
        lenses=tuple(photo_lens(photos[placed.index], placed) for placed in placement.placed),
        unplaced=(*placement.unplaced, *copies),
        estimated=placement.estimated,
        sparse_positions=positions,
        sparse_visibility=visibility,
        reprojection_error_px=placement.reprojection_error_px,
        evidence=placement.evidence,
        suit_outlines=placement.suit_outlines,
        way_up_told=placement.way_up_told,
        decisions=placement.decisions,
    )


def _without_copies(photos: Sequence[Photo]) -> tuple[Sequence[Photo], tuple[Unplaced, ...]]:
    """The photographs but for copies of others, and these."""
    first_of = originals_of_copies(photos)
    kept = [photo for index, photo in enumerate(photos) if index not in first_of]
    return kept, _left_out(photos, first_of)


def _without_placed_copies(photos: Sequence[Photo], placement: Placement) -> Placement:
    """The placement but for copies of photographs that stand in the same place."""
    placed = placement.placed
    ours = [photos[one.index] for one in placed]
    first_of = originals_of_placed_copies(ours, placed)
    kept = [number for number in range(len(placed)) if number not in first_of]
    visibility = placement.sparse_visibility[:, kept]
    shared = visibility.sum(axis=1) >= 2
    return replace(
        placement,
        placed=tuple(placed[number] for number in kept),
        sparse_positions=placement.sparse_positions[shared],
        sparse_visibility=visibility[shared],
        unplaced=(*placement.unplaced, *_left_out(ours, first_of)),
    )


def _left_out(photos: Sequence[Photo], first_of: Mapping[int, int]) -> tuple[Unplaced, ...]:
    """The copies, each with what it is a copy of.

    Raises ReconstructionError(TOO_FEW_PHOTOS) where all are copies of one.
    """
    if len(photos) - len(first_of) == 1 < len(photos):
        text = f"All {len(photos)} photographs are copies of one."
        remedy = "Take at least two, or better three or more, from different places."
        raise ReconstructionError(ErrorCode.TOO_FEW_PHOTOS, text, remedy)
    return tuple(
        Unplaced(name=photos[copy].name, why=f"it is a copy of {photos[first].name}")
        for copy, first in first_of.items()
    )
