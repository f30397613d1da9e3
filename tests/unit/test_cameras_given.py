"""Cameras from files: round trips, name matching, refusals."""

import json
import re
import unicodedata
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image  # noqa: F401 - before pycolmap
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from backend.errors import ErrorCode, ReconstructionError
from backend.mesh_files import write_sparse
from backend.scene import Photo, Region, SolvedCameras, Unplaced, no_progress, to_unit_sphere
from backend.stages.cameras.copies import copies_apart_text
from backend.stages.cameras.known_cameras import checked_pose, match_by_name, read_cameras
from backend.stages.cameras.nerfstudio import OPENCV_FROM_OPENGL, frame_lens, transforms_json
from backend.stages.cameras.solving import CamerasConfig, solve_cameras
from tests.lens_models import LENSES

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


REGION = Region(object_from_world=to_unit_sphere(np.array([1.0, -2.0, 3.0]), 4.0))
PHOTOS = [make_photo("a.jpg"), make_photo("b.jpg"), make_photo("c.jpg")]
FRAMES = [make_frame("a.jpg", 1), make_frame("b.jpg", 2), make_frame("c.jpg", 3)]


def test_transforms_are_read_as_they_were_written(tmp_path: Path) -> None:
    first = solve_frames(PHOTOS, {"frames": FRAMES}, tmp_path)
    again = solve_frames(PHOTOS, transforms_json(first, REGION), tmp_path)
    assert [view.name for view in first.views] == ["a.jpg", "b.jpg", "c.jpg"]
    assert not first.estimated
    assert first.unplaced == ()
    assert first.sparse_positions.shape == (0, 3)
    assert first.sparse_visibility.shape == (0, 3)
    for view, other, photo in zip(first.views, again.views, PHOTOS, strict=True):
        np.testing.assert_allclose(view.camera.camera_from_world, other.camera.camera_from_world, atol=1e-12)
        np.testing.assert_allclose(view.camera.intrinsics, other.camera.intrinsics)
        np.testing.assert_array_equal(view.image_srgb, photo.image_srgb)


WITHOUT_WORDS = [name for name in LENSES if re.search("FOV|PRISM|DIVISION|EUCM", name)]
"""Models that nerfstudio's files cannot say."""


def test_no_lens_model_is_forgotten() -> None:
    known = set(pycolmap.CameraModelId.__members__) - {"INVALID", "EQUIRECTANGULAR"}
    assert known == LENSES.keys()


@pytest.mark.parametrize("model", LENSES)
def test_cameras_given_back_make_the_same_views(model: str, tmp_path: Path) -> None:
    """From a COLMAP model measured on other sizes than the photograph's and the working size."""
    photos = [replace(photo, original_width=203, original_height=152) for photo in PHOTOS]
    first = solve(photos, colmap_model(tmp_path, model), tmp_path)
    again = solve_frames(photos, transforms_json(first, REGION), tmp_path)
    assert again.lenses == first.lenses
    assert {(lens.width, lens.height) for lens in first.lenses} == {(203, 152)}
    for view, other in zip(first.views, again.views, strict=True):
        np.testing.assert_allclose(
            other.camera.camera_from_world, view.camera.camera_from_world, rtol=1e-9, atol=1e-12
        )
        np.testing.assert_array_equal(other.camera.intrinsics, view.camera.intrinsics)
        np.testing.assert_array_equal(other.image_srgb, view.image_srgb)


@pytest.mark.parametrize("model", LENSES)
def test_without_photographs_cameras_are_read_as_with_them(model: str, tmp_path: Path) -> None:
    """From a COLMAP model and from a transforms.json, of photographs as large as they say."""
    blank = np.zeros((120, 160, 3), np.float32)
    sizes = {"image_srgb": blank, "original_width": 160, "original_height": 120}
    solved = solve([replace(photo, **sizes) for photo in PHOTOS], colmap_model(tmp_path, model), tmp_path)
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(transforms_json(solved, REGION)))
    for given in (tmp_path / "colmap", path):
        cameras = read_cameras(given)
        assert [name for name, _ in cameras] == [view.name for view in solved.views]
        for (_, camera), view in zip(cameras, solved.views, strict=True):
            np.testing.assert_allclose(camera.camera_from_world, view.camera.camera_from_world, atol=1e-12)
            np.testing.assert_allclose(camera.intrinsics, view.camera.intrinsics, rtol=1e-12)
            assert (camera.width, camera.height) == (160, 120)


