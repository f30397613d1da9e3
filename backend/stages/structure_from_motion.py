"""Cameras from the photographs alone, by pycolmap's incremental mapping, set up for few photographs.

The photographs are matched without their masks: the background places cameras as well as the subject does.
"""

import os
import shutil
from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np
import PIL.Image
import pycolmap
from jaxtyping import Float32, UInt8

from ..images import fitted_size, read_image, resized
from ..kernels.side_by_side import side_by_side
from ..scene import Decision, Photo, Progress, Unplaced
from .camera_evidence import camera_evidence
from .confirmation import FEWEST_CONFIRMING, num_confirming
from .lens_doubt import contradicted_lenses
from .lens_refinement import refine_lenses
from .lenses import PlacedPhoto, Placement, rigid_matrix, sparse_points
from .parallax import require_parallax, why_none_placed, why_unplaced

LENS_MODEL = "SIMPLE_RADIAL"
"""One focal length, the principal point and one distortion coefficient. With separate focal lengths and four
coefficients the cameras of the surveyed fountain come out two to three times worse."""

_UNKNOWN_FOCAL_FACTOR = 1.2
"""Focal length to begin with where EXIF has none, in longer sides of the photograph."""

_FEATURE_BUDGET = 48_000
"""Of all photographs together: with many, each needs fewer, and the time stays bounded."""
_FEWEST_FEATURES = 2_500

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

_LARGEST_ERROR_PX = 2.0
_CONFIRMED_ERROR_PX = 1.0

_LEAST_CONTRAST = 0.02 / 3
_LEAST_CONTRAST_SENSITIVE = 0.02 / 9
"""Of a feature, the difference of Gaussians of which the picture's range is 1. SIFT's own, and a third."""
_LARGEST_RATIO = 0.8
_LARGEST_RATIO_SENSITIVE = 0.9
"""Of a match's distance to that of its best rival (Lowe's test)."""


@dataclass(frozen=True, kw_only=True)
class _Attempt:
    """How strict the mapper is with its first pair and with each further photograph.

    pycolmap itself halves the first pair's two limits twice before it gives up.
    """

    sensitive: bool
    """With fainter features, and matches that are less unlike their rivals, for subjects with little texture.
    An unknown focal length is held meanwhile: so few matches drag it anywhere."""
    guided: bool
    """Matches again along the epipolar lines: more of them, less exact, and slow."""
    initial_angle_deg: float
    initial_inliers: int
    further_inliers: int


_ATTEMPTS = (
    _Attempt(sensitive=False, guided=False, initial_angle_deg=16.0, initial_inliers=100, further_inliers=30),
    _Attempt(sensitive=False, guided=False, initial_angle_deg=6.0, initial_inliers=40, further_inliers=20),
    _Attempt(sensitive=True, guided=False, initial_angle_deg=16.0, initial_inliers=100, further_inliers=30),
    _Attempt(sensitive=True, guided=False, initial_angle_deg=6.0, initial_inliers=40, further_inliers=20),
    _Attempt(sensitive=True, guided=True, initial_angle_deg=16.0, initial_inliers=100, further_inliers=30),
    _Attempt(sensitive=True, guided=True, initial_angle_deg=6.0, initial_inliers=40, further_inliers=15),
)
"""Tried in this order until all photographs are placed and confirmed, the guided ones until enough are."""

_OTHER_FOCAL_FACTORS = (0.4, 4.0, 12.0)
"""Where nothing tells the focal length: begun with that of a usual lens, the mapper takes a very short or
very long one for such, and turns 30 degrees off for right; but then fewer points are confirmed."""
_CLEARLY_MORE = 1.05
_FEW_PHOTOS = 5
"""Time grows faster than their number. Of more photographs, another focal length is tried with so many first,
and chance is not drawn again once all are confirmed: the walnut's twelve then take 90 s instead of 212 on one
core, and their worst camera is off by 1.7 degrees instead of 1.9."""

_LONGEST_FOCAL_WIDTHS = 1000.0
"""COLMAP's own bound of ten refuses what a long lens, or a crop, tells in EXIF."""

_DRAWS = 4
"""Of chance, for each sensitive attempt. The walnut's three photographs come out right or 55 degrees wrong by
what the first pair happens to agree on, but then with a quarter of the points that three confirm."""

