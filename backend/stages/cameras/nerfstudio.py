"""nerfstudio's transforms.json, read and written; each is the other's inverse.

Poses are camera-to-world with OpenGL's camera axes. The frame they stand in is the world: `applied_transform`
and `applied_scale` tell how they came from others and are no part of them. Intrinsics may stand at the top,
for all frames, or in a frame. Distortion is told by k1, k2, p1 ... and camera_model. Lenses that nerfstudio
has no words for are written with COLMAP's, as `colmap_params`: other programs then refuse them rather than
take them for something else.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image  # noqa: F401 - pycolmap loaded before Pillow corrupts memory when Pillow next saves
import pycolmap
from jaxtyping import Float64

from ...errors import ErrorCode, ReconstructionError
from ...scene import Lens, Photo, Region, SolvedCameras, View
from .lenses import FISHEYE_TERMS, PERSPECTIVE_TERMS, colmap_lens

CAMERAS = "cameras.json"
"""What a finished run leaves of its cameras."""
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Camera axes: OpenGL has y up and looks along -z. Its own inverse."""

_PINHOLE_PARAMS = ("fl_x", "fl_y", "cx", "cy")
_COLMAP_PARAMS = "colmap_params"

_LARGEST_SIDE_PX = 1_000_000
"""More is a slip of the pen, and soon more than pycolmap can hold."""

Frame = Mapping[str, Any]
"""One frame's entries over those at the top of the file."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """What FewView's own cameras.json says of cameras that it estimated."""

    reprojection_error_px: float | None
    why_unplaced: Mapping[str, str]
    """By the name of each photograph that could not be placed."""


def estimate_or_none(frames: Sequence[Frame]) -> Estimate | None:
    """What `transforms_json` left in the file; None where the cameras come from elsewhere, or were given."""
    ours = frames[0].get("fewview") if frames else None
    if not isinstance(ours, dict) or ours.get("estimated") is not True:
        return None
    error_px, unplaced = ours.get("reprojection_error_px"), ours.get("unplaced")
    entries = [entry for entry in unplaced if isinstance(entry, dict)] if isinstance(unplaced, list) else []
    return Estimate(
        reprojection_error_px=error_px if isinstance(error_px, float) and math.isfinite(error_px) else None,
        why_unplaced={str(entry.get("name")): str(entry.get("why")) for entry in entries},
    )


def is_ours(frames: Sequence[Frame]) -> bool:
    """Whether they are of a file that `transforms_json` made."""
    return any("fewview" in frame for frame in frames)


def read_frames(path: Path) -> list[Frame]:
    """The frames of the file. Raises ReconstructionError(CAMERAS_UNUSABLE)."""
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
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


def world_from_camera(frame: Frame, photo_name: str) -> Float64[np.ndarray, "4 4"]:
    """The frame's pose for our camera axes, as written: not checked to be a rotation with a position."""
    try:
        matrix = np.array(frame["transform_matrix"], np.float64)
    except (ValueError, TypeError) as error:
        raise _unusable(f"The camera matrix of {photo_name} is no list of numbers.") from error
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise _unusable(f"The camera matrix of {photo_name} is not 4x4 finite numbers.")
    pose: Float64[np.ndarray, "4 4"] = matrix @ OPENCV_FROM_OPENGL
    return pose


def frame_lens(frame: Frame, photo: Photo) -> pycolmap.Camera:
    """The frame's lens over the image size given there, or else over the photograph's original size.

    Raises ReconstructionError(CAMERAS_UNUSABLE).
    """
    width = _number(frame, "w", photo, float(photo.original_width))
    height = _number(frame, "h", photo, float(photo.original_height))
    if min(width, height) < 1 or max(width, height) > _LARGEST_SIDE_PX:
        raise _unusable(f"The camera of {photo.name} is for {width:g}x{height:g} pixels.")
    model = str(frame.get("camera_model", "OPENCV")).upper()
    size = {"width": round(width), "height": round(height)}
    if _COLMAP_PARAMS in frame:
        return _colmap_lens(frame, model, photo, size)
    fx, fy = _focal_lengths(frame, photo, width, height)
    cx, cy = _number(frame, "cx", photo, width / 2), _number(frame, "cy", photo, height / 2)
    if frame.get("is_fisheye") is True or model in FISHEYE_TERMS:
        name, terms = "OPENCV_FISHEYE", FISHEYE_TERMS["OPENCV_FISHEYE"]
    elif model in PERSPECTIVE_TERMS:
        name, terms = "FULL_OPENCV", PERSPECTIVE_TERMS["FULL_OPENCV"]
    else:
        known = ", ".join(sorted(PERSPECTIVE_TERMS | FISHEYE_TERMS))
        raise _unusable(f"The camera model {model} of {photo.name} is not supported.", f"Known are {known}.")
    coefficients = {term: _number(frame, term, photo, 0.0) for term in terms}
    if name == "FULL_OPENCV" != model and coefficients["k4"] != 0:
        text = f"{photo.name} has a fourth distortion coefficient k4, which only fisheye lenses may have."
        raise _unusable(text, "Calibrate with k1, k2, k3, p1 and p2, or name the camera_model.")
    return pycolmap.Camera(model=name, params=[fx, fy, cx, cy, *coefficients.values()], **size)


