"""Cameras from files: round trips, name matching, refusals."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image  # noqa: F401 - before pycolmap
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from backend.errors import ErrorCode, ReconstructionError
from backend.scene import Photo, SolvedCameras, no_progress
from backend.stages.cameras import CamerasConfig, solve_cameras
from backend.stages.known_cameras import checked_pose, match_by_name
from backend.stages.nerfstudio import OPENCV_FROM_OPENGL, transforms_json

WIDTH, HEIGHT = 64, 48


def make_photo(name: str, scale: float = 1.0) -> Photo:
    """A photograph whose file was `scale` times as large."""
    rng = np.random.default_rng(sum(name.encode()))
    return Photo(
        name=name,
        path=Path("photos") / name,
        image_srgb=rng.random((HEIGHT, WIDTH, 3), np.float32),
        mask=None,
        original_width=round(WIDTH * scale),
        original_height=round(HEIGHT * scale),
        focal_px=None,
    )


def random_pose(seed: int) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    pose[:3, 3] = np.random.default_rng(seed).normal(size=3)
    return pose


def make_frame(name: str, seed: int = 0, **changes: Any) -> dict[str, Any]:
    frame = {"file_path": f"images/{name}", "w": WIDTH, "h": HEIGHT, "fl_x": 60.0, "fl_y": 61.0}
    frame |= {"cx": 31.0, "cy": 25.0, "transform_matrix": random_pose(seed).tolist()}
    return frame | changes


def solve(photos: list[Photo], given: Path, tmp_path: Path) -> SolvedCameras:
    return solve_cameras(photos, given, CamerasConfig(), workdir=tmp_path, seed=0, progress=no_progress)


def solve_frames(photos: list[Photo], content: dict[str, Any], tmp_path: Path) -> SolvedCameras:
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(content))
    return solve(photos, path, tmp_path)


PHOTOS = [make_photo("a.jpg"), make_photo("b.jpg"), make_photo("c.jpg")]
FRAMES = [make_frame("a.jpg", 1), make_frame("b.jpg", 2), make_frame("c.jpg", 3)]


def test_transforms_are_read_as_they_were_written(tmp_path: Path) -> None:
    first = solve_frames(PHOTOS, {"frames": FRAMES}, tmp_path)
    again = solve_frames(PHOTOS, transforms_json(first), tmp_path)
    assert [view.name for view in first.views] == ["a.jpg", "b.jpg", "c.jpg"]
    assert not first.estimated
    assert first.unplaced == ()
    assert first.sparse_positions.shape == (0, 3)
    assert first.sparse_visibility.shape == (0, 3)
    for view, other, photo in zip(first.views, again.views, PHOTOS, strict=True):
        np.testing.assert_allclose(view.camera.camera_from_world, other.camera.camera_from_world, atol=1e-12)
        np.testing.assert_allclose(view.camera.intrinsics, other.camera.intrinsics)
        np.testing.assert_array_equal(view.image_srgb, photo.image_srgb)


def test_poses_are_camera_to_world_with_opengl_axes(tmp_path: Path) -> None:
    """A camera at (0, 0, 5) as OpenGL has it looks along -z, and sees +y above the middle."""
    pose = np.eye(4)
    pose[2, 3] = 5
    frames = [make_frame("a.jpg", transform_matrix=pose.tolist()), make_frame("b.jpg")]
    camera = solve_frames(PHOTOS, {"frames": frames}, tmp_path).views[0].camera
    np.testing.assert_allclose(camera.position, [0, 0, 5])
    in_camera = camera.camera_from_world @ [0.0, 1.0, 0.0, 1.0]
    np.testing.assert_allclose(in_camera, [0, -1, 5, 1])


def test_intrinsics_may_be_shared_and_are_scaled_to_the_photograph(tmp_path: Path) -> None:
    """The file speaks of 4 times the working size, the photograph had 2 times."""
    photos = [make_photo(name, scale=2.0) for name in ("a.jpg", "b.jpg")]
    shared = {"w": WIDTH * 4, "h": HEIGHT * 4, "fl_x": 240.0, "fl_y": 200.0, "cx": 120.0, "cy": 100.0}
    poses = [{"file_path": name, "transform_matrix": random_pose(3).tolist()} for name in ("a", "b")]
    poses[1] |= {"fl_x": 400.0}
    first, second = solve_frames(photos, {**shared, "frames": poses}, tmp_path).views
    np.testing.assert_allclose(first.camera.intrinsics, [[60, 0, 30], [0, 50, 25], [0, 0, 1]])
    assert second.camera.fx_px == pytest.approx(100), "the frame counts before the top"
    assert (first.camera.width, first.camera.height) == (WIDTH, HEIGHT)


def test_field_of_view_gives_the_focal_length(tmp_path: Path) -> None:
    frames = [
        {"file_path": f"./train/{name}", "transform_matrix": random_pose(3).tolist()} for name in ("a", "b")
    ]
    content = {"camera_angle_x": 2 * np.arctan(0.5), "frames": frames}
    camera = solve_frames(PHOTOS, content, tmp_path).views[0].camera
    assert camera.fx_px == pytest.approx(WIDTH)
    assert camera.fy_px == pytest.approx(WIDTH)
    assert (camera.cx_px, camera.cy_px) == (WIDTH / 2, HEIGHT / 2)


def test_applied_transform_is_no_part_of_the_poses(tmp_path: Path) -> None:
    plain = solve_frames(PHOTOS, {"frames": FRAMES}, tmp_path)
    told = solve_frames(
        PHOTOS, {"applied_transform": random_pose(9)[:3].tolist(), "frames": FRAMES}, tmp_path
    )
    for view, other in zip(plain.views, told.views, strict=True):
        np.testing.assert_array_equal(view.camera.camera_from_world, other.camera.camera_from_world)


def test_a_photograph_without_a_camera_is_left_out(tmp_path: Path) -> None:
    solved = solve_frames(PHOTOS, {"frames": [FRAMES[2], FRAMES[0]]}, tmp_path)
    assert [view.name for view in solved.views] == ["a.jpg", "c.jpg"]
    assert solved.unplaced == ("b.jpg",)


def test_names_match_by_case_stem_and_folder() -> None:
    photos = ["p/left/1.JPG", "p/right/1.jpg", "p/dotted.v2.png"]
    assert match_by_name(photos, ["right/1.jpg", "left/1.jpg", "x/dotted.v2"]) == {0: 1, 1: 0, 2: 2}
    assert match_by_name(["p/1.jpg"], ["10.jpg", "x1.jpg"]) == {}
    assert match_by_name(["p/1.png", "p/1.jpg"], ["1.jpg"]) == {1: 0}, "the extension decides"


def test_names_that_do_not_decide_are_refused() -> None:
    with pytest.raises(ReconstructionError, match=r"2 of the cameras could be that of 1\.jpg"):
        match_by_name(["p/1.jpg"], ["left/1.jpg", "right/1.jpg"])


def with_matrix(change: Callable[[np.ndarray], None]) -> dict[str, Any]:
    pose = random_pose(1)
    change(pose)
    return {"transform_matrix": pose.tolist()}


def scale_it(pose: np.ndarray) -> None:
    pose[:3, :3] *= 1.1


def mirror_it(pose: np.ndarray) -> None:
    pose[:3, 0] *= -1


def break_it(pose: np.ndarray) -> None:
    pose[0, 3] = np.nan


def flatten_it(pose: np.ndarray) -> None:
    pose[:3, :3] = 0


@pytest.mark.parametrize(
    "change",
    [
        with_matrix(scale_it),
        with_matrix(mirror_it),
        with_matrix(break_it),
        with_matrix(flatten_it),
        {"transform_matrix": [[1, 0], [0, 1]]},
        {"transform_matrix": "identity"},
        {"w": WIDTH, "h": HEIGHT - 6},
        {"w": HEIGHT, "h": WIDTH},
        {"fl_x": float("nan")},
        {"fl_x": "60"},
        {"fl_x": -60.0, "fl_y": -60.0},
        {"fl_x": None, "fl_y": None},
        {"camera_model": "EQUIRECTANGULAR"},
        {"k4": 0.1},
        {"k1": -9.0, "k2": -900.0},
    ],
)
def test_an_unusable_camera_is_refused_by_the_name_of_its_photograph(
    change: dict[str, Any], tmp_path: Path
) -> None:
    with pytest.raises(ReconstructionError) as caught:
        solve_frames(PHOTOS, {"frames": [FRAMES[1], FRAMES[0] | change]}, tmp_path)
    assert caught.value.code == ErrorCode.CAMERAS_UNUSABLE
    assert "a.jpg" in caught.value.text
    assert caught.value.remedy


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"frames": 3}', '{"frames": [{}]}', '{"frames": []}'])
def test_a_file_without_cameras_is_refused(content: str, tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text(content)
    for given in [tmp_path, tmp_path / "transforms.json", tmp_path / "nowhere"]:
        with pytest.raises(ReconstructionError) as caught:
            solve(PHOTOS, given, tmp_path)
        assert caught.value.code == ErrorCode.CAMERAS_UNUSABLE


def test_other_names_and_too_few_cameras_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ReconstructionError, match=r"x\.jpg there, a\.jpg here") as caught:
        solve_frames(PHOTOS, {"frames": [make_frame("x.jpg")]}, tmp_path)
    assert caught.value.code == ErrorCode.CAMERAS_UNUSABLE
    with pytest.raises(ReconstructionError) as caught:
        solve_frames(PHOTOS, {"frames": [make_frame("a.jpg")]}, tmp_path)
    assert caught.value.code == ErrorCode.TOO_FEW_PLACED


def test_poses_with_few_digits_become_rotations() -> None:
    pose = random_pose(4)
    rounded = pose.copy()
    rounded[:3, :3] = pose[:3, :3].round(3)
    exact = checked_pose(rounded, "a.jpg")
    np.testing.assert_allclose(exact[:3, :3] @ exact[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(exact, pose, atol=1e-3)


def synthetic_model() -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 4, 50
    options.camera_width, options.camera_height = WIDTH * 10, HEIGHT * 10
    options.camera_model_id = pycolmap.CameraModelId.PINHOLE
    options.camera_params = [600.0, 610.0, 310.0, 250.0]
    return pycolmap.synthesize_dataset(options)


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("below", ["", "sparse/0"])
def test_colmap_models_with_their_points(text: bool, below: str, tmp_path: Path) -> None:
    model = synthetic_model()
    folder = tmp_path / "model" / below
    folder.mkdir(parents=True)
    if text:
        model.write_text(folder)
    else:
        model.write_binary(folder)
    names = {image_id: model.images[image_id].name for image_id in model.reg_image_ids()}
    left_out, *photographed = sorted(names)
    photos = [make_photo(names[i], scale=10) for i in photographed] + [make_photo("other.jpg")]
    solved = solve(photos, tmp_path / "model", tmp_path)
    assert solved.unplaced == ("other.jpg",)
    assert solved.reprojection_error_px is None
    for view, image_id in zip(solved.views, photographed, strict=True):
        expected = model.images[image_id].cam_from_world().matrix()
        np.testing.assert_allclose(view.camera.camera_from_world[:3], expected, atol=1e-6)
        np.testing.assert_allclose(view.camera.intrinsics, [[60, 0, 31], [0, 61, 25], [0, 0, 1]])
    for number, image_id in enumerate(photographed):
        image = model.images[image_id]
        seen = [p.point3D_id for p in image.points2D if p.has_point3D()]
        assert solved.sparse_visibility[:, number].sum() == len(seen) > 0
        mean = np.mean([model.points3D[i].xyz for i in seen], axis=0)
        np.testing.assert_allclose(
            solved.sparse_positions[solved.sparse_visibility[:, number]].mean(axis=0), mean, atol=1e-6
        )
    assert left_out not in photographed


def test_a_damaged_colmap_model_is_refused(tmp_path: Path) -> None:
    for name in ["cameras", "images", "points3D"]:
        (tmp_path / f"{name}.txt").write_text("1 PINHOLE wide\n")
    with pytest.raises(ReconstructionError) as caught:
        solve(PHOTOS, tmp_path, tmp_path)
    assert caught.value.code == ErrorCode.CAMERAS_UNUSABLE


def test_axes_change_is_its_own_inverse() -> None:
    np.testing.assert_array_equal(OPENCV_FROM_OPENGL @ OPENCV_FROM_OPENGL, np.eye(4))