_ENOUGH_SHARE = 0.75
"""Of the photographs. Guided matching takes longer than all the rest, too long for a last photograph."""


def estimate_placement(
    photos: Sequence[Photo],
    *,
    max_side_px: int,
    max_features: int,
    workdir: Path,
    seed: int,
    progress: Progress,
) -> Placement:
    """Cameras of the photographs that can be placed, and the features they share, in a frame of its own.

    The same seed gives the same cameras to the bit. Files are written to workdir alone.
    Raises ReconstructionError: NO_OVERLAP, NO_PARALLAX, TOO_FEW_PLACED.
    """
    folder = workdir / "pictures"
    folder.mkdir(parents=True, exist_ok=True)
    side_px = _picture_side_px(photos, max_side_px)
    sizes = [_write_picture(photo, folder / picture_name(i), side_px) for i, photo in enumerate(photos)]
    num_features = min(max_features, max(_FEWEST_FEATURES, _FEATURE_BUDGET // len(photos)))
    groups = _lens_groups(photos, sizes)
    model, database, features = _best_model(folder, groups, num_features, workdir, seed, progress)
    if model is None or model.num_reg_images() < 2:
        raise why_none_placed(database, len(photos))
    against_exif = _groups_against_exif(model, groups)
    doubts = map(_why_not_exif, against_exif.values())
    decisions = (*features, *doubts, *refine_lenses(model, mapped_well=against_exif.keys()))
    _drop_bad_points(model)
    require_parallax(model, database)
    return _placement(model, photos, decisions, database)


@dataclass(frozen=True, kw_only=True)
class LensGroup:
    """Photographs that share one lens."""

    names: tuple[str, ...]
    width: int
    height: int
    focal_px: float | None


def picture_name(index: int) -> str:
    return f"{index:04d}.png"


def _picture_index(name: str) -> int:
    return int(Path(name).stem)


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


def _num_threads() -> int:
    return max(1, min(_MOST_THREADS, os.cpu_count() or 1))


def register_pictures(database: Path, folder: Path, groups: Sequence[LensGroup]) -> None:
    """Enter pictures and lenses in order: the threads that extract would number them as they finish."""
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value  # its notes go to the user's terminal
    pycolmap.Database.open(database).close()
    for group in groups:
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = LENS_MODEL
        reader.default_focal_length_factor = _UNKNOWN_FOCAL_FACTOR
        if group.focal_px is not None:
            reader.camera_params = f"{group.focal_px},{group.width / 2},{group.height / 2},0"
        pycolmap.import_images(
            database,
            folder,
            camera_mode=pycolmap.CameraMode.SINGLE,
            image_names=list(group.names),
            options=reader,
        )


def extract_features(
    database: Path,
    folder: Path,
    groups: Sequence[LensGroup],
    num_features: int,
    *,
    sensitive: bool,
    progress: Progress,
) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = _num_threads()
    options.sift.max_num_features = num_features
    options.sift.peak_threshold = _LEAST_CONTRAST_SENSITIVE if sensitive else _LEAST_CONTRAST
    num_pixels = sum(group.width * group.height * len(group.names) for group in groups)
    names = [name for group in groups for name in group.names]

    def extract(names: Sequence[str]) -> None:
        pycolmap.extract_features(
            database, folder, image_names=names, extraction_options=options, device=pycolmap.Device.cpu
        )

    fine = num_pixels <= _FINE_PIXELS
    if fine and not sensitive and num_pixels > _FEW_PIXELS:
        progress(0.0, "Finding features")
        options.sift.first_octave = 0
        extract(names[:_PROBED])
        fine = _fewest_features(database, _PROBED) < _PLENTY
        if fine:
            with pycolmap.Database.open(database) as opened:
                opened.clear_keypoints()
                opened.clear_descriptors()
    options.sift.first_octave = -1 if fine else 0
    for start in range(0, len(names), options.num_threads):
        progress(0.5 * start / len(names), "Finding features")
        # of those that have features already nothing is sought
        extract(names[start : start + options.num_threads])


def _fewest_features(database: Path, num_pictures: int) -> int:
    """Of the first pictures."""
    with pycolmap.Database.open(database) as opened:
        pictures = sorted(opened.read_all_images(), key=lambda image: image.image_id)[:num_pictures]
        return min(opened.num_keypoints_for_image(image.image_id) for image in pictures)


def match_pictures(database: Path, *, sensitive: bool, guided: bool, seed: int, again: bool = False) -> None:
    """Matches between all pictures, and of them those that one motion of the camera explains.

    `again` keeps the matches that are there and only asks anew, by the seed's chance, what explains them.
    """
    with pycolmap.Database.open(database) as opened:
        if not again:
            opened.clear_matches()
        opened.clear_two_view_geometries()
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.guided_matching = guided
    matching.sift.max_ratio = _LARGEST_RATIO_SENSITIVE if sensitive else _LARGEST_RATIO
    # Guided matching holds a full table of distances per thread.
    matching.num_threads = 1 if guided else _num_threads()
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pycolmap.match_exhaustive(
        database,
        matching_options=matching,
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )


def _best_model(
    folder: Path,
    groups: Sequence[LensGroup],
    num_features: int,
    workdir: Path,
    seed: int,
    progress: Progress,
) -> tuple[pycolmap.Reconstruction | None, Path, tuple[Decision, ...]]:
    """The best model of all attempts, None where there is none at all, and the database of its features.

    With them the decision about features, where fainter ones were tried.
    """
    num_photos = sum(len(group.names) for group in groups)
    best: pycolmap.Reconstruction | None = None
    best_of_usual: pycolmap.Reconstruction | None = None
    best_database = database = workdir / "features.db"
    extracted: bool | None = None
    matched: tuple[bool, bool, int] | None = None
    for number, attempt in enumerate(_ATTEMPTS):
        if _is_enough(best, attempt, num_photos):
            break
        share = 0.5 + 0.08 * number
        if attempt.sensitive != extracted:
            database = workdir / ("sensitive.db" if attempt.sensitive else "features.db")
            database.unlink(missing_ok=True)
            register_pictures(database, folder, groups)
            on_feature = partial(_within, progress, share, share + 0.08) if attempt.sensitive else progress
            extract_features(
                database, folder, groups, num_features, sensitive=attempt.sensitive, progress=on_feature
            )
            extracted = attempt.sensitive
        on_photo = partial(progress, share + 0.06, "Placing cameras")
        for draw in range(_DRAWS if attempt.sensitive and not attempt.guided else 1):
            wanted = attempt.sensitive, attempt.guided, draw
            if wanted != matched:
                progress(share + 0.04, "Matching photographs")
                match_pictures(
                    database,
                    sensitive=attempt.sensitive,
                    guided=attempt.guided,
                    again=matched is not None and matched[:2] == wanted[:2],
                    seed=seed + draw,
                )
                matched = wanted
            mapped = partial(_mapped, folder, attempt, seed + draw, on_photo)
            model = max(mapped(database), key=_merit, default=None)
            if model is not None and (best is None or _merit(model) > _merit(best)):
                best, best_database = model, database
            if num_photos > _FEW_PHOTOS and _is_enough(best, attempt, num_photos):
                break
        if not attempt.sensitive:
            best = _with_another_lens(best, database, mapped)
            best = _without_contradicted_exif(best, database, mapped)
            best_of_usual = best
    if best is None or not extracted:
        return best, database, ()
    return best, best_database, (_why_fainter(best_of_usual, best, num_photos),)


def _with_another_lens(
    model: pycolmap.Reconstruction | None,
    database: Path,
    mapped: Callable[..., list[pycolmap.Reconstruction]],
) -> pycolmap.Reconstruction | None:
    """The model, or one begun with another focal length, where that places more or confirms clearly more.

    Of many photographs it has to do so with a few first. Where there is no model, or all focal lengths are
    known, there is nothing to be tried. They are tried side by side, each with a database of its own.
    """
    with pycolmap.Database.open(database) as opened:
        known = all(lens.has_prior_focal_length for lens in opened.read_all_cameras())
    if model is None or known:
        return model
    few = _few_that_share_most(model)
    best_of_few = max(mapped(database, few), key=_merit, default=None) if few else None

    def begun_with(factor: float) -> list[pycolmap.Reconstruction]:
        own = _copied(database, f"begun_with_{factor:g}")
        _begin_with(own, factor)
        if few and not any(_is_clearly_better(of_few, best_of_few) for of_few in mapped(own, few)):
            return []
        return mapped(own)

    best = model
    for other in chain.from_iterable(side_by_side(begun_with, _OTHER_FOCAL_FACTORS, _num_threads())):
        if _is_clearly_better(other, best):
            best = other
    return best


def _without_contradicted_exif(
    model: pycolmap.Reconstruction | None,
    database: Path,
    mapped: Callable[..., list[pycolmap.Reconstruction]],
) -> pycolmap.Reconstruction | None:
    """The model, or one in which focal lengths from EXIF that it contradicts are as unknown.

    The other must not be clearly worse, and be confirmed: where there is little texture EXIF knows best.
    """
    contradicted = set() if model is None else contradicted_lenses(model)
    if model is None or not contradicted:
        return model
    own = _copied(database, "without_exif")
    _forget_focal_lengths(own, contradicted)
    other = max(mapped(own), key=_merit, default=None)
    if other is None or _is_clearly_better(model, other):
        return model
    return other if _fewest_confirming(other) >= FEWEST_CONFIRMING else model


def _copied(database: Path, folder: str) -> Path:
    """A copy of the database in a folder of its own beside it."""
    own = database.parent / folder / database.name
    own.parent.mkdir(exist_ok=True)
    shutil.copyfile(database, own)
    return own


def _few_that_share_most(model: pycolmap.Reconstruction) -> list[str]:
    """Names of photographs to try a focal length with: each shares the most points with those before it.

    None if there are not more than that.
    """
    ids = sorted(model.reg_image_ids())
    if len(ids) <= _FEW_PHOTOS:
        return []
    _, visibility = sparse_points(model, ids)
    chosen = [int(visibility.sum(axis=0).argmax())]
    while len(chosen) < _FEW_PHOTOS:
        shared = visibility[visibility[:, chosen].any(axis=1)].sum(axis=0)
        shared[chosen] = -1
        chosen.append(int(shared.argmax()))
    return [model.images[ids[index]].name for index in chosen]


def _is_clearly_better(model: pycolmap.Reconstruction, than: pycolmap.Reconstruction | None) -> bool:
    if than is None:
        return True
    (placed, confirmed, _), (placed_than, confirmed_than, _) = _merit(model), _merit(than)
    # Points of two photographs alone decide nothing: they follow any focal length.
    return placed > placed_than or (placed == placed_than and confirmed > _CLEARLY_MORE * confirmed_than)


def _begin_with(database: Path, factor: float) -> None:
    """Enter so many times the longer side as the focal length of lenses that have none."""
    with pycolmap.Database.open(database) as opened:
        for lens in opened.read_all_cameras():
            if lens.has_prior_focal_length:
                continue
            lens.focal_length = factor * max(lens.width, lens.height)
            opened.update_camera(lens)


def _forget_focal_lengths(database: Path, camera_ids: Set[int]) -> None:
    """Make the focal lengths of these lenses unknown, as those of photographs without EXIF."""
    with pycolmap.Database.open(database) as opened:
        for lens in opened.read_all_cameras():
            if lens.camera_id in camera_ids:
                lens.has_prior_focal_length = False
                lens.focal_length = _UNKNOWN_FOCAL_FACTOR * max(lens.width, lens.height)
                opened.update_camera(lens)


def _groups_against_exif(model: pycolmap.Reconstruction, groups: Sequence[LensGroup]) -> dict[int, LensGroup]:
    """By lens, the photographs whose focal length from EXIF was taken as unknown."""
    placed = (model.images[image_id] for image_id in model.reg_image_ids())
    lens_of = {image.name: model.cameras[image.camera_id] for image in placed}
    return {
        lens_of[name].camera_id: group
        for group in groups
        for name in group.names
        if group.focal_px is not None and name in lens_of and not lens_of[name].has_prior_focal_length
    }


def _why_not_exif(group: LensGroup) -> Decision:
    return Decision(
        what=f"EXIF of the {group.width}x{group.height} photographs",
        choice="its focal length is not believed",
        because=f"without its {group.focal_px:.0f} px the photographs fit each other far better",
    )


def _why_fainter(
    usual: pycolmap.Reconstruction | None, best: pycolmap.Reconstruction, num_photos: int
) -> Decision:
    before = f"with the usual ones {_how_sure(usual, num_photos)}"
    if best is usual:
        return Decision(
            what="features", choice="the usual ones", because=f"{before}; fainter ones gave no more"
        )
    after = f"with fainter ones {_how_sure(best, num_photos)}"
    return Decision(what="features", choice="fainter ones", because=f"{before}, {after}")


def _how_sure(model: pycolmap.Reconstruction | None, num_photos: int) -> str:
    if model is None:
        return "no photographs could be placed"
    confirming = _fewest_confirming(model)
    return (
        f"{model.num_reg_images()} of {num_photos} photographs were placed and the least sure of them "
        f"confirmed by {confirming} points that three see"
    )


def _within(progress: Progress, start: float, end: float, share: float, text: str) -> None:
    progress(start + (end - start) * share, text)


def _is_enough(model: pycolmap.Reconstruction | None, attempt: _Attempt, num_photos: int) -> bool:
    """Whether the attempt is not needed any more."""
    if model is None:
        return False
    num_placed = model.num_reg_images()
    if attempt.guided and num_placed >= _ENOUGH_SHARE * num_photos:
        return True
    confirmed = num_photos < 3 or _fewest_confirming(model) >= FEWEST_CONFIRMING
    return num_placed == num_photos and confirmed


def _fewest_confirming(model: pycolmap.Reconstruction) -> int:
    _, visibility = sparse_points(model, list(model.reg_image_ids()))
    return int(num_confirming(visibility).min())


def _merit(model: pycolmap.Reconstruction) -> tuple[int, int, int]:
    """More photographs first, then points that three of them confirm to a pixel, then points."""
    num_confirmed = sum(
        point.track.length() >= 3 and point.error < _CONFIRMED_ERROR_PX for point in model.points3D.values()
    )
    return model.num_reg_images(), num_confirmed, model.num_points3D()


def _mapped(
    folder: Path,
    attempt: _Attempt,
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
    with pycolmap.Database.open(database) as opened:
        lenses = opened.read_all_cameras()
    # A focal length from EXIF is better than what two photographs can tell; refine_lenses weighs the two.
    held = {lens.camera_id for lens in lenses if lens.has_prior_focal_length or attempt.sensitive}
    options.constant_cameras = options.mapper.constant_cameras = held
    if attempt.sensitive:
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    models = pycolmap.incremental_mapping(
        database,
        folder,
        database.parent,
        options,
        initial_image_pair_callback=on_photo,
        next_image_callback=on_photo,
    )
    return list(models.values())


def _drop_bad_points(model: pycolmap.Reconstruction) -> None:
    """Delete points whose mean reprojection error, as last updated, is large."""
    for point_id in [i for i, point in model.points3D.items() if point.error > _LARGEST_ERROR_PX]:
        model.delete_point3D(point_id)


def _placement(
    model: pycolmap.Reconstruction,
    photos: Sequence[Photo],
    decisions: tuple[Decision, ...],
    database: Path,
) -> Placement:
    images = sorted((_picture_index(model.images[i].name), i) for i in model.reg_image_ids())
    placed = tuple(
        PlacedPhoto(
            index=index,
            lens=model.cameras[model.images[image_id].camera_id],
            camera_from_world=rigid_matrix(model.images[image_id].cam_from_world()),
        )
        for index, image_id in images
    )
    positions, visibility = sparse_points(model, [image_id for _, image_id in images])
    seen = {index for index, _ in images}
    missing = [index for index in range(len(photos)) if index not in seen]
    why = why_unplaced(database, [picture_name(index) for index in missing])
    photo_px_per_picture_px = [photos[p.index].image_srgb.shape[1] / p.lens.width for p in placed]
    names = {picture_name(index): photo.name for index, photo in enumerate(photos)}
    evidence = camera_evidence(model, database, names, [i for _, i in images], photo_px_per_picture_px)
    # As COLMAP's own mean, over points of the mean over who sees each; but photographs may differ in size.
    mean_error_px = float((evidence.error_px.sum(axis=1) / visibility.sum(axis=1)).mean())
    return Placement(
        placed=placed,
        unplaced=tuple(
            Unplaced(name=photos[index].name, why=text) for index, text in zip(missing, why, strict=True)
        ),
        sparse_positions=positions,
        sparse_visibility=visibility,
        reprojection_error_px=mean_error_px,
        evidence=evidence,
        estimated=True,
        decisions=decisions,
    )
