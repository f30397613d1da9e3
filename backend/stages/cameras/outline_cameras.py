"""Estimated cameras of a subject with little texture, held against its outlines.

Where hardly any feature is seen by three photographs, those that two share are mostly mistaken, and cameras
that suit them may be anywhere. But each photograph with a mask knows an outline, and outlines of one subject
contradict cameras that are wrong, whatever its texture (maths/outline_agreement.py).
"""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import PIL.Image  # noqa: F401 - pycolmap loaded before Pillow corrupts memory when Pillow next saves
import pycolmap
from jaxtyping import Bool, Float64, Int64

from ...maths.outline_fit import Features, OutlineFit, fit_to_outlines, outlines_miss_px
from ...maths.pieces import connected_pieces
from ...maths.posed_views import PosedViews
from ...maths.silhouette import silhouettes_or_none
from ...scene import Decision, Photo
from .features import picture_index
from .lens_refinement import focal_sigma
from .lenses import rigid_matrix
from .model_merit import fewest_confirming

_WELL_CONFIRMED = 200
"""Points that three photographs see, of the photograph with the fewest: with 160, cameras of what is plain
were still up to 1.6 degrees off."""
_MET_PX = 0.1
"""By which the outlines of exact masks miss each other at most, and of those that are a pixel too wide."""
_LARGEST_SHARE_LEFT = 0.25
"""Of what outlines missed each other by before, with cameras that are taken although they miss by more: then
the masks are rough, and a good fit to few outlines may be one to their faults."""
_FEWEST_POINTS = 8
"""That must be left of the features, for what comes after lives on them."""
_OFF_PX = 2.0
"""From where its place is shown: more is no sighting of it."""


def held_against_outlines(
    model: pycolmap.Reconstruction, database: Path, photos: Sequence[Photo], on_step: Callable[[], None]
) -> tuple[pycolmap.Reconstruction, tuple[Decision, ...]]:
    """The model itself, or another whose cameras suit the outlines, and what decided it.

    Only where points that three photographs see do not confirm the cameras well, and each photograph that was
    placed has a mask that shows the subject whole. Distortion is taken to be none then, for nothing tells it.
    """
    ids = sorted(model.reg_image_ids())
    if fewest_confirming(model) >= _WELL_CONFIRMED:
        return model, ()
    images = [model.images[image_id] for image_id in ids]
    lenses = [model.cameras[image.camera_id] for image in images]
    shown = [photos[picture_index(image.name)] for image in images]
    silhouettes = silhouettes_or_none(photo.mask for photo in shown)
    if silhouettes is None:
        return model, ()
    widths_px = [photo.image_srgb.shape[1] for photo in shown]
    scale = np.array([width_px / lens.width for width_px, lens in zip(widths_px, lenses, strict=True)])
    views = _posed(images, lenses, scale)
    before = outlines_miss_px(views, silhouettes)
    seen = _sightings(database, [image.name for image in images], scale)
    sigma = np.array([focal_sigma(lens) for lens in lenses])
    fit = fit_to_outlines(views, silhouettes, seen.features, sigma, on_step)
    after = outlines_miss_px(fit.views, silhouettes)
    moved, num_points = _with_cameras(model, ids, fit, seen, scale)
    because = f"outlines missed each other by {before:.2f} px, with cameras that suit them by {after:.2f} px"
    if after > max(_MET_PX, _LARGEST_SHARE_LEFT * before) or num_points < _FEWEST_POINTS:
        return model, (_decision("left as they are", because),)
    return moved, (_decision("adjusted", because),)


def _decision(choice: str, because: str) -> Decision:
    return Decision(what="estimated cameras, held against outlines", choice=choice, because=because)


def _posed(
    images: Sequence[pycolmap.Image], lenses: Sequence[pycolmap.Camera], scale: Float64[np.ndarray, "views"]
) -> PosedViews:
    """The images' cameras over the photographs, without distortion."""
    poses = np.array([rigid_matrix(image.cam_from_world()) for image in images])
    _, number = np.unique([image.camera_id for image in images], return_inverse=True)
    return PosedViews(
        rotation=poses[:, :3, :3],
        translation=poses[:, :3, 3],
        focal_px=np.array([lens.focal_length for lens in lenses]) * scale,
        centre_px=np.array([[lens.width / 2, lens.height / 2] for lens in lenses]) * scale[:, None],
        lens=number.astype(np.int64),
    )


@dataclass(frozen=True, kw_only=True)
class _Sightings:
    """Features that photographs share, and which of the photograph's own each is."""

    features: Features
    number: Int64[np.ndarray, "sightings"]


def _sightings(database: Path, names: Sequence[str], scale: Float64[np.ndarray, "views"]) -> _Sightings:
    """What is linked by matches between two photographs, but what that links twice in one."""
    with pycolmap.Database.open(database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        pixels = [np.asarray(opened.read_keypoints(ids[name]), np.float64)[:, :2] for name in names]
        first = np.concatenate([[0], np.cumsum([len(of_one) for of_one in pixels])])
        links = [np.zeros((0, 2), np.int64)]
        for a, one in enumerate(names):
            for b, other in enumerate(names[:a]):
                if opened.exists_two_view_geometry(ids[other], ids[one]):
                    pair = opened.read_two_view_geometry(ids[other], ids[one])
                    links.append(np.asarray(pair.inlier_matches, np.int64) + first[[b, a]])
    view = np.repeat(np.arange(len(names)), np.diff(first))
    group = connected_pieces(np.concatenate(links).T, int(first[-1]))
    in_view = np.zeros((group.max(initial=-1) + 1, len(names)), np.int64)
    np.add.at(in_view, (group, view), 1)
    is_place = (in_view.max(axis=1) == 1) & (in_view.sum(axis=1) >= 2)
    kept: Bool[np.ndarray, "features"] = is_place[group]
    _, place = np.unique(group[kept], return_inverse=True)
    scaled = np.concatenate(pixels) * scale[view, None]
    features = Features(view=view[kept], pixels=scaled[kept], place=place.astype(np.int64))
    return _Sightings(features=features, number=(np.arange(len(view)) - first[view])[kept])


def _with_cameras(
    model: pycolmap.Reconstruction,
    ids: Sequence[int],
    fit: OutlineFit,
    seen: _Sightings,
    scale: Float64[np.ndarray, "views"],
) -> tuple[pycolmap.Reconstruction, int]:
    """A model with the cameras that were found, and places that they see as points; how many these are."""
    moved, views, features = copy(model), fit.views, seen.features
    for point_id in list(moved.points3D):
        moved.delete_point3D(point_id)
    for view, image_id in enumerate(ids):
        image = moved.images[image_id]
        lens = moved.cameras[image.camera_id]
        lens.params = [views.focal_px[view] / scale[view], lens.width / 2, lens.height / 2, 0.0]
        pose = np.concatenate([views.rotation[view], views.translation[view, :, None]], axis=1)
        assert image.frame is not None  # of one that is placed
        image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(pose))
    _, depth = views.shown(features.view, fit.places[features.place])
    is_seen = (np.linalg.norm(fit.beside_px(features), axis=1) < _OFF_PX) & (depth > 0)
    num_points = 0
    for place, position in enumerate(fit.places):
        rows = np.flatnonzero((features.place == place) & is_seen)
        if len(rows) >= 2:
            track = pycolmap.Track()
            for row in rows:
                track.add_element(ids[features.view[row]], int(seen.number[row]))
            moved.add_point3D(position, track)
            num_points += 1
    moved.update_point_3d_errors()
    return moved, num_points
