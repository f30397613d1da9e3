"""One run of pycolmap's incremental mapping, set up for few photographs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import PIL.Image  # noqa: F401 - pycolmap loaded before Pillow corrupts memory when Pillow next saves
import pycolmap

_LONGEST_FOCAL_WIDTHS = 1000.0
"""COLMAP's own bound of ten refuses what a long lens, or a crop, tells in EXIF."""


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """How strict the mapper is with its first pair and with each further photograph.

    pycolmap itself halves the first pair's two limits twice before it gives up.
    """

    thorough: bool
    """With fainter features and those of pictures as seen from aside: for photographs that are far apart, and
    subjects with little texture."""
    initial_angle_deg: float
    initial_inliers: int
    further_inliers: int


def mapped_models(
    folder: Path,
    attempt: Attempt,
    seed: int,
    on_photo: Callable[[], None],
    database: Path,
    names: Sequence[str] = (),
) -> list[pycolmap.Reconstruction]:
    """Models of the pictures of these names, or of all, also left beside the database."""
    options = pycolmap.IncrementalPipelineOptions()
    options.image_names = list(names)
    options.min_model_size = 2
    options.extract_colors = False
    options.max_focal_length_ratio = _LONGEST_FOCAL_WIDTHS
    # One thread: sums in another order would be another result.
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    options.ba_local_function_tolerance = options.ba_global_function_tolerance = 1e-6
    # With three photographs most features are seen by two of them.
    options.triangulation.ignore_two_view_tracks = False
    options.mapper.init_min_tri_angle = attempt.initial_angle_deg
    options.mapper.init_min_num_inliers = attempt.initial_inliers
    options.mapper.abs_pose_min_num_inliers = attempt.further_inliers
    # What shares features with one placed photograph alone has no distance, but would be placed at one.
    options.structure_less_registration_fallback = False
    with pycolmap.Database.open(database) as opened:
        lenses = opened.read_all_cameras()
    # A focal length from EXIF is better than what two photographs can tell; refine_lenses weighs the two.
    held = {lens.camera_id for lens in lenses if lens.has_prior_focal_length}
    options.constant_cameras = options.mapper.constant_cameras = held
    models = pycolmap.incremental_mapping(
        database,
        folder,
        database.parent,
        options,
        initial_image_pair_callback=on_photo,
        next_image_callback=on_photo,
    )
    return list(models.values())
