"""Whether the photographs move enough against each other, and why all or some could not be placed."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import PIL.Image  # noqa: F401 - pycolmap loaded before Pillow corrupts memory when Pillow next saves
import pycolmap
from jaxtyping import Float64

from ...errors import ErrorCode, ReconstructionError
from ...maths.angles import triangulation_angle_deg

_SMALLEST_ANGLE_DEG = 1.0
_SMALLEST_ANGLE_FLAT_DEG = 2.0
"""Under this, as the median at the sparse points, the photographs are from one spot. The second counts where
a plane or a turn would explain every pair: a turn with the focal length unknown was seen to pass for 1.4."""

FEWEST_SHARED = 15
"""Features that two pictures must share to be taken for a pair, which is pycolmap's own limit as well."""

_FLAT_KINDS = frozenset(
    int(kind)
    for kind in (
        pycolmap.TwoViewGeometryConfiguration.PLANAR,
        pycolmap.TwoViewGeometryConfiguration.PANORAMIC,
        pycolmap.TwoViewGeometryConfiguration.PLANAR_OR_PANORAMIC,
    )
)


def why_none_placed(database: Path, num_photos: int) -> ReconstructionError:
    """What the matches between pairs of photographs say about a failure."""
    kinds = _pair_kinds(database)
    if not kinds:
        text = "The photographs have nothing in common that could be recognised."
        remedy = "Take photographs that overlap by half, in steps of 10 to 20 degrees around the subject."
        return ReconstructionError(ErrorCode.NO_OVERLAP, text, remedy)
    if kinds <= _FLAT_KINDS:
        return _no_parallax()
    text = f"Fewer than 2 of {num_photos} photographs could be placed."
    remedy = "Add photographs between those there are, or give the cameras."
    return ReconstructionError(ErrorCode.TOO_FEW_PLACED, text, remedy)


def why_unplaced(database: Path, pictures: Sequence[str]) -> list[str]:
    """For each picture that the others left behind, a phrase that helps to take a better one."""
    with pycolmap.Database.open(database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        return [_why_alone(opened, ids[name], ids.values()) for name in pictures]


def _why_alone(opened: pycolmap.Database, image_id: int, all_ids: Iterable[int]) -> str:
    """What the features that a picture shares with each of the others say."""
    shared = [_num_shared(opened, image_id, other) for other in all_ids if other != image_id]
    most = max(shared, default=0)
    if opened.num_keypoints_for_image(image_id) < FEWEST_SHARED:
        return "it is too even, dark or blurred: hardly any feature was found in it"
    if most == 0:
        return "it shares no features with the others that could be recognised"
    if most < FEWEST_SHARED:
        return f"it shares too few features with the others: {most} at best, {FEWEST_SHARED} are needed"
    return (
        f"it shares features with the others, {most} at best, "
        "but too few with those that could be placed, or they do not agree on where it was taken"
    )


def _num_shared(opened: pycolmap.Database, one: int, other: int) -> int:
    """Features of two pictures that match and fit together."""
    if not opened.exists_two_view_geometry(one, other):
        return 0
    return len(opened.read_two_view_geometry(one, other).inlier_matches)


def _pair_kinds(database: Path) -> set[int]:
    """How the pairs of photographs that match are related."""
    kinds = pycolmap.TwoViewGeometryConfiguration
    with pycolmap.Database.open(database) as opened:
        _, geometries = opened.read_two_view_geometries()
    return {int(geometry.config) for geometry in geometries} - {int(kinds.UNDEFINED), int(kinds.DEGENERATE)}


def _no_parallax() -> ReconstructionError:
    text = "The photographs seem to be taken from one spot: nothing moves against its background."
    remedy = "Walk around the subject; a step aside between photographs, not a turn."
    return ReconstructionError(ErrorCode.NO_PARALLAX, text, remedy)


def require_parallax(model: pycolmap.Reconstruction, database: Path) -> None:
    """Raise NO_PARALLAX where the model is what noise and a wrong focal length make of a turning camera."""
    flat = _pair_kinds(database) <= _FLAT_KINDS
    smallest_deg = _SMALLEST_ANGLE_FLAT_DEG if flat else _SMALLEST_ANGLE_DEG
    angles_deg = widest_angles_deg(model)
    if len(angles_deg) == 0 or float(np.median(angles_deg)) < smallest_deg:
        raise _no_parallax()


def widest_angles_deg(model: pycolmap.Reconstruction) -> Float64[np.ndarray, "points"]:
    """For each point, the widest angle between the rays to it."""
    centres = {i: model.images[i].projection_center() for i in model.reg_image_ids()}
    angles = (
        triangulation_angle_deg(
            point.xyz, np.stack([centres[seen.image_id] for seen in point.track.elements])
        )
        for point in model.points3D.values()
    )
    return np.fromiter(angles, np.float64)
