"""Step 4: start, cancel, and what the job says."""

import os
from collections.abc import Sequence
from pathlib import Path

import bpy
from bpy.props import FloatVectorProperty, StringProperty

from ...backend.wire.client import backend_command, clean_environment
from ...backend.wire.environment import OFFLINE
from ...backend.wire.photographs import photographs_in
from ...backend.wire.protocol import PROTOCOL_VERSION, Finished, Job
from .. import jobs
from ..arguments import absolute, argument, fill_in
from ..frames import chosen_job_or_none, world_from_solved_or_none
from ..job_folder import (
    CAMERAS,
    LOG,
    RESULT,
    PastJob,
    folder_for,
    read_job_file,
    results_in,
    write_job,
)
from ..mesh_import import MeshImport, remove_preview, show_preview
from ..preferences import preferences_of
from ..properties import FEWVIEW_PG_settings, settings_of
from ..region import region_of
from ..report_text import report_text
from ..result_import import import_result_steps, show_estimated_cameras
from ..scenes import reason_against_changes, scene_name_of, scene_named
from ..solved import read_solved
from ..state_lines import FEWEST_IMAGES
from .environment import backend_python_or_reason, reason_against_a_job
from .images import used_images
from .polling import speaks_nothing_against

_LOG_TEXT = "fewview_log"
"""Custom property of the text block with the log."""
IN_PAST_JOBS = "Past Jobs in step 5 has the result, or start again."
"""Where it is if it could not be shown."""


def jobs_parent(context: bpy.types.Context, given: str = "") -> Path:
    """Folder in which jobs get folders of their own.

    In this order: given, the scene's, beside the .blend, the preferences'.
    """
    chosen = given or settings_of(context).output
    if chosen and (bpy.data.filepath or not chosen.startswith("//")):  # else // is where Blender was started
        return Path(bpy.path.abspath(chosen)).absolute()
    if bpy.data.filepath:
        return Path(bpy.data.filepath).parent / "fewview"
    return Path(preferences_of(context).output).expanduser().absolute()


def cameras_for(settings: FEWVIEW_PG_settings, images: Sequence[Path]) -> str | None:
    """The cameras file of the job: given, or that of an earlier job of all these images; None to find them.

    Raises ValueError where a file is wanted and none is chosen.
    """
    if settings.camera_source == "KNOWN":
        if not settings.cameras_path:
            raise ValueError("No file with known cameras is chosen: choose one in step 2, or Estimate")
        return absolute(settings.cameras_path)
    folder = chosen_job_or_none(settings)
    if folder is None:
        return None
    path = results_in(folder) / CAMERAS
    try:
        read_solved(path)
        looked_at = photographs_of(folder)
    except (ValueError, OSError):
        return None  # the user has moved or removed it: they are found again
    return str(path) if {path.absolute() for path in images} <= looked_at else None


def photographs_of(folder: Path) -> set[Path]:
    """The files that a job looked at. Raises FolderError where job.json is gone, OSError where they are."""
    found: set[Path] = set()
    for source in (folder / image for image in read_job_file(folder).images):
        found.update(photographs_in(source) if source.is_dir() else [source])
    return {path.absolute() for path in found}