@pytest.mark.parametrize("sides", [{"w": None}, {"h": "48"}, {"w": 0}, {"w": 1e9}])
def test_without_photographs_the_file_has_to_tell_their_size(sides: dict[str, Any], tmp_path: Path) -> None:
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"frames": [make_frame("a.jpg", **sides)]}))
    with pytest.raises(ReconstructionError) as caught:
        read_cameras(path)
    assert caught.value.code == ErrorCode.CAMERAS_UNUSABLE
    assert "images/a.jpg" in caught.value.text


@pytest.mark.parametrize("model", LENSES)
def test_the_file_says_what_the_lens_does(model: str, tmp_path: Path) -> None:
    """The lens that is read projects as the one the file was made from, at the photograph's size."""
    photos = [make_photo(photo.name, scale=2.5) for photo in PHOTOS]
    first = solve(photos, colmap_model(tmp_path, model), tmp_path)
    (frame, *_) = transforms_json(first, REGION)["frames"]
    read = frame_lens(frame, photos[0])
    lens = pycolmap.Camera(model=model, width=160, height=120, params=LENSES[model])
    rays = np.add(np.random.default_rng(0).uniform(-0.4, 0.4, (50, 3)), [0, 0, 1])
    np.testing.assert_allclose(read.img_from_cam(rays), lens.img_from_cam(rays), atol=1e-9)
    assert (frame["w"], frame["h"]) == (160, 120)
    assert frame["fl_x"] == pytest.approx(lens.focal_length_x)
    assert ("colmap_params" in frame) is (model in WITHOUT_WORDS), "only where nerfstudio has no words"


def test_a_panorama_is_refused(tmp_path: Path) -> None:
    """It has no focal length, and pycolmap crashes where it is asked for one."""
    photos = [make_photo(photo.name, scale=2.5) for photo in PHOTOS]
    with pytest.raises(ReconstructionError, match="panorama") as caught:
        solve(photos, colmap_model(tmp_path, "EQUIRECTANGULAR"), tmp_path)
    assert caught.value.code == ErrorCode.CAMERAS_UNUSABLE


def colmap_model(folder: Path, model: str) -> Path:
    """A text model with one lens and three poses for PHOTOS."""
    folder = folder / "colmap"
    folder.mkdir()
    params = " ".join(map(repr, LENSES.get(model, [160.0, 120.0])))
    (folder / "cameras.txt").write_text(f"1 {model} 160 120 {params}\n")
    lines = []
    for index, photo in enumerate(PHOTOS, start=1):
        x, y, z, w = Rotation.random(random_state=index).as_quat().tolist()
        lines.append(f"{index} {w!r} {x!r} {y!r} {z!r} 0.1 {index}.2 0.3 1 {photo.name}\n\n")
    (folder / "images.txt").write_text("".join(lines))
    (folder / "points3D.txt").write_text("")
    return folder


def test_the_file_tells_more_than_readers_need(tmp_path: Path) -> None:
    first = solve_frames(PHOTOS, {"frames": [FRAMES[0], FRAMES[2]]}, tmp_path)
    assert transforms_json(first, REGION)["fewview"] == {
        "estimated": False,
        "reprojection_error_px": None,
        "region": {"centre_world": pytest.approx([1.0, -2.0, 3.0]), "radius_world": pytest.approx(4.0)},
        "unplaced": [{"name": "b.jpg", "why": "no camera in transforms.json has its name"}],
    }


def estimated_before(tmp_path: Path) -> SolvedCameras:
    """Cameras of a.jpg and c.jpg as an earlier job estimated them, whose files lie in the folder."""
    rng = np.random.default_rng(0)
    found = replace(
        solve_frames(PHOTOS, {"frames": [FRAMES[0], FRAMES[2]]}, tmp_path),
        estimated=True,
        reprojection_error_px=0.4,
        unplaced=(Unplaced(name="b.jpg", why="it is blurred"),),
        sparse_positions=rng.normal(size=(30, 3)),
        sparse_visibility=np.ones((30, 2), bool),
    )
    (tmp_path / "cameras.json").write_text(json.dumps(transforms_json(found, REGION)))
    points, seen = found.sparse_positions, found.sparse_visibility
    colours = np.zeros((30, 3), np.uint8)
    write_sparse(tmp_path / "sparse.ply", positions=points, colours_srgb=colours, visibility=seen)
    return found


