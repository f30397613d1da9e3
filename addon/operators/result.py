"""Step 5: the mesh that came back, and what is done with it."""

from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

import bpy
from bpy.props import BoolProperty, FloatProperty, StringProperty

from .. import colours, result_mesh
from ..job_folder import FolderError, past_jobs
from ..properties import IN_BLEND, settings_of
from ..result_import import import_result_steps
from ..result_mesh import result_or_none
from ..scenes import reason_against_changes
from .measure import FEWVIEW_OT_measure_error
from .on_result import OnResult, Status, has_result, refused, result_of
from .polling import speaks_nothing_against
from .reconstruct import jobs_parent
from .result_files import (
    FEWVIEW_OT_export,
    FEWVIEW_OT_open_camera_report,
    FEWVIEW_OT_open_folder,
    FEWVIEW_OT_open_report,
)

__all__ = ["CLASSES", "import_result_steps"]


class FEWVIEW_OT_import_result(bpy.types.Operator):
    """Import the mesh of a job that has ended, and its cameras"""

    bl_idname = "fewview.import_result"
    bl_label = "Import Result"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    folder: StringProperty(
        name="Job",
        description="Folder of the job; the newest one where this is empty",
        subtype="DIR_PATH",
        options={"SKIP_SAVE", *IN_BLEND, "HIDDEN"},
    )
    directory: StringProperty(subtype="DIR_PATH", options={"SKIP_SAVE", *IN_BLEND, "HIDDEN"})
    cameras: BoolProperty(name="Cameras", description="Import the cameras and the points, too", default=True)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        reason = reason_against_changes(context.scene)
        if not reason and context.mode != "OBJECT":
            reason = "Change to Object Mode first"
        return speaks_nothing_against(cls, reason)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Status:
        if self.folder:
            return self.execute(context)
        # Without a property for files the browser chooses folders.
        self.directory = str(jobs_parent(context))
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> Status:
        try:
            folder = self._folder(context)
            warnings: list[str] = []
            for _ in import_result_steps(
                folder, scene_name=context.scene.name, cameras=self.cameras, undo=False, warnings=warnings
            ):
                pass
        except (ValueError, OSError) as error:
            return refused(self, error)
        for text in warnings:
            self.report({"WARNING"}, text)
        self.report({"INFO"}, f"Imported {folder.name}")
        return {"FINISHED"}

    def _folder(self, context: bpy.types.Context) -> Path:
        chosen = self.folder or self.directory
        if chosen:
            return Path(bpy.path.abspath(chosen)).absolute()
        parent = jobs_parent(context)
        newest = next(past_jobs(parent), None)
        if newest is None:
            raise FolderError(
                f"There is no finished job in {parent}: reconstruct first, or choose its folder"
            )
        return newest.folder


class _Show(OnResult):
    kind: ClassVar[colours.Kind]
    unavailable: ClassVar[str]
    poll_message_set: ClassVar[Callable[[str], None]]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not has_result(cls, context):
            return False
        result = result_or_none(context)
        if result is None or not colours.can_show(result.data, cls.kind):
            cls.poll_message_set(cls.unavailable)
            return False
        return True

    def execute(self, context: bpy.types.Context) -> Status:
        try:
            mesh = result_of(context, self.object_name).data
            colours.show(mesh, self.kind)
        except ValueError as error:
            return refused(self, error)
        colours.show_in_viewports(mesh)
        return {"FINISHED"}


class FEWVIEW_OT_show_colour(_Show, bpy.types.Operator):
    """Show the colors of the photographs"""

    bl_idname = "fewview.show_colour"
    bl_label = "Color"
    bl_options: ClassVar = {"REGISTER", "UNDO"}
    kind = "COLOUR"
    unavailable = "This mesh has no colors of photographs"


class FEWVIEW_OT_show_support(_Show, bpy.types.Operator):
    """Show what is measured, in blue green, and what is guessed, in red"""

    bl_idname = "fewview.show_support"
    bl_label = "Support"
    bl_options: ClassVar = {"REGISTER", "UNDO"}
    kind = "SUPPORT"
    unavailable = "This mesh does not know its support"


class FEWVIEW_OT_show_error(_Show, bpy.types.Operator):
    """Show how far the mesh is from the original: white lies on it, dark red is 2 % of its size off"""

    bl_idname = "fewview.show_error"
    bl_label = "Error"
    bl_options: ClassVar = {"REGISTER", "UNDO"}
    kind = "ERROR"
    unavailable = "Measure the error first"


class FEWVIEW_OT_decimate(OnResult, bpy.types.Operator):
    """Show fewer triangles by a modifier, which keeps the colors and can be changed or removed"""

    bl_idname = "fewview.decimate"
    bl_label = "Decimate"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    ratio: FloatProperty(
        name="Ratio",
        description="Share of triangles to keep; the scene's where this is 0",
        subtype="FACTOR",
        min=0.0,
        max=1.0,
        options={"SKIP_SAVE"},
    )

    def execute(self, context: bpy.types.Context) -> Status:
        try:
            result = result_of(context, self.object_name)
        except ValueError as error:
            return refused(self, error)
        result_mesh.decimate(result, self.ratio or settings_of(context).decimate_ratio)
        return {"FINISHED"}


class FEWVIEW_OT_remesh(OnResult, bpy.types.Operator):
    """Replace the mesh by a closed one of even faces, which keeps the colors"""

    bl_idname = "fewview.remesh"
    bl_label = "Remesh"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    voxel_size: FloatProperty(
        name="Voxel Size",
        description="Size of the faces; about that of the mesh's own where this is 0",
        subtype="DISTANCE",
        min=0.0,
        options={"SKIP_SAVE"},
    )

    def execute(self, context: bpy.types.Context) -> Status:
        try:
            result = result_of(context, self.object_name)
            result_mesh.remesh(context, result, self.voxel_size or result_mesh.usual_voxel(result))
        except (ValueError, RuntimeError) as error:
            return refused(self, error)
        return {"FINISHED"}


CLASSES = (
    FEWVIEW_OT_import_result,
    FEWVIEW_OT_show_colour,
    FEWVIEW_OT_show_support,
    FEWVIEW_OT_show_error,
    FEWVIEW_OT_measure_error,
    FEWVIEW_OT_decimate,
    FEWVIEW_OT_remesh,
    FEWVIEW_OT_export,
    FEWVIEW_OT_open_report,
    FEWVIEW_OT_open_camera_report,
    FEWVIEW_OT_open_folder,
)
