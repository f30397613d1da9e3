"""What stereo says of wrong cameras: with right ones nothing, with wrong ones who and what."""

from dataclasses import replace
from functools import cache

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from backend.scene import Camera, SolvedCameras, StereoResult, no_progress
from backend.stages.stereo.config import StereoConfig
from backend.stages.stereo.disagreement import disagreement, outlines_of_masks_miss_px
from backend.stages.stereo.matching import match_solved
from tests.synthetic_scene import CENTRE, Scene, arc_cameras, photographed, true_region


@cache
def scene() -> Scene:
    return photographed(arc_cameras(4, 75, 200))


def told(cameras: list[Camera], **changes: bool) -> tuple[str, ...]:
    """Of the photographs with these cameras instead of theirs."""
    views = zip(scene().views, cameras, strict=True)
    solved = replace(scene().solved(), views=tuple(replace(view, camera=camera) for view, camera in views))
    solved = replace(solved, **changes)  # type: ignore[arg-type]
    return disagreement(solved, matched(solved))


def matched(solved: SolvedCameras) -> StereoResult:
    return match_solved(
        solved, true_region(), StereoConfig(), device=torch.device("cpu"), progress=no_progress
    )


def test_right_cameras_are_not_doubted() -> None:
    assert told(scene().cameras) == ()


def test_a_camera_that_is_turned_is_named() -> None:
    first, *others = scene().cameras
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", 10, degrees=True).as_matrix()
    turned = replace(first, camera_from_world=pose @ first.camera_from_world)
    text, of_outlines = told([turned, *others])
    assert of_outlines.startswith(
        "With the cameras that were given the outlines of the masks miss each other"
    )
    assert text.startswith("Hardly anything that view_00.png shows is found at the same place by another")


def test_a_camera_that_stands_elsewhere_is_told() -> None:
    """Moved around the subject by 10 degrees: much agrees all the same, on a shape that is wrong."""
    first, second, *others = scene().cameras
    orbit = np.eye(4)
    orbit[:3, :3] = Rotation.from_euler("z", 10, degrees=True).as_matrix()
    orbit[:3, 3] = CENTRE - orbit[:3, :3] @ CENTRE
    moved = replace(second, camera_from_world=second.camera_from_world @ np.linalg.inv(orbit))
    (text,) = told([first, moved, *others])
    assert text.startswith("The cameras that were given do not fit the photographs")
    assert "moved between photographs" in text, "its outlines and texture say so too"


def test_focal_lengths_that_are_wrong_are_told() -> None:
    """Ten times too long: the photographs agree all the same."""
    longer = [replace(camera, fx_px=10 * camera.fx_px, fy_px=10 * camera.fy_px) for camera in scene().cameras]
    text, of_outlines = told(longer)
    assert text.startswith("The cameras that were given do not fit the photographs")
    assert of_outlines.startswith(
        "With the cameras that were given the outlines of the masks miss each other"
    )


def test_outlines_that_fewview_cut_out_itself_tell_nothing_of_cameras() -> None:
    longer = [replace(camera, fx_px=10 * camera.fx_px, fy_px=10 * camera.fy_px) for camera in scene().cameras]
    assert len(told(longer, masks_cut_out=True)) == 1


def test_without_texture_outlines_tell() -> None:
    """The cameras lie where they should, turned about their own axes: nothing is measured anyway."""
    plain = photographed(scene().cameras, textured=False)
    assert plain.views[0].mask is not None
    right = outlines_of_masks_miss_px(plain.views)
    rolled = [
        replace(view, camera=replace(view.camera, camera_from_world=rolled_by(angle) @ pose))
        for view, angle, pose in zip(
            plain.views, (5, -4, 3, -5), (view.camera.camera_from_world for view in plain.views), strict=True
        )
    ]
    wrong = outlines_of_masks_miss_px(rolled)
    assert right is not None
    assert wrong is not None
    assert right < 0.1
    assert wrong > 0.8
    assert outlines_of_masks_miss_px([*rolled[1:], replace(rolled[0], mask=None)]) is None
    assert outlines_of_masks_miss_px(rolled[:2]) is None


def rolled_by(angle_deg: float) -> np.ndarray:
    """A turn about the optical axis."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", angle_deg, degrees=True).as_matrix()
    return turn
