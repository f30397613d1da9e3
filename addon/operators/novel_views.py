"""Step 5: a finished job rendered from Blender's cameras, by the backend."""

import re
from collections.abc import Sequence
from pathlib import Path

import bpy
from bpy.props import StringProperty

from ...backend.wire.client import backend_command
from ...backend.wire.protocol import Finished
from .. import jobs, undo_step
from ..arguments import absolute, argument, fill_in
from ..camera_lens import pinhole_of, world_from_camera
from ..camera_objects import JOB, selected_cameras
from ..frames import world_from_result
from ..job_folder import LOG, can_be_rendered, inside, new_folder, results_in
from ..placing import solved_from_camera
from ..properties import IN_BLEND, settings_of
from ..result_mesh import result_or_none
from ..scenes import has_camera, object_or_none
from ..solved import SolvedCamera, write_cameras
from ..view_rendering import IMAGES, TRANSFORMS
from .environment import backend_python_or_reason, reason_against_a_job
from .on_result import OnResult, Status, has_result, refused, result_of
from .polling import speaks_nothing_against

_LONGEST_NAME = 60
"""Letters, of up to four bytes each."""


class FEWVIEW_OT_render_novel_views(OnResult, bpy.types.Operator):
    """Draw the result in the photographs' colors, as the selected cameras, or else the scene's, see it"""

    bl_idname = "fewview.render_novel_views"
    bl_label = "Render from Cameras"

    cameras: StringProperty(
        name="Cameras",
        description="Names, one a line; the selected cameras, or else the scene's, where this is empty",
        options={"SKIP_SAVE"},
    )
    device: argument("device")
    output: StringProperty(
        name="Output",
        description="Folder in which the pictures get their own; that of the job where this is empty",
        subtype="DIR_PATH",
        options={"SKIP_SAVE", *IN_BLEND},
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Not twice at once, not without a backend, and not without a job and cameras."""
        if not has_result(cls, context):
            return False
        reason = reason_against_a_job(context)
        if not reason and not can_be_rendered(_folder_of(result_or_none(context))):
            reason = "The files of the job are gone: reconstruct again"
        if not reason and not has_camera(context.scene):
            reason = "Add a camera first"
        return speaks_nothing_against(cls, reason)

    def execute(self, context: bpy.types.Context) -> Status:
        """Write the cameras and start; without a window, wait for the end."""
        fill_in(self, settings_of(context), {"device": "device"})
        python, reason = backend_python_or_reason(context)
        try:
            if python is None:
                raise ValueError(reason)
            result = result_of(context, self.object_name)
            job = _folder_of(result)
            cameras = _as_the_job_has_them(context, _cameras(context, self.cameras), result, job)
            folder = new_folder(Path(absolute(self.output)) if self.output else job, "novel-views")
            write_cameras(folder / TRANSFORMS, cameras)
            _start(python, job, folder, self.device)
        except (ValueError, jobs.JobError, OSError) as error:
            return refused(self, error)
        return jobs.follow(self)


def _folder_of(result: bpy.types.Object | None) -> Path:
    """Of the job that made it."""
    return Path(str(result.get(JOB, "")) if result is not None else "")


def _cameras(context: bpy.types.Context, names: str) -> list[bpy.types.Object]:
    """Those of the names, one a line, or else the selected ones, or else the scene's. Raises ValueError."""
    found = []
    for name in filter(None, map(str.strip, names.splitlines())):
        made = object_or_none(context.scene, name)
        if made is None or made.type != "CAMERA":
            raise ValueError(f"There is no camera {name} in the scene")
        found.append(made)
    found = found or selected_cameras(context.view_layer)
    active = context.scene.camera
    if not found and (active is None or active.type != "CAMERA"):
        raise ValueError("No camera is selected, and the scene has none: select those to render from")
    return found or [active]


def _as_the_job_has_them(
    context: bpy.types.Context, cameras: Sequence[bpy.types.Object], result: bpy.types.Object, job: Path
) -> list[SolvedCamera]:
    """The cameras in the job's frame, as they see the result where it is now.

    Raises ValueError for cameras that are no pinholes, and where the result is no job's or was deformed.
    """
    if not can_be_rendered(job):
        raise ValueError(f"The files of {result.name} are gone: reconstruct again")
    world_from_solved = world_from_result(result, job)
    found: list[SolvedCamera] = []
    for camera in cameras:
        pinhole, world = pinhole_of(context.scene, camera), world_from_camera(camera)
        try:
            pose = solved_from_camera(world_from_solved, world)
        except ValueError as error:
            raise ValueError(f"{result.name} cannot be rendered: {error}") from error
        name = _file_name(camera.name, [one.name for one in found])
        found.append(SolvedCamera(name=name, world_from_camera=pose, pinhole=pinhole))
    return found


def _file_name(camera: str, taken: Sequence[str]) -> str:
    """Of the camera's picture: file systems know fewer letters than Blender, and not all know their case.

    Nor do they know names of 255 bytes with an ending.
    """
    stem, number = re.sub(r"[^\w-]", "_", camera)[:_LONGEST_NAME], 1
    name = f"{IMAGES}/{stem}.png"
    while name.casefold() in map(str.casefold, taken):
        number += 1
        name = f"{IMAGES}/{stem}_{number}.png"
    return name


def _start(python: Path, job: Path, folder: Path, device: str) -> None:
    """Start the backend on the folder's cameras. Raises JobError where it cannot be started."""

    def on_finished(message: Finished) -> jobs.Steps:
        for name in message.files:
            bpy.data.images.load(str(inside(folder, Path(message.output) / name)))
            yield
        running, number = jobs.running(), len(message.files)
        if running is not None:
            pictures = "1 picture" if number == 1 else f"{number} pictures"
            running.notes.append(f"{pictures} in the list of the Image Editor and in {folder / IMAGES}")
        undo_step.push("Render from Cameras")

    words = ("--cameras", str(folder / TRANSFORMS), "--output", str(folder / IMAGES), "--device", device)
    jobs.start(
        "Rendering novel views",
        backend_command(python, "render", str(inside(job, results_in(job))), *words, "--wire"),
        folder=folder,
        log_path=folder / LOG,
        on_finished=on_finished,
        remedy=f"The pictures are in {folder / IMAGES}.",
    )


CLASSES = (FEWVIEW_OT_render_novel_views,)
