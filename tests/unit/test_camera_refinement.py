"""Cameras that were moved on purpose come back; those that are right, or can not be mended, stay."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from backend.scene import Camera, StereoResult, SurfacePoints, View, no_progress, transform_points
from backend.stages.stereo import camera_refinement, matching
from backend.stages.stereo.camera_refinement import (
    Sightings,
    find_patches,
    largest_move_px,
    misplaced_px,
    refine_cameras,
    with_cameras,
    with_refined,
)
from backend.stages.stereo.config import StereoConfig
from backend.stages.stereo.matching import match_solved
from tests.relative_rotations import rotation_errors_deg
from tests.synthetic_scene import (
    DISTANCE,
    SIZE,
    Scene,
    arc_cameras,
    photographed,
    surface_points,
    true_region,
)

CPU = torch.device("cpu")


@cache
def scene() -> Scene:
    return photographed(arc_cameras(3, 30, 320), wall=True)


def jittered(cameras: list[Camera], size_px: float) -> list[Camera]:
    """Each turned and moved by chance, so that what it sees moves by about so much."""
    random = np.random.default_rng(3)
    moved = []
    for camera in cameras:
        angle = size_px / camera.fx_px
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_rotvec(0.5 * angle * random.normal(size=3)).as_matrix()
        motion[:3, 3] = 0.5 * angle * DISTANCE * SIZE * random.normal(size=3)
        moved.append(replace(camera, camera_from_world=motion @ camera.camera_from_world))
    return moved


def measured(views: tuple[View, ...]) -> SurfacePoints:
    """What stereo finds: the true depths, put where the views' cameras say that they are."""
    positions, normals, numbers = [], [], []
    for index, (view, depth, normal) in enumerate(zip(views, scene().depths, scene().normals, strict=True)):
        rows, columns = np.nonzero(np.isfinite(depth))
        pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=1)
        in_camera = pixels @ np.linalg.inv(view.camera.intrinsics).T * depth[rows, columns, None]
        world = transform_points(np.linalg.inv(view.camera.camera_from_world), in_camera)
        positions.append(transform_points(true_region().object_from_world, world))
        normals.append(normal[rows, columns])
        numbers.append(np.full(len(rows), index))
    count = sum(map(len, numbers))
    return SurfacePoints(
        positions=np.concatenate(positions).astype(np.float32),
        normals=np.concatenate(normals).astype(np.float32),
        colours_srgb=np.full((count, 3), 0.5, np.float32),
        confidence=np.random.default_rng(0).uniform(0.3, 1, count).astype(np.float32),
        num_views=np.full(count, 3),
        view_index=np.concatenate(numbers),
    )


def rotation_error_deg(cameras: tuple[Camera, ...]) -> float:
    """The largest between two cameras, against the true ones."""
    poses = [camera.camera_from_world for camera in cameras]
    return float(rotation_errors_deg(poses, [camera.camera_from_world for camera in scene().cameras]).max())


def test_moved_cameras_come_back() -> None:
    """Points lie about a pixel off: a fifth of the rotation error is left, a thirtieth of the evidence."""
    views = with_cameras(scene().views, jittered(scene().cameras, 0.4))
    points = measured(views)
    refined = refine_cameras(views, true_region(), points, device=CPU)
    assert refined.cameras is not None
    assert refined.decision.choice == "refined"
    before = tuple(view.camera for view in views)
    assert rotation_error_deg(refined.cameras) < 0.2 * rotation_error_deg(before)
    seen = find_patches(views, true_region(), points, device=CPU)
    before_px, after_px = misplaced_px(before, seen), misplaced_px(refined.cameras, seen)
    assert before_px is not None
    assert after_px is not None
    assert before_px > 0.9
    assert after_px < 0.03
    assert f"{before_px:.2f} px" in refined.decision.because
    again = refine_cameras(views, true_region(), points, device=CPU)
    assert again.cameras is not None
    for one, other in zip(refined.cameras, again.cameras, strict=True):
        np.testing.assert_array_equal(one.camera_from_world, other.camera_from_world)


def test_true_cameras_stay() -> None:
    views = scene().views
    seen = find_patches(views, true_region(), measured(views), device=CPU)
    evidence_px = misplaced_px(scene().cameras, seen)
    assert evidence_px is not None
    assert evidence_px < 0.02
    refined = refine_cameras(views, true_region(), measured(views), device=CPU)
    assert refined.cameras is None
    assert refined.decision.choice == "left as estimated"
    assert "would be worth a refinement" in refined.decision.because


def sightings_between(cameras: list[Camera]) -> Sightings:
    """A hundred points of the body for each camera, seen without error by all others, if through it."""
    random = np.random.default_rng(0).normal(size=(100 * len(cameras), 3))
    positions = surface_points(random / np.linalg.norm(random, axis=1, keepdims=True))
    home = np.repeat(np.arange(len(cameras)), 100)
    pixels = np.stack([pixels_of(camera, positions) for camera in cameras])
    view, patch = np.nonzero(np.arange(len(cameras))[:, None] != home)
    return Sightings(
        positions=positions,
        home=home,
        home_px=pixels[home, np.arange(len(home))],
        patch=patch,
        view=view,
        seen_px=pixels[view, patch],
    )


