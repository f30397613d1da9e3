"""Points alone: a surface on the points of an object."""

from pathlib import Path

import bpy

from ...backend.wire.client import backend_command
from ...backend.wire.protocol import Finished
from .. import jobs
from ..arguments import argument, fill_in
from ..job_folder import CLOUD, LOG, RESULT, new_folder
from ..object_points import points_of, reason_against
from ..ply import write_points
from ..properties import settings_of
from ..result_import import import_fit_steps
from ..scenes import reason_against_changes, scene_name_of
from .environment import backend_python_or_reason, reason_against_a_job
from .polling import speaks_nothing_against
from .reconstruct import IN_PAST_JOBS, jobs_parent


class FEWVIEW_OT_fit_points(bpy.types.Operator):
    """Make a closed surface on the points of the active mesh or point cloud, while Blender stays usable"""

    bl_idname = "fewview.fit_points"
    bl_label = "Fit Surface to Points"
    bl_options = {"REGISTER"}

    method: argument("point_method")
    normals_known: argument("point_normals")
    device: argument("device")
    seed: argument("seed")
    output: argument("output")

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Not twice at once, not without a backend, points, and a scene that takes the surface."""
        reason = reason_against_changes(context.scene) or reason_against_a_job(context)
        if not reason and context.mode != "OBJECT":
            reason = "Change to Object Mode first"
        reason = reason or reason_against(context.active_object)
        return speaks_nothing_against(cls, reason)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Write the points and start; without a window, wait for the end."""
        same = {name: name for name in ("device", "seed")}
        fill_in(
            self,
            settings_of(context),
            {"method": "point_method", "normals_known": "point_normals", **same},
        )
        python, reason = backend_python_or_reason(context)
        try:
            if python is None:
                raise ValueError(reason)
            points = points_of(context.active_object, normals_known=self.normals_known)
            folder = new_folder(jobs_parent(context, self.output), "points")
            write_points(folder / CLOUD, points.positions, points.normals)
            words = ["--method", self.method, "--device", self.device, "--seed", str(self.seed)]
            if self.normals_known:
                words.append("--normals-known")
            _start(python, folder, words, context)
        except (ValueError, jobs.JobError, OSError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return jobs.follow(self)


def _start(python: Path, folder: Path, words: list[str], context: bpy.types.Context) -> None:
    """Start the backend on the folder's points; the surface comes into the scene at the end.

    Raises JobError where it cannot be started.
    """
    uid, name = context.scene.session_uid, f"{context.active_object.name} surface"

    def on_finished(_: Finished) -> jobs.Steps:
        undo = not bpy.app.background
        yield from import_fit_steps(folder, scene_name=scene_name_of(uid), name=name, undo=undo)

    cloud, output = str(folder / CLOUD), str(folder / RESULT)
    jobs.start(
        "Fitting points",
        backend_command(python, "fit-points", cloud, "--output", output, *words, "--wire"),
        folder=folder,
        log_path=folder / LOG,
        on_finished=on_finished,
        remedy=IN_PAST_JOBS,
    )


CLASSES = (FEWVIEW_OT_fit_points,)
