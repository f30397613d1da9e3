"""Step 2: estimate the cameras, show them, look through them."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import bpy
from bpy.props import StringProperty

from ...backend.wire.client import backend_command
from ...backend.wire.photographs import is_named
from ...backend.wire.protocol import PROTOCOL_VERSION, Job
from .. import camera_objects, jobs, undo_step
from ..arguments import absolute, argument, fill_in
from ..job_folder import LOG, RESULT, FolderError, folder_for, read_job_file, write_job
from ..properties import IN_BLEND, settings_of
from ..scenes import reason_against_changes, scene_name_of, scene_named
from .environment import backend_python_or_reason
from .images import used_images
from .polling import speaks_nothing_against
from .reconstruct import jobs_parent


class FEWVIEW_OT_estimate_cameras(bpy.types.Operator):
    """Find where the photographs were taken, or read their known cameras, and show them in the scene"""

    bl_idname = "fewview.estimate_cameras"
    bl_label = "Estimate Cameras"

    images: StringProperty(
        name="Photographs",
        description="Folder of photographs; those of the list where this is empty",
        subtype="DIR_PATH",
        options={"SKIP_SAVE", *IN_BLEND},
    )
    camera_source: argument("camera_source")
    cameras_path: argument("cameras_path")
    masks: argument("masks")
    preset: argument("preset")
    device: argument("device")
    seed: argument("seed")
    output: argument("output")

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """A backend, no other job, and a scene that takes the cameras."""
        reason = reason_against_changes(context.scene)
        if not reason and jobs.running() is not None:
            reason = "Wait for the running job, or cancel it"
        return speaks_nothing_against(cls, reason or backend_python_or_reason(context)[1])

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Start the backend."""
        same = ("camera_source", "cameras_path", "masks", "preset", "device", "seed")
        fill_in(self, settings_of(context), {name: name for name in same})
        python, reason = backend_python_or_reason(context)
        try:
            if python is None:
                raise ValueError(reason)
            job = self._job(context)
            folder = folder_for(jobs_parent(context, self.output), job)
            jobs.start(
                "Loading cameras" if job.cameras else "Estimating cameras",
                backend_command(python, "reconstruct", str(write_job(folder, job))),
                folder=folder,
                log_path=folder / LOG,
                on_finished=partial(_on_finished, context.scene.session_uid, folder),
                remedy="Press Estimate Cameras again.",
            )
        except (ValueError, OSError, jobs.JobError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return jobs.follow(self)

    def _job(self, context: bpy.types.Context) -> Job:
        """Raises ValueError where there is nothing to find cameras of."""
        folder = bpy.path.abspath(self.images)
        images = (Path(folder).absolute(),) if folder else used_images(settings_of(context))
        if not images:
            raise ValueError("There are no photographs: add some in step 1")
        known = self.camera_source == "KNOWN"
        if known and not self.cameras_path:
            raise ValueError("There is no file of known cameras: choose one, or let the cameras be estimated")
        return Job(
            protocol=PROTOCOL_VERSION,
            images=tuple(str(path) for path in images),
            output=RESULT,
            cameras=absolute(self.cameras_path) if known else None,
            masks=absolute(self.masks) if self.masks else None,
            preset=self.preset,
            device=self.device,
            seed=self.seed,
            until="cameras",
            keep_stages=False,
        )


class FEWVIEW_OT_import_cameras(bpy.types.Operator):
    """Show the cameras, photographs and points that a job has found, in place of an earlier import's"""

    bl_idname = "fewview.import_cameras"
    bl_label = "Import Cameras"
    bl_options = {"REGISTER", "UNDO"}

    folder: StringProperty(
        name="Job Folder",
        description="Folder of the job; that of the last cameras where this is empty",
        subtype="DIR_PATH",
        options={"SKIP_SAVE", *IN_BLEND},
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """A scene that takes them."""
        return speaks_nothing_against(cls, reason_against_changes(context.scene))

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Import all at once."""
        chosen = self.folder or settings_of(context).cameras_job
        try:
            if not chosen:
                raise ValueError("There is no job folder: choose one, or estimate the cameras first")
            warnings: list[str] = []
            for _ in show_cameras(context.scene.name, Path(absolute(chosen)), warnings):
                pass
        except (ValueError, RuntimeError) as error:
            self.report({"ERROR"}, f"The cameras cannot be imported: {error}")
            return {"CANCELLED"}
        for text in warnings:
            self.report({"WARNING"}, text)
        return {"FINISHED"}


class FEWVIEW_OT_remove_cameras(bpy.types.Operator):
    """Remove the imported cameras and points; photographs, meshes and your own objects stay"""

    bl_idname = "fewview.remove_cameras"
    bl_label = "Remove Cameras"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """There must be some."""
        if not camera_objects.jobs_of(context.scene):
            cls.poll_message_set("There are no imported cameras")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove those of all jobs."""
        for job in camera_objects.jobs_of(context.scene):
            camera_objects.remove(context.scene, job)
        return {"FINISHED"}


class FEWVIEW_OT_show_photograph(bpy.types.Operator):
    """Look through the camera of the list's active photograph; the scene takes over its resolution"""

    bl_idname = "fewview.show_photograph"
    bl_label = "Show Photograph"
    bl_options = {"REGISTER", "UNDO"}

    photograph: StringProperty(
        name="Photograph",
        description="Its file, or the end of the path; the active one of the list where this is empty",
        options={"SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """There must be cameras to look through."""
        if not camera_objects.cameras_with_photographs(context.scene):
            cls.poll_message_set("Estimate the cameras first")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Make it the scene's camera and turn the viewport to it."""
        scene, settings = context.scene, settings_of(context)
        name = self.photograph
        if not name and 0 <= settings.active_image < len(settings.images):
            name = bpy.path.abspath(settings.images[settings.active_image].path)
        try:
            camera = camera_objects.camera_of_photograph(scene, name)
            if camera is None:
                missing = f"{Path(name).name} has no camera: choose another photograph"
                raise ValueError(missing if name else "Choose a photograph")
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        scene.camera = camera
        width, height = camera.get(camera_objects.SIZE, (0, 0))
        if width and height:
            scene.render.resolution_x, scene.render.resolution_y = int(width), int(height)
            scene.render.resolution_percentage = 100
        _look_through(context)
        return {"FINISHED"}


def show_cameras(scene_name: str, folder: Path, warnings: list[str]) -> Iterator[None]:
    """Import a job's cameras in steps for a timer; what the user should know is added to the warnings.

    Pushes no undo step. Raises ValueError for files that cannot be used.
    """
    wanted = camera_objects.read_import(folder, _photographs(folder, scene_name))
    yield
    yield from camera_objects.import_steps(scene_name, wanted, warnings)
    settings = scene_named(scene_name).fewview
    settings.cameras_job = str(folder)
    for image in settings.images:
        path = Path(bpy.path.abspath(image.path))
        why = next((why for name, why in wanted.solved.unplaced if is_named(path, name)), "")
        image.problem = why or image.problem
    warnings += [f"{name} could not be placed: {why}" for name, why in wanted.solved.unplaced]
    warnings += camera_objects.problems(wanted)


def _on_finished(scene_uid: int, folder: Path, _: object) -> Iterator[None]:
    warnings: list[str] = []
    yield from show_cameras(scene_name_of(scene_uid), folder, warnings)
    jobs.warn(warnings)
    undo_step.push("Estimate Cameras")


def _photographs(folder: Path, scene_name: str) -> tuple[Path, ...]:
    """The job's photographs, or those of the list where the job's file does not say."""
    try:
        return tuple(folder / image for image in read_job_file(folder).images)
    except FolderError:
        return used_images(scene_named(scene_name).fewview)


def _look_through(context: bpy.types.Context) -> None:
    """Turn the viewport that was clicked in, or else every viewport of the window, to the scene's camera."""
    areas = [context.area] if context.area is not None else []
    if not areas or areas[0].type != "VIEW_3D":
        areas = list(context.screen.areas) if context.screen is not None else []
    for area in areas:
        if area.type == "VIEW_3D" and area.spaces.active.region_3d is not None:
            area.spaces.active.region_3d.view_perspective = "CAMERA"


CLASSES = (
    FEWVIEW_OT_estimate_cameras,
    FEWVIEW_OT_import_cameras,
    FEWVIEW_OT_remove_cameras,
    FEWVIEW_OT_show_photograph,
)
