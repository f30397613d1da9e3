"""Whether the photographs contradict the focal lengths that EXIF tells.

Cropped photographs keep the EXIF of the whole, and those of a digital zoom may hold that of none. With such
focal lengths cameras turn wrongly until most points fit. While the principal points are held, a few hundred
points tell the focal length of every lens; with all free, several lenses slide together.
"""

import copy

import numpy as np
import PIL.Image  # noqa: F401 - pycolmap loaded before Pillow corrupts memory when Pillow next saves
import pycolmap

from .bundle_adjustment import adjust_bundle
from .confirmation import FEWEST_CONFIRMING

_MOST_POINTS = 300
"""That three photographs see: with so many the adjustment takes a hundredth of the time of the cameras."""
_ROBUST_SCALE_PX = 0.5
_CLEARLY_LESS = 2 / 3
"""Of the median error. Measured (docs/experiments.md): where EXIF is right to 5 percent, free focal lengths
leave 0.53 to 1; where it is wrong 0.1 to 0.4. So they have to differ as well."""
_LARGEST_FOCAL_RATIO = 1.1
"""Of two focal lengths that are still the same: EXIF is right to 5 percent (standard deviation)."""


def contradicted_lenses(model: pycolmap.Reconstruction) -> set[int]:
    """Ids of lenses with a focal length from EXIF that the photographs contradict; the model stays as it is.

    They do where errors are clearly less once the focal lengths are free, and one is then far from EXIF's.
    """
    known = {
        camera_id: camera.focal_length
        for camera_id, camera in model.cameras.items()
        if camera.has_prior_focal_length
    }
    if not known:
        return set()
    sample = _of_three(model)
    if sample.num_points3D() < FEWEST_CONFIRMING:
        return set()
    before = _median_error_px(sample)
    adjust_bundle(sample, free_lens=False, free_focal=True, robust_scale_px=_ROBUST_SCALE_PX)
    if not _median_error_px(sample) < _CLEARLY_LESS * before:
        return set()
    ratios = {camera_id: sample.cameras[camera_id].focal_length / known[camera_id] for camera_id in known}
    return {i for i, ratio in ratios.items() if not 1 / _LARGEST_FOCAL_RATIO < ratio < _LARGEST_FOCAL_RATIO}


def _median_error_px(model: pycolmap.Reconstruction) -> float:
    model.update_point_3d_errors()
    return float(np.median([point.error for point in model.points3D.values()]))


def _of_three(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """A copy with some of the points that three photographs see, evenly over the order they were found in."""
    sample = copy.deepcopy(model)
    seen = sorted(i for i, point in model.points3D.items() if point.track.length() >= 3)
    kept = set(seen[:: 1 + len(seen) // _MOST_POINTS])
    for point_id in set(model.points3D) - kept:
        sample.delete_point3D(point_id)
    return sample
