"""Pictures of the photographs, the features in them, and the matches between those.

The photographs are matched without their masks: the background places cameras as well as the subject does.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import PIL.Image
import pycolmap
from jaxtyping import Float32, UInt8

from ...images import fitted_size, read_image, resized
from ...scene import Photo, Progress, within
from .tilted_features import DIRECTIONS, add_tilted_features, match_tilted_features

_LENS_MODEL = "SIMPLE_RADIAL"
"""One focal length, the principal point and one distortion coefficient. With separate focal lengths and four
coefficients the cameras of the surveyed fountain come out two to three times worse."""

UNKNOWN_FOCAL_FACTOR = 1.2
"""Focal length to begin with where EXIF has none, in longer sides of the photograph."""

_FINE_PIXELS = 12_000_000
"""Up to so many pixels in all photographs together, features are also sought at twice the resolution: three
times the work, and half the error of three photographs' cameras. Eleven place each other as well without."""
_FEW_PIXELS = 6_000_000
"""Past so many, as of four large photographs, they are not where the first ones have plenty without: four to
six of the fountain, with five thousand each, place each other as exactly so in a third of the time."""
_FINE_SIDE_PX = 1_280
"""No larger then: of three photographs of 1600 pixels the cameras are nearly as exact (worst rotation 0.10
degrees instead of 0.08, mean of nine threes of the fountain) after three quarters of the time."""
_PLENTY = 2_500
"""Measured without: 4000 to 13 000 of what is textured, 900 to 1100 of a dark walnut, which needs them."""
_PROBED = 2
"""Photographs that tell."""

_MOST_THREADS = 4
"""Feature extraction holds about 0.4 GB a thread."""

_BRIGHT_SHARE = 0.99
_DARK_LEVEL = 0.4
"""A photograph is dark where the bright share of its pixels is under this. Others stay as they are: more
contrast would fill the places of fine features, which are the exact ones, with coarse ones."""
_LARGEST_GAIN = 8.0

_LEAST_CONTRAST = 0.02 / 3
_LEAST_CONTRAST_THOROUGH = 0.02 / 9
"""Of a feature, the difference of Gaussians of which the picture's range is 1. SIFT's own, and a third."""
_LARGEST_RATIO = 0.8
"""Of a match's distance to that of its best rival (Lowe's test)."""

_FINE_ASIDE_PIXELS = 3_000_000
"""Up to so many in all, features of pictures as seen from aside are sought at twice the resolution as well:
three to four times as many points that three photographs see, where those are 40 degrees apart."""
_THOROUGH_BUDGET = 64_000
"""Features of all pictures together, those seen from aside among them: each is compared with all others."""
_ASIDE_SHARE = 2 / 3
"""Of them, those seen from aside."""


@dataclass(frozen=True, kw_only=True)
class LensGroup:
    """Photographs that share one lens."""

    names: tuple[str, ...]
    width: int
    height: int
    focal_px: float | None


def picture_name(index: int) -> str:
    return f"{index:04d}.png"


def picture_index(name: str) -> int:
    return int(Path(name).stem)


def write_pictures(photos: Sequence[Photo], folder: Path, max_side_px: int) -> list[LensGroup]:
    """Write the photographs in grey into the folder, named by their indices; return which share a lens."""
    folder.mkdir(parents=True, exist_ok=True)
    side_px = _picture_side_px(photos, max_side_px)
    sizes = [_write_picture(photo, folder / picture_name(i), side_px) for i, photo in enumerate(photos)]
    return _lens_groups(photos, sizes)


def _picture_side_px(photos: Sequence[Photo], max_side_px: int) -> int:
    """Of the pictures in which features are sought: smaller where they are sought at twice that."""
    sizes = (fitted_size(photo.original_width, photo.original_height, max_side_px) for photo in photos)
    few = sum(width * height for width, height in sizes) <= _FEW_PIXELS
    return min(max_side_px, _FINE_SIDE_PX) if few else max_side_px


def _write_picture(photo: Photo, path: Path, max_side_px: int) -> tuple[int, int]:
    """Write the photograph in grey, as large as wanted and there is; return its width and height."""
    width, height = fitted_size(photo.original_width, photo.original_height, max_side_px)
    image = photo.image_srgb
    if image.shape[1] < width:
        image = read_image(photo.path, max_side_px).image_srgb
    elif image.shape[1] > width:
        image = resized(image, width, height)
    PIL.Image.fromarray(brightness(image)).save(path, compress_level=1)
    return image.shape[1], image.shape[0]


