"""Pictures of a finished job from any cameras: of its radiance field or, where it has none, of its mesh."""

import os
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image

from .errors import Cancelled, ErrorCode, ReconstructionError
from .machine import choose_device, set_up_torch
from .maths.raycast import RayCaster, render_mesh
from .mesh_files import read_mesh
from .records import load_record
from .results import RADIANCE, Writers
from .scene import Camera, Progress, within
from .stages.cameras.known_cameras import read_cameras
from .stages.cameras.nerfstudio import CAMERAS
from .stages.published.radiance_field import restored
from .stages.published.radiance_image import RadianceImage, radiance_image
from .stages.radiance import Radiance
from .wire.protocol import is_path
from .workspace import open_workspace

Pixels = UInt8[np.ndarray, "height width channels"]
Draw = Callable[[Camera, Progress], Pixels]
_LONGEST_NAME = 255
"""Of a file, in bytes, on the usual disks."""


def render_job(job: Path, cameras: Path, output: Path, device: str, progress: Progress) -> tuple[str, ...]:
    """One PNG in `output` for each of the cameras, named after its frame; their names.

    All appear together at the end, in place of those of an earlier rendering. Raises Cancelled where
    progress does, and ReconstructionError: SETTINGS_INVALID where `job` is no finished job, CAMERAS_UNUSABLE,
    OUTPUT_UNUSABLE.
    """
    draw = _drawing(job, device)
    named = _by_file_name(read_cameras(cameras))
    if (output / CAMERAS).exists():
        raise ReconstructionError(
            ErrorCode.OUTPUT_UNUSABLE,
            f"{output} holds the results of a reconstruction.",
            "Choose a new or empty output folder.",
        )
    writers: Writers = {}
    for number, (name, camera) in enumerate(named.items()):
        tell = within(progress, number / len(named), (number + 1) / len(named))
        writers[name] = partial(_write, draw=draw, camera=camera, progress=_named(tell, name))
    with open_workspace(output) as workspace:
        try:
            workspace.claim("pictures")
            workspace.write_results(writers, replaced=workspace.results)
        except (ReconstructionError, Cancelled):
            workspace.discard_if_nothing_done()
            raise
    return tuple(writers)


def _write(path: Path, *, draw: Draw, camera: Camera, progress: Progress) -> None:
    Image.fromarray(draw(camera, progress)).save(path)


def _named(progress: Progress, name: str) -> Progress:
    return lambda share, _: progress(share, name)


def _by_file_name(cameras: tuple[tuple[str, Camera], ...]) -> dict[str, Camera]:
    """Cameras by the names of their pictures."""
    named: dict[str, Camera] = {}
    for frame, camera in cameras:
        name = _file_name(frame)
        if name in named:
            text = f"Two of the cameras would be rendered to {name}."
            raise ReconstructionError(ErrorCode.CAMERAS_UNUSABLE, text, "Give each frame a name of its own.")
        named[name] = camera
    return named


def _file_name(frame: str) -> str:
    """Of a frame's picture: digits behind a dot are its number, not what it is written as."""
    last = PurePosixPath(frame.replace("\\", "/")).name
    name = re.sub(r"\.\D\w*$", "", last) + ".png"
    if name == ".png" or not is_path(name) or len(os.fsencode(name)) > _LONGEST_NAME:
        text = f"No picture can be named after the frame {frame[:80]!r}."
        raise ReconstructionError(
            ErrorCode.CAMERAS_UNUSABLE, text, "Give it a shorter name of letters and digits."
        )
    return name


def _drawing(job: Path, device_kind: str) -> Draw:
    """What the job left, ready to be drawn."""
    try:
        if (job / RADIANCE).is_file():
            return _radiance_drawing(load_record(job / RADIANCE, Radiance), device_kind)
        if (job / "mesh.ply").is_file():
            return _mesh_drawing(job / "mesh.ply")
    except ValueError as error:  # RecordUnreadable, MeshFileError, or parameters of another shape
        text = f"What {job} holds cannot be read ({error})."
        remedy = "Run the reconstruction again with this version of FewView."
        raise ReconstructionError(ErrorCode.SETTINGS_INVALID, text, remedy) from error
    text = f"There is nothing to render in {job}: neither {RADIANCE} nor mesh.ply."
    raise ReconstructionError(
        ErrorCode.SETTINGS_INVALID, text, "Give the output folder of a finished reconstruction."
    )


def _radiance_drawing(radiance: Radiance, device_kind: str) -> Draw:
    device = choose_device(device_kind)
    set_up_torch(device)
    field = restored(radiance, device)

    def draw(camera: Camera, progress: Progress) -> Pixels:
        image = radiance_image(field, radiance, camera, device=device, progress=progress)
        return _bytes(image.colour_srgb if radiance.background_srgb is not None else _cut_out(image))

    return draw


def _cut_out(image: RadianceImage) -> Float32[np.ndarray, "height width 4"]:
    """With alpha, and colours as they are where it is 1: not darkened by the black behind."""
    opacity = image.opacity[..., None]
    colour = image.colour_srgb / np.where(opacity > 0, opacity, np.float32(1))
    return np.concatenate([colour, opacity], axis=-1)


def _mesh_drawing(path: Path) -> Draw:
    mesh = read_mesh(path)
    caster = RayCaster(mesh.vertices, mesh.faces)

    def draw(camera: Camera, progress: Progress) -> Pixels:
        progress(0.0, "drawing")
        image = render_mesh(mesh, camera, caster=caster)
        return _bytes(np.dstack([image.colour_srgb, image.coverage.astype(np.float32)]))

    return draw


def _bytes(image: Float32[np.ndarray, "height width channels"]) -> Pixels:
    return (255 * image.clip(0, 1) + 0.5).astype(np.uint8)