def pixels_of(camera: Camera, positions: np.ndarray) -> np.ndarray:
    homogeneous = transform_points(camera.camera_from_world, positions) @ camera.intrinsics.T
    return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:])


def test_one_bad_camera_of_five_is_noticed() -> None:
    """Most pairs of photographs know nothing of it."""
    true = arc_cameras(5, 60, 160)
    seen = sightings_between(true)
    cameras = [*true[:2], jittered(true, 1.0)[2], *true[3:]]
    assert misplaced_px(true, seen) == pytest.approx(0.0, abs=1e-9)
    evidence_px = misplaced_px(cameras, seen)
    assert evidence_px is not None
    assert evidence_px > 0.3


def test_what_no_pose_explains_is_left_alone() -> None:
    """As where the subject moved: in one photograph its quarters lie a pixel higher or lower in turn."""
    first, *others = scene().views
    image = first.image_srgb.copy()
    rows, columns = (side // 2 for side in image.shape[:2])
    for vertical, horizontal, shift in ((0, 0, 1), (0, 1, -1), (1, 0, -1), (1, 1, 1)):
        part = np.s_[
            vertical * rows : (vertical + 1) * rows, horizontal * columns : (horizontal + 1) * columns
        ]
        image[part] = np.roll(first.image_srgb, shift, axis=0)[part]
    views = (replace(first, image_srgb=image), *others)
    refined = refine_cameras(views, true_region(), measured(views), device=CPU)
    assert refined.cameras is None
    assert "does not mend it" in refined.decision.because


def test_cameras_move_no_further_than_patches_are_sought(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera_refinement, "_LARGEST_MOVE_PX", 0.2)
    views = with_cameras(scene().views, jittered(scene().cameras, 0.4))
    refined = refine_cameras(views, true_region(), measured(views), device=CPU)
    assert refined.cameras is None
    assert "but to mend it" in refined.decision.because


def test_without_points_nothing_is_said() -> None:
    points = measured(scene().views)
    points = replace(points, confidence=np.zeros_like(points.confidence))
    refined = refine_cameras(scene().views, true_region(), points, device=CPU)
    assert refined.cameras is None
    assert "too few patches" in refined.decision.because


def test_a_camera_that_shares_nothing_does_no_harm() -> None:
    views = with_cameras(scene().views, jittered(scene().cameras, 0.4))
    views = (*views[:2], replace(views[2], image_srgb=np.full_like(views[2].image_srgb, 0.5)))
    refined = refine_cameras(views, true_region(), measured(views), device=CPU)
    assert refined.cameras is not None
    assert (
        largest_move_px([views[2].camera], refined.cameras[2:], sightings_between(scene().cameras).positions)
        < 4
    )


class OnAppleGpu(torch.Tensor):
    """A tensor that can be made float64 only where it has come to the CPU."""

    @classmethod
    def __torch_function__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if function in (torch.Tensor.double, torch.Tensor.to) or (kwargs or {}).get("dtype") == torch.float64:
            raise TypeError("Cannot convert a MPS Tensor to float64 dtype")
        result = super().__torch_function__(function, types, args, kwargs or {})
        return result.as_subclass(torch.Tensor) if function is torch.Tensor.cpu else result


def test_numbers_leave_a_device_that_knows_no_float64() -> None:
    parts = [torch.zeros((0, 2)).as_subclass(OnAppleGpu), torch.ones((3, 2)).as_subclass(OnAppleGpu)]
    joined = camera_refinement._float64(parts)
    np.testing.assert_array_equal(joined, np.ones((3, 2)), strict=True)


def test_moves_are_measured_in_pixels() -> None:
    camera = scene().cameras[0]
    shifted = replace(camera, cx_px=camera.cx_px + 3.0, cy_px=camera.cy_px - 4.0)
    points = np.random.default_rng(0).normal(size=(20, 3))
    assert largest_move_px([camera, camera], [camera, shifted], points) == pytest.approx(5.0)


def counting_stereo(seen: list[tuple[View, ...]]) -> Callable[..., StereoResult]:
    def match_views(views: tuple[View, ...], **_others: object) -> StereoResult:
        seen.append(views)
        return StereoResult(points=measured(views), depth_maps=())

    return match_views


@pytest.mark.parametrize(
    ("estimated", "size_px", "num_runs", "num_decisions"),
    [(False, 0.4, 1, 0), (True, 0.0, 1, 1), (True, 0.4, 2, 1)],
)
def test_stereo_is_done_again_where_cameras_were_refined_alone(
    estimated: bool, size_px: float, num_runs: int, num_decisions: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With given cameras it is done once, whatever they are."""
    runs: list[tuple[View, ...]] = []
    monkeypatch.setattr(matching, "match_views", counting_stereo(runs))
    views = with_cameras(scene().views, jittered(scene().cameras, size_px))
    solved = replace(scene().solved(), views=views, estimated=estimated)
    result = match_solved(solved, true_region(), StereoConfig(), device=CPU, progress=no_progress)
    assert len(runs) == num_runs
    assert len(result.decisions) == num_decisions
    used = with_refined(solved, result)
    assert (used is solved) == (num_runs == 1)
    for last, kept in zip(runs[-1], used.views, strict=True):
        np.testing.assert_array_equal(last.camera.camera_from_world, kept.camera.camera_from_world)
