"""cameras.json as the backend writes it comes in whole, and nothing else comes in."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from addon.intrinsics import Pinhole
from addon.solved import LARGEST_FILE_BYTES, MOST_CAMERAS, SolvedCamera, read_solved, write_cameras
from addon.view_layout import world_from_camera_looking_at

POSE = world_from_camera_looking_at(np.array([1.0, -5.0, 2.0]), np.zeros(3))


def frame(name: str, **changes: Any) -> dict[str, Any]:
    lens = {"w": 640, "h": 480, "fl_x": 700.0, "fl_y": 710.0, "cx": 321.0, "cy": 239.5, "k1": 0.1}
    return {"file_path": name, **lens, "transform_matrix": POSE.tolist(), **changes}


def content(**changes: Any) -> dict[str, Any]:
    ours = {
        "estimated": True,
        "reprojection_error_px": 0.4,
        "region": {"centre_world": [1, 2.0, 3.0], "radius_world": 0.5},
        "unplaced": [{"name": "c.jpg", "why": "It shows nothing"}],
    }
    frames = [frame("a.jpg"), frame("b.jpg")]
    return {"camera_model": "OPENCV", "frames": frames, "fewview": ours, **changes}


@pytest.fixture
def write(tmp_path: Path) -> Callable[[object], Path]:
    def write(value: object) -> Path:
        path = tmp_path / "cameras.json"
        path.write_text(value if isinstance(value, str) else json.dumps(value), encoding="utf-8")
        return path

    return write


def test_everything_in_the_file_comes_in(write: Callable[[object], Path]) -> None:
    scene = read_solved(write(content()))
    assert [camera.name for camera in scene.cameras] == ["a.jpg", "b.jpg"]
    np.testing.assert_array_equal(scene.poses, [POSE, POSE])
    lens = Pinhole(fx_px=700, fy_px=710, cx_px=321, cy_px=239.5, width=640, height=480)
    assert scene.cameras[0].pinhole == lens
    assert (scene.estimated, scene.reprojection_error_px) == (True, 0.4)
    assert (scene.region_centre, scene.region_radius) == ((1.0, 2.0, 3.0), 0.5)
    assert scene.unplaced == (("c.jpg", "It shows nothing"),)


def test_what_is_written_comes_in_again(tmp_path: Path) -> None:
    lens = Pinhole(fx_px=700, fy_px=710.5, cx_px=321, cy_px=239.5, width=640, height=480)
    written = [
        SolvedCamera(name=f"{n}.png", world_from_camera=n * POSE + (1 - n) * np.eye(4), pinhole=lens)
        for n in (0, 1)
    ]
    write_cameras(tmp_path / "transforms.json", written)
    scene = read_solved(tmp_path / "transforms.json")
    assert [(camera.name, camera.pinhole) for camera in scene.cameras] == [("0.png", lens), ("1.png", lens)]
    np.testing.assert_array_equal(scene.poses, [np.eye(4), POSE])
    assert [path.name for path in tmp_path.iterdir()] == ["transforms.json"]


def test_a_plain_transforms_json_has_cameras_alone(write: Callable[[object], Path]) -> None:
    shared = {key: value for key, value in frame("").items() if key not in {"file_path", "transform_matrix"}}
    short = {"file_path": "a.jpg", "transform_matrix": POSE.tolist()}
    scene = read_solved(write({**shared, "frames": [short]}))
    assert scene.cameras[0].pinhole.fx_px == 700
    assert not scene.estimated
    assert (scene.region_centre, scene.region_radius, scene.unplaced) == (None, None, ())
    assert scene.reprojection_error_px is None


MIRROR = (POSE @ np.diag([-1.0, 1, 1, 1])).tolist()
SCALED = (POSE @ np.diag([2.0, 2, 2, 1])).tolist()
PROJECTIVE = [*POSE.tolist()[:3], [0, 0, 1, 1]]


@pytest.mark.parametrize(
    ("hostile", "message"),
    [
        ("not json", "no JSON"),
        ("[" * 100_000, "no JSON"),
        ("1" * 5000, "no JSON"),
        ([], "the file is no JSON object"),
        ({}, "frames is no list"),
        (content(frames=[]), "no cameras"),
        (content(frames=[frame(str(i)) for i in range(MOST_CAMERAS + 1)]), "at most"),
        (content(frames=[3]), "a frame is no JSON object"),
        (content(frames=[frame("a"), frame("a")]), "same name"),
        (content(frames=[frame("")]), "file_path"),
        (content(frames=[frame("x" * 2000)]), "file_path"),
        (content(frames=[frame("\ud800")]), "file_path"),
        (content(frames=[frame("a", fl_x="700")]), "the camera of a: fl_x .* not a number"),
        (content(frames=[frame("a", fl_x=True)]), "fl_x .* not a number"),
        (content(frames=[frame("a", fl_x=float("nan"))]), "fl_x .* not a finite"),
        (content(frames=[frame("a", fl_y=float("inf"))]), "fl_y .* not a finite"),
        (content(frames=[frame("a", fl_y=-700.0)]), "not positive"),
        (content(frames=[frame("a", cx=1e300)]), "cx .* not a finite"),
        (content(frames=[frame("a", cx=10**400)]), "cx"),
        (content(frames=[frame("a", w=0)]), "w is 0"),
        (content(frames=[frame("a", h=10**6)]), "h is"),
        (content(frames=[frame("a", w=1.5)]), "w is 1.5"),
        (content(frames=[frame("a", transform_matrix=POSE.tolist()[:3])]), "4x4"),
        (content(frames=[frame("a", transform_matrix=[[1.0], 2, 3, 4])]), "4x4|no list"),
        (content(frames=[frame("a", transform_matrix=MIRROR)]), "no rotation"),
        (content(frames=[frame("a", transform_matrix=SCALED)]), "no rotation"),
        (content(frames=[frame("a", transform_matrix=PROJECTIVE)]), "no rotation"),
        (content(fewview=3), "fewview is no JSON object"),
        (content(fewview={"region": {"centre_world": [1, 2], "radius_world": 1}}), "three numbers"),
        (content(fewview={"region": {"centre_world": [1, 2, 3], "radius_world": 0}}), "radius"),
        (content(fewview={"unplaced": [{"name": "a"}]}), "why"),
        (content(fewview={"unplaced": "a"}), "unplaced is no list"),
        (content(fewview={"reprojection_error_px": "much"}), "reprojection_error_px"),
    ],
)
def test_hostile_files_are_refused(write: Callable[[object], Path], hostile: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_solved(write(hostile))


def test_files_that_are_missing_too_large_or_no_text_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    with pytest.raises(ValueError, match="cannot be read"):
        read_solved(path)
    path.write_bytes(b"\xff\xfe{}")
    with pytest.raises(ValueError, match="no JSON"):
        read_solved(path)
    with path.open("wb") as file:
        file.truncate(LARGEST_FILE_BYTES + 1)
    with pytest.raises(ValueError, match="too large"):
        read_solved(path)
