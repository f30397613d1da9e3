"""What estimated cameras rest on: which photographs match, how far off the pixels are, how sure the poses.

Read from COLMAP's model and database while they are there; `CameraEvidence` is what is kept of them.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import PIL.Image  # noqa: F401 - pycolmap loaded before Pillow corrupts memory when Pillow next saves
import pycolmap
from jaxtyping import Float64, Int64

from ...maths.gauge import cross_matrix, in_gauge_of_the_whole
from ...scene import CameraEvidence
from .bundle_adjustment import bundle_adjuster
from .lenses import shared_tracks

FEWEST_FOR_LENSES = 3
"""Photographs that tell anything of their lens; two leave it as it is (lens_refinement.py)."""


def camera_evidence(
    model: pycolmap.Reconstruction,
    database: Path,
    names: dict[str, str],
    placed: Sequence[int],
    photo_px_per_picture_px: Sequence[float],
) -> CameraEvidence:
    """What the model of the placed photographs and the matches of all of them say.

    `names` are the photographs' by those of their pictures in the database; `placed` are the model's image
    ids in the order of the views, and the last is how much larger the photograph of each is than its picture.
    """
    num_features, num_matched, num_verified = _matches(database, tuple(names))
    offsets = offsets_px(model, placed)
    lenses_free = len(placed) >= FEWEST_FOR_LENSES
    poses, points = covariances_or_none(model, placed, offsets, lenses_free=lenses_free)
    if poses is None and lenses_free:  # as of a wall: then the lenses were not refined either
        lenses_free = False
        poses, points = covariances_or_none(model, placed, offsets, lenses_free=False)
    scale = np.asarray(photo_px_per_picture_px, np.float64)
    return CameraEvidence(
        names=tuple(names.values()),
        num_features=num_features,
        num_matched=num_matched,
        num_verified=num_verified,
        error_px=np.linalg.norm(offsets, axis=2) * scale,
        pose_covariance=poses,
        lenses_free=lenses_free,
        point_sigma_world=points,
    )


def _matches(
    database: Path, pictures: Sequence[str]
) -> tuple[
    Int64[np.ndarray, "photos"], Int64[np.ndarray, "photos photos"], Int64[np.ndarray, "photos photos"]
]:
    """Features of each picture, and how many of two pictures look alike, and fit together."""
    matched, verified = np.zeros((2, len(pictures), len(pictures)), np.int64)
    with pycolmap.Database.open(database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        features = [opened.num_keypoints_for_image(ids[name]) for name in pictures]
        for i, one in enumerate(pictures):
            for j, other in enumerate(pictures[:i]):
                pair = ids[one], ids[other]
                if opened.exists_matches(*pair):
                    matched[i, j] = matched[j, i] = len(opened.read_matches(*pair))
                if opened.exists_two_view_geometry(*pair):
                    num_inliers = len(opened.read_two_view_geometry(*pair).inlier_matches)
                    verified[i, j] = verified[j, i] = num_inliers
    return np.array(features, np.int64), matched, verified


def offsets_px(
    model: pycolmap.Reconstruction, placed: Sequence[int]
) -> Float64[np.ndarray, "points views 2"]:
    """From where the lens shows each point to its feature; 0 where it has none."""
    tracks = shared_tracks(model, placed)
    offsets = np.zeros((len(tracks), len(placed), 2))
    for view, image_id in enumerate(placed):
        image = model.images[image_id]
        rows = [row for row, track in enumerate(tracks.values()) if view in track]
        seen = [(point, track[view]) for point, track in tracks.items() if view in track]
        if not seen:
            continue
        positions = np.array([model.points3D[point].xyz for point, _ in seen])
        features = np.array([image.points2D[number].xy for _, number in seen])
        in_camera = image.cam_from_world() * positions
        offsets[rows, view] = features - model.cameras[image.camera_id].img_from_cam(in_camera)
    return offsets


def covariances_or_none(
    model: pycolmap.Reconstruction,
    placed: Sequence[int],
    offsets_px: Float64[np.ndarray, "points views 2"],
    *,
    lenses_free: bool,
) -> tuple[Float64[np.ndarray, "views 6 6"] | None, Float64[np.ndarray, "points"] | None]:
    """Of poses, and of points given the poses, with the noise that the pixels themselves show.

    Its variance is the sum of squares over what is left of the equations when the unknowns are taken off.
    """
    tracks = shared_tracks(model, placed)
    num_equations = 2 * sum(len(track) for track in tracks.values())
    lenses = {model.images[image_id].camera_id for image_id in placed}
    num_lens = sum(len(model.cameras[lens].params) for lens in lenses) if lenses_free else 0
    num_left = num_equations - 3 * len(tracks) - 6 * len(placed) - num_lens + 7
    if num_left <= 0:
        return None, None
    adjuster = bundle_adjuster(model, free_lens=lenses_free, robust_scale_px=None)
    found = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), model, adjuster)
    if found is None:
        return None, None
    variance = float((offsets_px**2).sum()) / num_left
    poses = variance * _pose_covariance(model, placed, found)
    largest = [np.linalg.eigvalsh(np.asarray(found.get_point_cov(point)))[-1] for point in tracks]
    return poses, np.sqrt(variance * np.array(largest, np.float64))


def _pose_covariance(
    model: pycolmap.Reconstruction, placed: Sequence[int], found: pycolmap.BACovariance
) -> Float64[np.ndarray, "views 6 6"]:
    """COLMAP's joint covariance, made whole and carried to world axes and to the gauge of all cameras."""
    images = [model.images[image_id] for image_id in placed]
    columns = _free_coordinates(model, placed, found)
    joint = np.zeros((6 * len(placed), 6 * len(placed)))
    for i, one in enumerate(placed):
        for j, other in enumerate(placed):
            if len(columns[i]) and len(columns[j]):
                block = found.get_cam_cross_cov_from_world(one, other)
                joint[np.ix_(6 * i + columns[i], 6 * j + columns[j])] = block
    to_world = np.zeros_like(joint)
    for i, image in enumerate(images):
        to_world[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = _world_from_tangent(image.cam_from_world())
    centres = np.array([image.projection_center() for image in images])
    middle = np.median([point.xyz for point in model.points3D.values()], axis=0)
    viewing_distance = float(np.sqrt(((centres - middle) ** 2).sum(axis=1).mean()))
    free = in_gauge_of_the_whole(to_world @ joint @ to_world.T, centres, viewing_distance)
    return np.array([free[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(len(placed))])


def _free_coordinates(
    model: pycolmap.Reconstruction, placed: Sequence[int], found: pycolmap.BACovariance
) -> list[Int64[np.ndarray, "free"]]:
    """Which of its six coordinates COLMAP let each camera have, to fix the gauge.

    One camera is held; of a second, the coordinate of its translation in which the two are farthest apart.
    """
    blocks = [found.get_cam_cov_from_world(image_id) for image_id in placed]
    held = next(i for i, block in enumerate(blocks) if block is None)
    columns = []
    for image_id, block in zip(placed, blocks, strict=True):
        every = np.arange(6)
        if block is None:
            every = every[:0]
        elif len(block) == 5:
            first = model.images[placed[held]].cam_from_world()
            baseline = (first * model.images[image_id].cam_from_world().inverse()).translation
            every = np.delete(every, 3 + int(np.argmax(np.abs(baseline))))
        columns.append(every)
    return columns


def _world_from_tangent(camera_from_world: pycolmap.Rigid3d) -> Float64[np.ndarray, "6 6"]:
    """From COLMAP's tangent (quaternion, translation, in camera axes) to orientation and centre.

    With R <- exp(w) R and t <- t + v, the centre -R^T t moves by R^T (w x t - v), the orientation by -R^T w.
    COLMAP's w is the vector of a quaternion, half of the rotation.
    """
    back = camera_from_world.rotation.matrix().T
    world_from_tangent = np.zeros((6, 6))
    world_from_tangent[:3, :3] = -2 * back
    world_from_tangent[3:, :3] = -2 * back @ cross_matrix(camera_from_world.translation)
    world_from_tangent[3:, 3:] = -back
    return world_from_tangent