def test_cameras_that_were_estimated_stay_so_in_a_later_job(tmp_path: Path) -> None:
    first = estimated_before(tmp_path)
    again = solve(PHOTOS, tmp_path / "cameras.json", tmp_path)
    assert again.estimated
    assert again.reprojection_error_px == 0.4
    assert again.unplaced == first.unplaced
    np.testing.assert_array_equal(again.sparse_positions, first.sparse_positions)
    np.testing.assert_array_equal(again.sparse_visibility, first.sparse_visibility)
    for view, other in zip(first.views, again.views, strict=True):
        np.testing.assert_allclose(other.camera.camera_from_world, view.camera.camera_from_world, atol=1e-12)
    assert "cameras.json" in again.decisions[0].because


def test_the_folder_of_a_finished_run_gives_its_cameras(tmp_path: Path) -> None:
    found = estimated_before(tmp_path)
    (tmp_path / "transforms.json").unlink()
    again = solve(PHOTOS, tmp_path, tmp_path)
    assert again.estimated
    np.testing.assert_array_equal(again.sparse_positions, found.sparse_positions)
    assert [name for name, _ in read_cameras(tmp_path)] == ["a.jpg", "c.jpg"]
    (tmp_path / "cameras.json").unlink()
    with pytest.raises(ReconstructionError, match="There are no cameras in") as caught:
        solve(PHOTOS, tmp_path, tmp_path)
    assert "finished run" in caught.value.remedy


def test_points_that_two_of_fewer_photographs_see(tmp_path: Path) -> None:
    found = estimated_before(tmp_path)
    seen = np.ones((30, 3), bool)
    seen[:10, 0] = False
    cameras = transforms_json(solve_frames(PHOTOS, {"frames": FRAMES}, tmp_path), REGION)
    cameras["fewview"]["estimated"] = True
    (tmp_path / "cameras.json").write_text(json.dumps(cameras))
    points, colours = found.sparse_positions, np.zeros((30, 3), np.uint8)
    write_sparse(tmp_path / "sparse.ply", positions=points, colours_srgb=colours, visibility=seen)
    fewer = solve(PHOTOS[:2], tmp_path / "cameras.json", tmp_path)
    np.testing.assert_array_equal(fewer.sparse_positions, points[10:])
    assert fewer.sparse_visibility.shape == (20, 2)


def test_a_photograph_that_was_left_out_takes_no_namesake_s_camera(tmp_path: Path) -> None:
    photos = [replace(make_photo("a.jpg"), path=Path(folder) / "a.jpg") for folder in ("left", "right")]
    content = transforms_json(solve_frames(PHOTOS, {"frames": FRAMES}, tmp_path), REGION)
    content["fewview"] |= {"estimated": True, "unplaced": [{"name": "left/a.jpg", "why": "it is dark"}]}
    content["frames"][0]["file_path"] = "right/a.jpg"
    solved = solve_frames([*photos, PHOTOS[1]], content, tmp_path)
    assert [view.name for view in solved.views] == ["a.jpg", "b.jpg"]
    assert [photo.why for photo in solved.unplaced] == ["it is dark"]
    only_left = solve_frames([photos[0], *PHOTOS[1:]], content, tmp_path)
    assert [view.name for view in only_left.views] == ["b.jpg", "c.jpg"]


@pytest.mark.parametrize(
    "ours", [{"estimated": 1}, {"estimated": True, "unplaced": 3, "reprojection_error_px": "x"}, 7, None]
)
def test_words_of_others_under_our_name_do_no_harm(ours: object, tmp_path: Path) -> None:
    solved = solve_frames(PHOTOS, {"frames": FRAMES, "fewview": ours}, tmp_path)
    assert len(solved.views) == 3
    assert solved.reprojection_error_px is None
    assert solved.sparse_positions.shape == (0, 3)


