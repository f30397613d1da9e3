"""Step 5: the mesh as a file for other programs, and what else lies in a job's folder."""

import os
from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, StringProperty

from .. import result_mesh
from ..camera_objects import JOB
from ..frames import chosen_job_or_none
from ..job_folder import (
    CAMERAS_PAGE,
    REPORT_NUMBERS,
    REPORT_PAGE,
    FolderError,
    inside,
    past_jobs,
    read_job,
    results_in,
)
from ..properties import IN_BLEND, settings_of
from ..result_mesh import result_or_none
from .on_result import RECONSTRUCT_FIRST, OnResult, Status, refused, result_of
from .reconstruct import jobs_parent


class FEWVIEW_OT_export(OnResult, bpy.types.Operator):
    """Write the mesh into a file for other programs, as it is shown"""

    bl_idname = "fewview.export"
    bl_label = "Export Mesh"

    filepath: StringProperty(name="File", subtype="FILE_PATH", options={"SKIP_SAVE", *IN_BLEND})
    filter_glob: StringProperty(
        default=";".join(f"*{end}" for end in result_mesh.FORMATS), options={"HIDDEN"}
    )
    check_existing: BoolProperty(default=True, options={"HIDDEN"})
    format: EnumProperty(
        name="Format",
        description="Where the name has no ending of its own",
        items=[
            (".glb", "glTF", "For the web, game engines and most other programs"),
            (".ply", "PLY", "For mesh processing; with support and error as numbers"),
            (".obj", "OBJ", "For older programs"),
            (".stl", "STL", "For 3D printing; without colors"),
        ],
    )
    overwrite: BoolProperty(
        name="Overwrite",
        description="Replace a file that exists",
        options={"SKIP_SAVE", "HIDDEN"},
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Status:
        self.overwrite = True  # the file browser warns and asks
        if not self.filepath:
            beside = Path(bpy.data.filepath).parent if bpy.data.filepath else jobs_parent(context)
            name = bpy.path.clean_name(result_of(context, self.object_name).name)
            self.filepath = str(beside / f"{name}{self.format}")
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def check(self, context: bpy.types.Context) -> bool:
        """In the file browser: the whole name, else it cannot warn of a file that exists."""
        name = os.path.basename(self.filepath)
        if not name or Path(name).suffix:
            return False
        self.filepath += self.format
        return True

    def execute(self, context: bpy.types.Context) -> Status:
        path = Path(bpy.path.abspath(self.filepath)).absolute()
        if not path.suffix:
            path = path.with_suffix(self.format)
        try:
            if not self.filepath:
                raise ValueError("Give the name of the file to write")
            if path.exists() and not self.overwrite:
                raise ValueError(f"{path} exists: choose another name, or set Overwrite")
            result_mesh.export(context, result_of(context, self.object_name), path)
        except ValueError as error:
            return refused(self, error)
        self.report({"INFO"}, f"Wrote {path}")
        return {"FINISHED"}


class _OnFolder:
    """What the operators have in common that open something of a job on disk."""

    folder: StringProperty(
        name="Job",
        description="Folder of the job; that of the selected result, or of the newest, where this is empty",
        subtype="DIR_PATH",
        options={"SKIP_SAVE", *IN_BLEND},
    )

    def _job_folder(self, context: bpy.types.Context) -> Path:
        """Folder of a job with a mesh; FolderError where there is none."""
        if self.folder:
            return read_job(Path(bpy.path.abspath(self.folder)).absolute()).folder
        result = result_or_none(context)
        if result is not None and result.get(JOB):
            return read_job(Path(str(result[JOB]))).folder
        newest = next(past_jobs(jobs_parent(context)), None)
        if newest is None:
            raise FolderError(RECONSTRUCT_FIRST)
        return newest.folder


class FEWVIEW_OT_open_report(_OnFolder, bpy.types.Operator):
    """Open the report of the reconstruction in a web browser"""

    bl_idname = "fewview.open_report"
    bl_label = "Open Report"

    def execute(self, context: bpy.types.Context) -> Status:
        try:
            folder = self._job_folder(context)
            page = inside(folder, results_in(folder) / REPORT_PAGE)
            if not page.is_file():
                raise FolderError(
                    f"The job {folder.name} has no {REPORT_PAGE}: surfaces fitted to points come with "
                    f"{REPORT_NUMBERS} alone; press Open Folder"
                )
            bpy.ops.wm.url_open(url=page.as_uri())
        except (FolderError, RuntimeError) as error:
            return refused(self, error)
        return {"FINISHED"}


def camera_page_or_none(context: bpy.types.Context) -> Path | None:
    """What the job tells of the cameras that step 2 is set to; None where none found them, or it is gone."""
    folder = chosen_job_or_none(settings_of(context))
    try:
        page = None if folder is None else inside(folder, results_in(folder) / CAMERAS_PAGE)
        return page if page is not None and page.is_file() else None
    except (FolderError, OSError):
        return None


class FEWVIEW_OT_open_camera_report(bpy.types.Operator):
    """Open in a web browser what is known of the cameras: who matches whom, how sure each of them is"""

    bl_idname = "fewview.open_camera_report"
    bl_label = "Open Camera Report"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        page = camera_page_or_none(context)
        if page is None:
            cls.poll_message_set("Estimate the cameras in step 2 first")
        return page is not None

    def execute(self, context: bpy.types.Context) -> Status:
        page = camera_page_or_none(context)
        if page is None:
            return refused(self, FolderError("The report of the cameras is gone"))
        bpy.ops.wm.url_open(url=page.as_uri())
        return {"FINISHED"}


class FEWVIEW_OT_open_folder(_OnFolder, bpy.types.Operator):
    """Open the folder with all files of the job"""

    bl_idname = "fewview.open_folder"
    bl_label = "Open Folder"

    def execute(self, context: bpy.types.Context) -> Status:
        try:
            bpy.ops.wm.path_open(filepath=str(self._job_folder(context)))
        except (FolderError, RuntimeError) as error:
            return refused(self, error)
        return {"FINISHED"}
