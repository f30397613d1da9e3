"""Cameras from the photographs alone, by pycolmap's incremental mapping, set up for few photographs."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import PIL.Image  # noqa: F401 - pycolmap loaded before Pillow corrupts memory when Pillow next saves
import pycolmap

from ...scene import Decision, Photo, Progress, Unplaced
from .camera_evidence import camera_evidence
from .features import LensGroup, picture_index, picture_name, write_pictures
from .lens_refinement import refine_lenses
from .lenses import PlacedPhoto, Placement, rigid_matrix, sparse_points
from .model_choice import best_model
from .outline_cameras import held_against_outlines
from .parallax import require_parallax, why_none_placed, why_unplaced

_FEATURE_BUDGET = 48_000
"""Of all photographs together: with many, each needs fewer, and the time stays bounded."""
_FEWEST_FEATURES = 2_500

_LARGEST_ERROR_PX = 2.0


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
    groups = write_pictures(photos, folder, max_side_px)
    num_features = min(max_features, max(_FEWEST_FEATURES, _FEATURE_BUDGET // len(photos)))
    model, database, features = best_model(
        folder, groups, num_features, workdir=workdir, seed=seed, progress=progress
    )
    if model is None or model.num_reg_images() < 2:
        raise why_none_placed(database, len(photos))
    against_exif = _groups_against_exif(model, groups)
    doubts = map(_why_not_exif, against_exif.values())
    decisions = (*features, *doubts, *refine_lenses(model, mapped_well=against_exif.keys()))
    _drop_bad_points(model)
    on_step = partial(progress, 0.98, "Holding cameras against outlines")
    mapped = model
    model, about_outlines = held_against_outlines(mapped, database, photos, on_step)
    require_parallax(model, database)
    placement = _placement(model, photos, database)
    return replace(placement, suit_outlines=model is not mapped, decisions=(*decisions, *about_outlines))


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


def _drop_bad_points(model: pycolmap.Reconstruction) -> None:
    """Delete points whose mean reprojection error, as last updated, is large."""
    for point_id in [i for i, point in model.points3D.items() if point.error > _LARGEST_ERROR_PX]:
        model.delete_point3D(point_id)


def _placement(
    model: pycolmap.Reconstruction,
    photos: Sequence[Photo],
    database: Path,
) -> Placement:
    images = sorted((picture_index(model.images[i].name), i) for i in model.reg_image_ids())
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
    )
