"""nerfstudio's transforms.json, read and written.

Poses are camera-to-world with OpenGL's camera axes. The frame they stand in is the world: `applied_transform`
and `applied_scale` tell how they came from others and are no part of them. Intrinsics may stand at the top,
for all frames, or in a frame.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image  # noqa: F401 - pycolmap loaded before Pillow corrupts memory when Pillow next saves
import pycolmap
from jaxtyping import Float64

from ..errors import ErrorCode, ReconstructionError
from ..scene import Photo, SolvedCameras

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Camera axes: OpenGL has y up and looks along -z. Its own inverse."""

_FISHEYE_MODELS = frozenset({"OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"})
_PERSPECTIVE_MODELS = frozenset({"PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"})

Frame = Mapping[str, Any]
"""One frame's entries over those at the top of the file."""


def read_frames(path: Path) -> list[Frame]:
    """The frames of the file. Raises ReconstructionError(CAMERAS_UNUSABLE)."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        shared = {key: value for key, value in content.items() if key != "frames"}
        frames: list[Frame] = [{**shared, **frame} for frame in content["frames"]]
    except (OSError, ValueError, AttributeError, TypeError, KeyError) as error:
        text = f"{path.name} is no nerfstudio file: it has no list of frames ({error})."
        raise _unusable(text, "Export it again.") from error
    for number, frame in enumerate(frames):
        missing = {"file_path", "transform_matrix"} - frame.keys()
        if missing:
            raise _unusable(f"Frame {number} of {path.name} has no {missing.pop()}.", "Export it again.")
    return frames


def camera_from_world(frame: Frame, photo_name: str) -> Float64[np.ndarray, "4 4"]:
    """The frame's pose in our camera axes, as written: not checked to be a rotation."""
    try:
        matrix = np.array(frame["transform_matrix"], np.float64)
    except (ValueError, TypeError) as error:
        raise _unusable(f"The camera matrix of {photo_name} is no list of numbers.") from error
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise _unusable(f"The camera matrix of {photo_name} is not 4x4 finite numbers.")
    if abs(np.linalg.det(matrix)) < 1e-12:
        raise _unusable(f"The camera matrix of {photo_name} is singular.")
    inverse: Float64[np.ndarray, "4 4"] = OPENCV_FROM_OPENGL @ np.linalg.inv(matrix)
    return inverse


def frame_lens(frame: Frame, photo: Photo) -> pycolmap.Camera:
    """The frame's lens over the image size given there, or else over the photograph's original size.

    Raises ReconstructionError(CAMERAS_UNUSABLE).
    """
    width = _number(frame, "w", photo, float(photo.original_width))
    height = _number(frame, "h", photo, float(photo.original_height))
    fx, fy = _focal_lengths(frame, photo, width, height)
    cx, cy = _number(frame, "cx", photo, width / 2), _number(frame, "cy", photo, height / 2)
    k1, k2, k3, k4, p1, p2 = (_number(frame, key, photo, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    model = str(frame.get("camera_model", "OPENCV")).upper()
    if model in _FISHEYE_MODELS or frame.get("is_fisheye") is True:
        name, params = "OPENCV_FISHEYE", [fx, fy, cx, cy, k1, k2, k3, k4]
    elif model not in _PERSPECTIVE_MODELS:
        known = ", ".join(sorted(_PERSPECTIVE_MODELS | _FISHEYE_MODELS))
        raise _unusable(f"The camera model {model} of {photo.name} is not supported.", f"Known are {known}.")
    elif k4 != 0:
        text = f"{photo.name} has a fourth distortion coefficient k4, which only fisheye lenses may have."
        raise _unusable(text, "Calibrate with k1, k2, k3, p1 and p2, or name the camera_model.")
    elif k3 != 0:
        name, params = "FULL_OPENCV", [fx, fy, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
    elif any((k1, k2, p1, p2)):
        name, params = "OPENCV", [fx, fy, cx, cy, k1, k2, p1, p2]
    else:
        name, params = "PINHOLE", [fx, fy, cx, cy]
    return pycolmap.Camera(model=name, width=round(width), height=round(height), params=params)


def transforms_json(solved: SolvedCameras) -> dict[str, Any]:
    """The views' cameras as the content of a transforms.json, for the undistorted photographs."""
    frames = []
    for view in solved.views:
        camera = view.camera
        world_from_camera = np.linalg.inv(camera.camera_from_world)
        frames.append(
            {
                "file_path": view.name,
                "w": camera.width,
                "h": camera.height,
                "fl_x": camera.fx_px,
                "fl_y": camera.fy_px,
                "cx": camera.cx_px,
                "cy": camera.cy_px,
                "transform_matrix": (world_from_camera @ OPENCV_FROM_OPENGL).tolist(),
            }
        )
    return {"camera_model": "PINHOLE", "frames": frames}


def _focal_lengths(frame: Frame, photo: Photo, width: float, height: float) -> tuple[float, float]:
    """In pixels: fl_x and fl_y, or from the field of view; one of them counts for both."""
    fx = _number(frame, "fl_x", photo, 0.0)
    fy = _number(frame, "fl_y", photo, 0.0)
    if fx == 0 and "camera_angle_x" in frame:
        fx = width / 2 / math.tan(_number(frame, "camera_angle_x", photo, 0.0) / 2)
    if fy == 0 and "camera_angle_y" in frame:
        fy = height / 2 / math.tan(_number(frame, "camera_angle_y", photo, 0.0) / 2)
    if fx == 0 and fy == 0:
        raise _unusable(f"The camera of {photo.name} has no focal length.", "Add fl_x, or camera_angle_x.")
    return fx or fy, fy or fx


def _number(frame: Frame, key: str, photo: Photo, default: float) -> float:
    value = frame.get(key)
    if value is None:
        return default
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise _unusable(f"The camera of {photo.name} has {key} = {value}, which is no usable number.")
    return float(value)


def _unusable(
    text: str, remedy: str = "Check that the cameras belong to these photographs."
) -> ReconstructionError:
    return ReconstructionError(ErrorCode.CAMERAS_UNUSABLE, text, remedy)