def test_the_model_stands_at_the_top_where_all_share_it(tmp_path: Path) -> None:
    fisheye = [frame | {"camera_model": "OPENCV_FISHEYE"} for frame in FRAMES]
    for frames, model in (
        (FRAMES, "PINHOLE"),
        (fisheye, "OPENCV_FISHEYE"),
        ([FRAMES[0], fisheye[1]], "PINHOLE"),
    ):
        written = transforms_json(solve_frames(PHOTOS, {"frames": frames}, tmp_path), REGION)
        assert written["camera_model"] == model
    assert [frame["camera_model"] for frame in written["frames"]] == ["PINHOLE", "OPENCV_FISHEYE"]


@pytest.mark.parametrize(
    ("model", "params", "words"),
    [
        ("NONE", [1.0], "none of COLMAP's models"),
        ("INVALID", [1.0], "none of COLMAP's models"),
        ("FOV", "1", "none of COLMAP's models"),
        ("FOV", [100.0, 100.0, 30.0, 20.0, True], "none of COLMAP's models"),
        ("FOV", [1.0], "too few or too many"),
        ("EQUIRECTANGULAR", [64.0, 48.0], "too few or too many"),
        ("FOV", [100.0, 100.0, 30.0, 20.0, float("nan")], "not finite and positive"),
    ],
)
def test_colmap_s_words_are_checked(model: str, params: object, words: str, tmp_path: Path) -> None:
    frame = FRAMES[0] | {"camera_model": model, "colmap_params": params}
    with pytest.raises(ReconstructionError, match=words) as caught:
        solve_frames(PHOTOS, {"frames": [FRAMES[1], frame]}, tmp_path)
    assert caught.value.code == ErrorCode.CAMERAS_UNUSABLE
    assert "a.jpg" in caught.value.text


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
    assert solved.unplaced == (Unplaced(name="b.jpg", why="no camera in transforms.json has its name"),)


def test_a_copy_with_the_same_camera_is_left_out(tmp_path: Path) -> None:
    """It would weigh twice, and pass for one more photograph that confirms the others."""
    copy = replace(PHOTOS[1], name="x.jpg", path=Path("photos/x.jpg"))
    frames = [*FRAMES, make_frame("x.jpg", 2)]
    solved = solve_frames([*PHOTOS, copy], {"frames": frames}, tmp_path)
    assert [view.name for view in solved.views] == ["a.jpg", "b.jpg", "c.jpg"]
    assert solved.unplaced == (Unplaced(name="x.jpg", why="it is a copy of b.jpg"),)
    assert solved.sparse_visibility.shape == (0, 3)
    with pytest.raises(ReconstructionError, match="All 2 photographs are copies of one") as raised:
        solve_frames([PHOTOS[1], copy], {"frames": frames}, tmp_path)
    assert raised.value.code == ErrorCode.TOO_FEW_PHOTOS


def test_points_that_a_photograph_and_its_copy_alone_see_are_none(tmp_path: Path) -> None:
    found = estimated_before(tmp_path)
    photos = [PHOTOS[0], PHOTOS[1], replace(PHOTOS[0], name="x.jpg", path=Path("photos/x.jpg"))]
    frames = [make_frame("a.jpg", 1), make_frame("b.jpg", 2), make_frame("x.jpg", 1)]
    content = {"frames": frames, "fewview": transforms_json(found, REGION)["fewview"]}
    content["fewview"]["unplaced"] = []
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    seen, colours = np.ones((30, 3), bool), np.zeros((30, 3), np.uint8)
    seen[:10, 1] = False
    points = found.sparse_positions
    write_sparse(tmp_path / "sparse.ply", positions=points, colours_srgb=colours, visibility=seen)
    solved = solve(photos, tmp_path / "cameras.json", tmp_path)
    assert [one.name for one in solved.unplaced] == ["x.jpg"]
    np.testing.assert_array_equal(solved.sparse_positions, points[10:])
    assert solved.sparse_visibility.shape == (20, 2)