def brightness(image_srgb: Float32[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "height width"]:
    """Brightness, of a dark photograph raised: features are found by absolute contrast."""
    luma = image_srgb @ np.array([0.299, 0.587, 0.114], np.float32)  # ITU-R BT.601
    level = float(np.quantile(luma, _BRIGHT_SHARE))
    gain = min(1.0 / max(level, 1e-3), _LARGEST_GAIN) if level < _DARK_LEVEL else 1.0
    grey: UInt8[np.ndarray, "height width"] = np.rint(np.minimum(gain * luma, 1.0) * 255).astype(np.uint8)
    return grey


def _lens_groups(photos: Sequence[Photo], sizes: Sequence[tuple[int, int]]) -> list[LensGroup]:
    """One group for each picture size and focal length: the same camera, not zoomed in between."""
    members: dict[tuple[int, int, float | None], list[str]] = {}
    for index, (photo, (width, height)) in enumerate(zip(photos, sizes, strict=True)):
        focal_px = None
        if photo.focal_px is not None:
            focal_px = round(
                photo.focal_px * max(width, height) / max(photo.original_width, photo.original_height), 1
            )
        members.setdefault((width, height, focal_px), []).append(picture_name(index))
    return [
        LensGroup(names=tuple(names), width=width, height=height, focal_px=focal_px)
        for (width, height, focal_px), names in members.items()
    ]


def register_pictures(database: Path, folder: Path, groups: Sequence[LensGroup]) -> None:
    """Enter pictures and lenses in order: the threads that extract would number them as they finish."""
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value  # its notes go to the user's terminal
    pycolmap.Database.open(database).close()
    for group in groups:
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = _LENS_MODEL
        reader.default_focal_length_factor = UNKNOWN_FOCAL_FACTOR
        if group.focal_px is not None:
            reader.camera_params = f"{group.focal_px},{group.width / 2},{group.height / 2},0"
        pycolmap.import_images(
            database,
            folder,
            camera_mode=pycolmap.CameraMode.SINGLE,
            image_names=list(group.names),
            options=reader,
        )


def num_threads() -> int:
    return max(1, min(_MOST_THREADS, os.cpu_count() or 1))


def extract_features(
    database: Path,
    folder: Path,
    groups: Sequence[LensGroup],
    num_features: int,
    *,
    progress: Progress,
) -> None:
    """Features of all pictures, at most num_features of each.

    Finely, at twice the pictures' resolution, unless there are many pixels or plenty of features without.
    """
    num_pixels, names = _pixels_and_names(groups)
    options = _extraction_options(num_features, _LEAST_CONTRAST)
    fine = num_pixels <= _FINE_PIXELS
    if fine and num_pixels > _FEW_PIXELS:
        progress(0.0, "Finding features")
        options.sift.first_octave = 0
        _extract(database, folder, names[:_PROBED], options)
        fine = _fewest_features(database, _PROBED) < _PLENTY
        if fine:
            with pycolmap.Database.open(database) as opened:
                opened.clear_keypoints()
                opened.clear_descriptors()
    options.sift.first_octave = -1 if fine else 0
    _extract_in_turn(database, folder, names, options, progress)


def extract_thoroughly(
    database: Path,
    folder: Path,
    groups: Sequence[LensGroup],
    num_features: int,
    *,
    progress: Progress,
) -> None:
    """Fainter features as well, and those of the pictures as seen from aside."""
    num_pixels, names = _pixels_and_names(groups)
    budget = _THOROUGH_BUDGET / len(names)
    upright = min(num_features, round((1 - _ASIDE_SHARE) * budget))
    options = _extraction_options(upright, _LEAST_CONTRAST_THOROUGH)
    options.sift.first_octave = -1 if num_pixels <= _FINE_PIXELS else 0
    _extract_in_turn(database, folder, names, options, within(progress, 0.0, 0.5))
    aside = min(num_features, round(_ASIDE_SHARE * budget / DIRECTIONS))
    options = _extraction_options(aside, _LEAST_CONTRAST_THOROUGH)
    options.sift.first_octave = -1 if num_pixels <= _FINE_ASIDE_PIXELS else 0
    add_tilted_features(database, folder, names, options, within(progress, 0.5, 1.0))


def _pixels_and_names(groups: Sequence[LensGroup]) -> tuple[int, list[str]]:
    """Of all pictures, how many pixels together, and their names."""
    num_pixels = sum(group.width * group.height * len(group.names) for group in groups)
    return num_pixels, [name for group in groups for name in group.names]


def _extraction_options(num_features: int, least_contrast: float) -> pycolmap.FeatureExtractionOptions:
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = num_threads()
    options.sift.max_num_features = num_features
    options.sift.peak_threshold = least_contrast
    return options


def _extract_in_turn(
    database: Path,
    folder: Path,
    names: Sequence[str],
    options: pycolmap.FeatureExtractionOptions,
    progress: Progress,
) -> None:
    """A few pictures at a time, so that it shows and can be cancelled."""
    for start in range(0, len(names), options.num_threads):
        progress(start / len(names), "Finding features")
        # of those that have features already nothing is sought
        _extract(database, folder, names[start : start + options.num_threads], options)


def _extract(
    database: Path, folder: Path, names: Sequence[str], options: pycolmap.FeatureExtractionOptions
) -> None:
    pycolmap.extract_features(
        database, folder, image_names=list(names), extraction_options=options, device=pycolmap.Device.cpu
    )


def _fewest_features(database: Path, num_pictures: int) -> int:
    """Of the first pictures."""
    with pycolmap.Database.open(database) as opened:
        pictures = sorted(opened.read_all_images(), key=lambda image: image.image_id)[:num_pictures]
        return min(opened.num_keypoints_for_image(image.image_id) for image in pictures)


def match_pictures(database: Path, *, seed: int, progress: Progress) -> None:
    """Matches between all pictures, and of them those that one motion of the camera explains."""
    with pycolmap.Database.open(database) as opened:
        opened.clear_matches()
        opened.clear_two_view_geometries()
    progress(0.0, "Matching photographs")
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.num_threads = num_threads()
    matching.sift.max_ratio = _LARGEST_RATIO
    pycolmap.match_exhaustive(
        database,
        matching_options=matching,
        verification_options=_verification_options(seed),
        device=pycolmap.Device.cpu,
    )


def match_thoroughly(database: Path, *, seed: int, again: bool, progress: Progress) -> None:
    """The same of features that were sought thoroughly, of which several may be at one place.

    `again` keeps the matches that are there and only asks anew, by the seed's chance, what explains them.
    """
    with pycolmap.Database.open(database) as opened:
        opened.clear_two_view_geometries()
    progress(0.0, "Matching photographs")
    if not again:
        match_tilted_features(database, _LARGEST_RATIO, progress)
    pycolmap.geometric_verification(database, two_view_geometry_options=_verification_options(seed))


def _verification_options(seed: int) -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    return options
