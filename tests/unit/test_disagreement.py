"""What stereo says of wrong cameras: with right ones nothing, with wrong ones who and what."""

from dataclasses import replace
from functools import cache

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from backend.scene import Camera, SolvedCameras, StereoResult, no_progress
from backend.stages.camera_refinement import match_solved
from backend.stages.disagreement import disagreement
from backend.stages.stereo_config import StereoConfig
from tests.synthetic_scene import CENTRE, Scene, arc_cameras, photographed, true_region


@cache
def scene() -> Scene:
    return photographed(arc_cameras(4, 75, 200))


def told(cameras: list[Camera]) -> tuple[str, ...]:
    """Of the photographs with these cameras instead of theirs."""
    views = zip(scene().views, cameras, strict=True)
    solved = replace(scene().solved(), views=tuple(replace(view, camera=camera) for view, camera in views))
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
    (text,) = told([turned, *others])
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
    (text,) = told(longer)
    assert text.startswith("The cameras that were given do not fit the photographs")