class FEWVIEW_OT_reconstruct(bpy.types.Operator):
    """Make a mesh from the photographs; Blender stays usable meanwhile"""

    bl_idname = "fewview.reconstruct"
    bl_label = "Reconstruct"
    bl_options = {"REGISTER"}

    images: StringProperty(
        name="Images",
        description="Folders or files, one a line; the list of the panel where this is empty",
        options={"SKIP_SAVE"},
    )
    cameras: StringProperty(
        name="Cameras",
        description="File or folder of known cameras; as step 2 says where this is empty",
        options={"SKIP_SAVE"},
    )
    masks: argument("masks")
    preset: argument("preset")
    cut_out: argument("cut_out")
    without_ground: argument("without_ground")
    device: argument("device")
    seed: argument("seed")
    truth: argument("truth")
    output: argument("output")
    region: FloatVectorProperty(
        name="Region",
        description="Centre and radius of what is reconstructed, in the frame of the cameras",
        size=4,
        options={"SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Not twice at once, not without a backend, and not into a scene that takes no mesh."""
        reason = reason_against_changes(context.scene) or reason_against_a_job(context)
        return speaks_nothing_against(cls, reason)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Start; without a window, wait for the end."""
        of_files = () if self.images else ("masks", "truth")
        same = ("preset", "cut_out", "without_ground", "device", "seed", *of_files)
        fill_in(self, settings_of(context), {name: name for name in same})
        python, reason = backend_python_or_reason(context)
        try:
            if python is None:
                raise ValueError(reason)
            asked = self._job(context)
            folder = folder_for(jobs_parent(context, self.output), asked)
            start(python, folder, asked, scene_name=context.scene.name)
        except (ValueError, jobs.JobError, OSError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return jobs.follow(self)

    def _job(self, context: bpy.types.Context) -> Job:
        """Raises ValueError with the remedy where something is missing."""
        settings = settings_of(context)
        if self.images:
            images = tuple(Path(absolute(line.strip())) for line in self.images.splitlines() if line.strip())
        else:
            images = used_images(settings)
            if len(images) < FEWEST_IMAGES:
                raise ValueError("There are too few photographs: add at least two in step 1")
        cameras = absolute(self.cameras) if self.cameras else None
        if cameras is None and not self.images:
            cameras = cameras_for(settings, images)
        centre, radius = self._region(context, cameras)
        return Job(
            protocol=PROTOCOL_VERSION,
            images=tuple(str(path) for path in images),
            output=RESULT,
            cameras=cameras,
            masks=absolute(self.masks) if self.masks else None,
            preset=self.preset,
            device=self.device,
            seed=self.seed,
            truth=absolute(self.truth) if self.truth else None,
            region_centre=centre,
            region_radius=radius,
            cut_out=self.cut_out,
            without_ground=self.without_ground,
            keep_stages=False,
        )

    def _region(
        self, context: bpy.types.Context, cameras: str | None
    ) -> tuple[tuple[float, ...] | None, float | None]:
        if self.properties.is_property_set("region"):
            return tuple(self.region[:3]), self.region[3]
        sphere = None if self.images else region_of(context.scene, cameras)
        return (None, None) if sphere is None else (tuple(map(float, sphere[0])), float(sphere[1]))


def start(python: Path, folder: Path, asked: Job, *, scene_name: str) -> None:
    """Start the backend on the job in the folder; its mesh comes into the scene at the end.

    Raises JobError where it cannot be started.
    """
    path = write_job(folder, asked)
    job = PastJob(folder=folder, job=asked)
    uid = scene_named(scene_name).session_uid
    estimated = True
    warnings: list[str] = []

    def on_preview(shown: Path) -> jobs.Steps:
        nonlocal estimated
        scene_name = scene_name_of(uid)
        if shown.suffix == ".json":
            estimated = read_solved(shown).estimated
            yield from show_estimated_cameras(shown, job, scene_name, warnings)
            jobs.warn(warnings)
            return
        frame = world_from_solved_or_none(scene_named(scene_name), job, estimated=estimated)
        if frame is not None:
            wanted = MeshImport(job=str(folder), scene_name=scene_name, world_from_solved=frame)
            yield from show_preview(shown, wanted)

    def on_finished(_: Finished) -> jobs.Steps:
        undo = not bpy.app.background
        yield from import_result_steps(folder, scene_name=scene_name_of(uid), undo=undo, warnings=warnings)
        jobs.warn(warnings)

    jobs.start(
        "Reconstructing",
        backend_command(python, "reconstruct", str(path)),
        folder=folder,
        log_path=folder / LOG,
        on_finished=on_finished,
        on_preview=on_preview,
        on_end=remove_preview,
        remedy=IN_PAST_JOBS,
        environment=None if bpy.app.online_access else {**clean_environment(os.environ), OFFLINE: "1"},
    )


class FEWVIEW_OT_cancel(bpy.types.Operator):
    """Stop the running job; what is finished of it is kept on disk"""

    bl_idname = "fewview.cancel"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """Something must run."""
        job = jobs.running()
        if job is None or job.cancelling:
            cls.poll_message_set("Nothing is running" if job is None else "It is stopping already")
            return False
        return True

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """Ask it to stop."""
        jobs.cancel()
        jobs.redraw()
        return {"FINISHED"}


class FEWVIEW_OT_show_log(bpy.types.Operator):
    """Open the log of the last job in a text editor"""

    bl_idname = "fewview.show_log"
    bl_label = "Show Log"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """There must be one."""
        if jobs.log_path() is None:
            cls.poll_message_set("No job has run yet")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Put the log into a text block, and into a window of its own where there is one."""
        text = next((made for made in bpy.data.texts if _LOG_TEXT in made), None)
        if text is None:  # by its mark: a text of that name may be the user's
            text = bpy.data.texts.new("FewView Log")
            text[_LOG_TEXT] = True
        text.from_string(report_text(context))
        if not bpy.app.background:
            bpy.ops.wm.window_new()
            area = context.window_manager.windows[-1].screen.areas[0]
            area.type = "TEXT_EDITOR"
            area.spaces.active.text = text
        return {"FINISHED"}


class FEWVIEW_OT_copy_report(bpy.types.Operator):
    """Copy what a developer needs to know about the last job"""

    bl_idname = "fewview.copy_report"
    bl_label = "Copy Report"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """To the clipboard."""
        context.window_manager.clipboard = report_text(context)
        self.report({"INFO"}, "The report is on the clipboard")
        return {"FINISHED"}


class FEWVIEW_OT_dismiss(bpy.types.Operator):
    """Show this no more"""

    bl_idname = "fewview.dismiss"
    bl_label = "Dismiss"

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """Forget how the last job ended."""
        jobs.forget()
        return {"FINISHED"}


CLASSES = (
    FEWVIEW_OT_reconstruct,
    FEWVIEW_OT_cancel,
    FEWVIEW_OT_show_log,
    FEWVIEW_OT_copy_report,
    FEWVIEW_OT_dismiss,
)