def test_a_copy_that_has_the_camera_alone_stays(tmp_path: Path) -> None:
    copy = replace(PHOTOS[2], name="c (1).jpg", path=Path("photos/c (1).jpg"))
    solved = solve_frames([*PHOTOS[:2], copy, PHOTOS[2]], {"frames": FRAMES}, tmp_path)
    assert [view.name for view in solved.views] == ["a.jpg", "b.jpg", "c.jpg"]
    assert [one.name for one in solved.unplaced] == ["c (1).jpg"]


def test_the_same_picture_of_cameras_that_stand_apart_is_told(tmp_path: Path) -> None:
    """As of a turned vase, or where a file was copied under another's name: which is right is not known."""
    copy = replace(PHOTOS[1], name="c.jpg", path=Path("photos/c.jpg"))
    solved = solve_frames([*PHOTOS[:2], copy], {"frames": FRAMES}, tmp_path)
    assert [view.name for view in solved.views] == ["a.jpg", "b.jpg", "c.jpg"]
    assert "b.jpg and c.jpg are the same picture" in copies_apart_text(solved.views)
    assert copies_apart_text(solve_frames(PHOTOS, {"frames": FRAMES}, tmp_path).views) == ""


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
        {"fl_x": None, "fl_y": 0, "camera_angle_x": None, "camera_angle_y": 0.0},
        {"w": -WIDTH, "h": -HEIGHT},
        {"w": 1e30 * WIDTH, "h": 1e30 * HEIGHT},
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
    assert [photo.name for photo in solved.unplaced] == ["other.jpg"]
    assert "has its name" in solved.unplaced[0].why
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


def test_names_with_blanks_in_a_text_model(tmp_path: Path) -> None:
    photos = [make_photo(f"my photo {photo.name}", scale=2.5) for photo in PHOTOS]
    folder = colmap_model(tmp_path, "PINHOLE")
    text = (folder / "images.txt").read_text()
    for photo in PHOTOS:
        text = text.replace(photo.name, f"sub dir/my photo {photo.name}")
    text = text.replace("\n\n", "\n1.5 2.5 -1 3.5 4.5 -1 5.5 6.5 -1 7.5 8.5 -1\n", 1)
    (folder / "images.txt").write_text(f"# images\n\n{text}")
    solved = solve(photos, folder, tmp_path)
    plain = solve([replace(photo, name=photo.name) for photo in photos], in_binary(folder, photos), tmp_path)
    assert [view.name for view in solved.views] == [photo.name for photo in photos]
    for view, other in zip(solved.views, plain.views, strict=True):
        np.testing.assert_array_equal(view.camera.camera_from_world, other.camera.camera_from_world)


def in_binary(folder: Path, photos: list[Photo]) -> Path:
    """The same model as COLMAP writes it by default, which keeps names whole."""
    model = pycolmap.Reconstruction(folder)
    for number, photo in enumerate(photos, start=1):
        model.images[number].name = photo.name
    binary = folder.with_name("binary")
    binary.mkdir()
    model.write_binary(binary)
    return binary


@pytest.mark.parametrize(("ours", "theirs"), [("NFC", "NFD"), ("NFD", "NFC")])
def test_accents_may_be_written_as_a_mac_does(ours: str, theirs: str) -> None:
    photo, camera = (unicodedata.normalize(form, "für/Öl.jpg") for form in (ours, theirs))
    assert match_by_name([photo], [camera]) == {0: 0}


def test_a_mark_of_the_byte_order_does_no_harm(tmp_path: Path) -> None:
    """As editors on Windows write it."""
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": FRAMES}), encoding="utf-8-sig")
    assert len(solve(PHOTOS, tmp_path, tmp_path).views) == 3


def test_a_damaged_colmap_model_is_refused(tmp_path: Path) -> None:
    for name in ["cameras", "images", "points3D"]:
        (tmp_path / f"{name}.txt").write_text("1 PINHOLE wide\n")
    with pytest.raises(ReconstructionError) as caught:
        solve(PHOTOS, tmp_path, tmp_path)
    assert caught.value.code == ErrorCode.CAMERAS_UNUSABLE


def test_axes_change_is_its_own_inverse() -> None:
    np.testing.assert_array_equal(OPENCV_FROM_OPENGL @ OPENCV_FROM_OPENGL, np.eye(4))