def transforms_json(solved: SolvedCameras, region: Region) -> dict[str, Any]:
    """The cameras of the photographs as they are, with their lenses, as the content of a transforms.json.

    Given back with the same photographs it gives the same views. What other readers pass over stands under
    `fewview`: how good the cameras are, what was to be reconstructed, and who could not be placed.
    """
    frames = [_frame(view, lens) for view, lens in zip(solved.views, solved.lenses, strict=True)]
    models = {frame["camera_model"] for frame in frames}
    return {
        # nerfstudio itself looks for the model only here.
        "camera_model": models.pop() if len(models) == 1 else "PINHOLE",
        "fewview": {
            "estimated": solved.estimated,
            "reprojection_error_px": solved.reprojection_error_px,
            "region": {
                "centre_world": region.centre_world.tolist(),
                "radius_world": region.radius_world,
            },
            "unplaced": [asdict(photo) for photo in solved.unplaced],
        },
        "frames": frames,
    }


def _frame(view: View, lens: Lens) -> dict[str, Any]:
    """Inverse of frame_lens and world_from_camera."""
    colmap = colmap_lens(lens)
    focal_and_centre = (
        colmap.focal_length_x,
        colmap.focal_length_y,
        colmap.principal_point_x,
        colmap.principal_point_y,
    )
    terms = {**PERSPECTIVE_TERMS, **FISHEYE_TERMS}.get(lens.model)
    if terms is None:
        distortion: dict[str, Any] = {_COLMAP_PARAMS: list(lens.params)}
    else:
        distortion = dict(zip(terms, lens.params[len(lens.params) - len(terms) :], strict=True))
    world_from_camera = np.linalg.inv(view.camera.camera_from_world)
    return {
        "file_path": view.name,
        "camera_model": lens.model,
        "w": lens.width,
        "h": lens.height,
        **dict(zip(_PINHOLE_PARAMS, focal_and_centre, strict=True)),
        **distortion,
        "transform_matrix": (world_from_camera @ OPENCV_FROM_OPENGL).tolist(),
    }


def _colmap_lens(frame: Frame, model: str, photo: Photo, size: dict[str, int]) -> pycolmap.Camera:
    """The lens in COLMAP's own words."""
    values = frame[_COLMAP_PARAMS]
    plain = isinstance(values, list) and all(type(value) in (int, float) for value in values)
    if not plain or model not in set(pycolmap.CameraModelId.__members__) - {"INVALID"}:
        raise _unusable(f"The lens of {photo.name} is none of COLMAP's models with its parameters.")
    lens = pycolmap.Camera(model=model, params=values, **size)
    if not lens.verify_params() or not lens.is_perspective():
        raise _unusable(f"The lens of {photo.name} has too few or too many parameters for a {model} lens.")
    return lens


def _focal_lengths(frame: Frame, photo: Photo, width: float, height: float) -> tuple[float, float]:
    """In pixels: fl_x and fl_y, or from the field of view; one of them counts for both."""
    fx = _focal_length(frame, "x", photo, width)
    fy = _focal_length(frame, "y", photo, height)
    if fx == 0 and fy == 0:
        raise _unusable(f"The camera of {photo.name} has no focal length.", "Add fl_x, or camera_angle_x.")
    return fx or fy, fy or fx


def _focal_length(frame: Frame, axis: str, photo: Photo, side_px: float) -> float:
    """Along one axis, in pixels; 0 where the frame does not tell."""
    focal = _number(frame, f"fl_{axis}", photo, 0.0)
    angle = _number(frame, f"camera_angle_{axis}", photo, 0.0)
    return side_px / 2 / math.tan(angle / 2) if focal == 0 != angle else focal


def _number(frame: Frame, key: str, photo: Photo, default: float) -> float:
    value = frame.get(key)
    if value is None:
        return default
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise _unusable(f"The camera of {photo.name} has {key} = {value}, which is not a finite number.")
    return float(value)


def _unusable(
    text: str, remedy: str = "Check that the cameras belong to these photographs."
) -> ReconstructionError:
    return ReconstructionError(ErrorCode.CAMERAS_UNUSABLE, text, remedy)
