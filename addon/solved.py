"""Cameras in files: those that the backend found, in its cameras.json, and those that it is given; no Blender
needed.

The file is nerfstudio's transforms.json with one object more, "fewview". It is read as one that a stranger
may have written: every number is checked before anything is made from it.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .intrinsics import Pinhole

LARGEST_FILE_BYTES = 10_000_000
MOST_CAMERAS = 1000
LARGEST_LENGTH = 1e9
"""As in the wire's protocol."""
LARGEST_SIDE_PX = 100_000
LONGEST_TEXT = 1000
_ROTATION_TOLERANCE = 1e-4


@dataclass(frozen=True, kw_only=True)
class SolvedCamera:
    """A picture and the camera that took it, without lens distortion."""

    name: str
    """Of the picture."""
    world_from_camera: NDArray[np.float64]
    """(4, 4), a rotation and a translation; camera axes as in OpenGL and Blender."""
    pinhole: Pinhole


@dataclass(frozen=True, kw_only=True)
class SolvedScene:
    """What is known after cameras and region were found."""

    cameras: tuple[SolvedCamera, ...]
    estimated: bool
    """Whether the world frame is the backend's own choice: no true size, place or up."""
    region_centre: tuple[float, float, float] | None
    region_radius: float | None
    unplaced: tuple[tuple[str, str], ...]
    """Photographs without a camera, and why."""
    reprojection_error_px: float | None

    @property
    def poses(self) -> NDArray[np.float64]:
        """(cameras, 4, 4): world_from_camera of all."""
        return np.stack([camera.world_from_camera for camera in self.cameras])


def read_solved(path: Path) -> SolvedScene:
    """The scene of a file. Raises ValueError with a sentence where it cannot be read or holds nonsense."""
    try:
        with path.open("rb") as file:
            data = file.read(LARGEST_FILE_BYTES + 1)
    except OSError as error:
        raise ValueError(f"{path} cannot be read ({error.strerror or error})") from error
    if len(data) > LARGEST_FILE_BYTES:
        raise ValueError(f"{path.name} is too large to hold cameras")
    try:
        content = json.loads(data.decode("utf-8"))
    except (ValueError, RecursionError) as error:  # no text, no JSON, a number of thousands of digits
        raise ValueError(f"{path.name} is no JSON file ({error})") from error
    try:
        return _scene(content)
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from error


def write_cameras(path: Path, cameras: Sequence[SolvedCamera]) -> None:
    """Write a transforms.json that `read_solved` reads again; another file of this name is replaced."""
    part = path.with_suffix(".part")
    content = {"camera_model": "PINHOLE", "frames": [_frame(camera) for camera in cameras]}
    part.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    part.replace(path)


def _frame(camera: SolvedCamera) -> dict[str, Any]:
    pinhole = camera.pinhole
    return {
        "file_path": camera.name,
        "w": pinhole.width,
        "h": pinhole.height,
        "fl_x": pinhole.fx_px,
        "fl_y": pinhole.fy_px,
        "cx": pinhole.cx_px,
        "cy": pinhole.cy_px,
        "transform_matrix": camera.world_from_camera.tolist(),
    }


def _scene(content: object) -> SolvedScene:
    file = _object(content, "the file")
    frames = _list(file.get("frames"), "frames", MOST_CAMERAS)
    if not frames:
        raise ValueError("there are no cameras")
    # Intrinsics may stand at the top for all frames.
    shared = {key: value for key, value in file.items() if key != "frames"}
    cameras = tuple(_camera({**shared, **_object(frame, "a frame")}) for frame in frames)
    if len({camera.name for camera in cameras}) < len(cameras):
        raise ValueError("two cameras have the same name")
    ours = _object(file.get("fewview", {}), "fewview")
    region = None if ours.get("region") is None else _object(ours["region"], "region")
    error_px = ours.get("reprojection_error_px")
    return SolvedScene(
        cameras=cameras,
        estimated=ours.get("estimated") is True,
        region_centre=None if region is None else _centre(region.get("centre_world")),
        region_radius=None if region is None else _radius(region.get("radius_world")),
        unplaced=tuple(_unplaced(entry) for entry in _list(ours.get("unplaced", []), "unplaced")),
        reprojection_error_px=None if error_px is None else _number(error_px, "reprojection_error_px"),
    )


def _camera(frame: dict[str, Any]) -> SolvedCamera:
    name = _text(frame.get("file_path"), "file_path")
    try:
        return SolvedCamera(name=name, world_from_camera=_pose(frame), pinhole=_pinhole(frame))
    except ValueError as error:
        raise ValueError(f"the camera of {name}: {error}") from error


def _pose(frame: dict[str, Any]) -> NDArray[np.float64]:
    rows = _list(frame.get("transform_matrix"), "transform_matrix", 4)
    if len(rows) != 4 or any(len(_list(row, "transform_matrix", 4)) != 4 for row in rows):
        raise ValueError("transform_matrix is not 4x4")
    matrix = np.array([[_number(value, "transform_matrix") for value in row] for row in rows], np.float64)
    rotation = matrix[:3, :3]
    if (
        np.abs(rotation @ rotation.T - np.eye(3)).max() > _ROTATION_TOLERANCE
        or np.linalg.det(rotation) < 0
        or not np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0])
    ):
        raise ValueError("transform_matrix is no rotation with a translation")
    return matrix


def _pinhole(frame: dict[str, Any]) -> Pinhole:
    width, height = _side(frame.get("w"), "w"), _side(frame.get("h"), "h")
    fx, fy = _number(frame.get("fl_x"), "fl_x"), _number(frame.get("fl_y"), "fl_y")
    if min(fx, fy) <= 0:
        raise ValueError("the focal length is not positive")
    cx, cy = _number(frame.get("cx"), "cx"), _number(frame.get("cy"), "cy")
    return Pinhole(fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy, width=width, height=height)


def _side(value: object, name: str) -> int:
    side = _number(value, name)
    if side != round(side) or not 1 <= side <= LARGEST_SIDE_PX:
        raise ValueError(f"{name} is {value}, which is no size of a picture")
    return round(side)


def _centre(value: object) -> tuple[float, float, float]:
    numbers = [_number(item, "centre_world") for item in _list(value, "centre_world", 3)]
    if len(numbers) != 3:
        raise ValueError("centre_world is not three numbers")
    return numbers[0], numbers[1], numbers[2]


def _radius(value: object) -> float:
    radius = _number(value, "radius_world")
    if radius < 1 / LARGEST_LENGTH:
        raise ValueError(f"the radius of the region is {radius}")
    return radius


def _unplaced(value: object) -> tuple[str, str]:
    entry = _object(value, "an entry of unplaced")
    return _text(entry.get("name"), "name"), _text(entry.get("why"), "why")


def _number(value: object, name: str) -> float:
    """A finite number that is not too large; JSON's true is none."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name} is {str(value)[:40]!r} and not a number")
    if not abs(value) <= LARGEST_LENGTH:  # also for NaN
        raise ValueError(f"{name} is {str(value)[:40]}, which is not a finite number of a sensible size")
    return float(value)


def _text(value: object, name: str) -> str:
    if not isinstance(value, str) or not value.isprintable() or not 1 <= len(value) <= LONGEST_TEXT:
        raise ValueError(f"{name} is {str(value)[:40]!r} and no usable text")
    return value


def _list(value: object, name: str, most: int = MOST_CAMERAS) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError(f"{name} is no list")
    if len(value) > most:
        raise ValueError(f"{name} has {len(value)} entries, {most} at most are possible")
    return value


def _object(value: object, name: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{name} is no JSON object")
    return value
