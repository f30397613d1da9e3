"""The sidebar: five steps, each with its state in one line and at most one main button."""

from itertools import islice
from pathlib import Path
from typing import Any

import bpy

from . import jobs
from .camera_objects import JOB
from .colours import legend
from .drawing import draw_button, draw_state, draw_text
from .environment import State
from .error_map import numbers_of
from .job_boxes import draw_ended, draw_environment, draw_running
from .job_folder import can_be_rendered, has_report, past_jobs
from .operators.environment import backend_state
from .operators.images import list_problems
from .operators.reconstruct import jobs_parent
from .operators.result_files import camera_page_or_none
from .properties import settings_of
from .result_mesh import result_or_none
from .result_numbers import result_lines
from .scenes import in_scene
from .state_lines import (
    TODO,
    StepState,
    cameras_state,
    images_state,
    reconstruct_state,
    region_state,
    result_state,
    solved_or_none,
)
from .view_cameras import generated

_MOST_PAST_JOBS = 8


class _Panel:
    """Mix-in: a panel of the sidebar's FewView tab."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "FewView"
    layout: bpy.types.UILayout


class _Step(_Panel):
    """Mix-in: one of the five steps; its state is seen even where it is closed."""

    bl_parent_id = "FEWVIEW_PT_main"

    def state(self, context: bpy.types.Context) -> StepState:
        """How the step stands."""
        raise NotImplementedError

    def draw_header_preset(self, context: bpy.types.Context) -> None:
        """At the right of the title."""
        self.layout.label(icon=self.state(context).icon)


class FEWVIEW_PT_main(_Panel, bpy.types.Panel):
    """What runs, how the last job ended, and whether there is a backend"""

    bl_label = "FewView"
    bl_idname = "FEWVIEW_PT_main"

    def draw(self, context: bpy.types.Context) -> None:
        """Above the steps."""
        job, end = jobs.running(), jobs.ended()
        if job is not None:
            draw_running(self.layout.box(), context, job)
        elif end is not None and (end.failure is not None or end.warnings or end.notes):
            draw_ended(self.layout.box(), context, end)
        if job is None and backend_state(context)[0] is State.NOT_READY:
            draw_environment(self.layout.box(), context)


class FEWVIEW_UL_images(bpy.types.UIList):
    """The photographs"""

    def draw_item(
        self,
        _context: Any,
        layout: Any,
        _data: Any,
        item: Any,
        _icon: Any,
        _active_data: Any,
        _active_property: Any,
    ) -> None:
        """A tick, the name, the size or what is wrong."""
        row = layout.row(align=True)
        row.prop(item, "use", text="")
        row.label(text=item.name, icon="ERROR" if item.problem else "NONE")
        size = row.row()
        size.alignment = "RIGHT"
        size.enabled = False
        size.label(text=f"{item.width} x {item.height}" if item.width else "")


class FEWVIEW_PT_images(_Step, bpy.types.Panel):
    """Step 1"""

    bl_label = "1. Images"
    bl_idname = "FEWVIEW_PT_images"

    def state(self, context: bpy.types.Context) -> StepState:
        """How the step stands."""
        return images_state(settings_of(context))

    def draw(self, context: bpy.types.Context) -> None:
        """Source, list, and what is wrong with it."""
        layout, settings = self.layout, settings_of(context)
        draw_state(layout, self.state(context))
        layout.row().prop(settings, "source", expand=True)
        if settings.source == "RENDER":
            _draw_render(layout, context)
        elif not settings.images:
            draw_button(layout, "fewview.add_images", icon="FILE_FOLDER", text="Add Photographs...")
            draw_text(layout, context, "3 to 20 pictures of one thing, each from a step further round it")
        if settings.images:
            _draw_list(layout, context)


class FEWVIEW_PT_cameras(_Step, bpy.types.Panel):
    """Step 2"""

    bl_label = "2. Cameras"
    bl_idname = "FEWVIEW_PT_cameras"
    bl_options = {"DEFAULT_CLOSED"}

    def state(self, context: bpy.types.Context) -> StepState:
        """How the step stands."""
        return cameras_state(settings_of(context))

    def draw(self, context: bpy.types.Context) -> None:
        """Where they come from, and who could not be placed."""
        layout, settings = self.layout, settings_of(context)
        draw_state(layout, self.state(context))
        layout.row().prop(settings, "camera_source", expand=True)
        known = settings.camera_source == "KNOWN"
        if known:
            layout.prop(settings, "cameras_path", text="")
        solved = solved_or_none(settings)
        text = "Load Cameras" if known else "Estimate Cameras"
        row = layout.row(align=True)
        row.operator("fewview.estimate_cameras", icon="OUTLINER_DATA_CAMERA", text=text)
        if solved is None:
            draw_text(layout, context, "Not needed: do it to see the cameras before the mesh")
            return
        row.operator("fewview.remove_cameras", icon="X", text="")
        if solved.reprojection_error_px is not None:
            layout.label(text=f"Accurate to {solved.reprojection_error_px:.1f} pixels")
        layout.operator("fewview.show_photograph", icon="VIEW_CAMERA")
        _draw_camera_report(layout, context)
        for name, why in solved.unplaced:
            box = layout.box()
            box.label(text=f"{name} could not be placed", icon="ERROR")
            draw_text(box, context, why)


class FEWVIEW_PT_region(_Step, bpy.types.Panel):
    """Step 3"""

    bl_label = "3. Region"
    bl_idname = "FEWVIEW_PT_region"
    bl_options = {"DEFAULT_CLOSED"}

    def state(self, context: bpy.types.Context) -> StepState:
        """How the step stands."""
        return region_state(settings_of(context))

    def draw(self, context: bpy.types.Context) -> None:
        """A sphere, or nothing."""
        layout, settings = self.layout, settings_of(context)
        draw_state(layout, self.state(context))
        region = in_scene(context.scene, settings.region)
        if region is None:
            layout.operator("fewview.add_region", icon="SPHERE")
            draw_text(layout, context, "Not needed: a sphere in the scene that you move and scale")
            return
        row = layout.row(align=True)
        row.operator("fewview.fit_region", icon="FULLSCREEN_EXIT", text="Fit to Subject")
        row.operator("fewview.remove_region", icon="X", text="")
        layout.prop(region, "location")
        layout.prop(region, "scale")


class FEWVIEW_PT_reconstruct(_Step, bpy.types.Panel):
    """Step 4"""

    bl_label = "4. Reconstruct"
    bl_idname = "FEWVIEW_PT_reconstruct"

    def state(self, context: bpy.types.Context) -> StepState:
        """How the step stands."""
        return reconstruct_state(settings_of(context))

    def draw(self, context: bpy.types.Context) -> None:
        """Preset and start."""
        layout, settings = self.layout, settings_of(context)
        draw_state(layout, self.state(context))
        layout.prop(settings, "preset")
        layout.prop(settings, "cut_out")
        layout.prop(settings, "without_ground")
        ready = self.state(context).icon != TODO
        row = layout.row()
        row.enabled = ready
        draw_button(row, "fewview.reconstruct", icon="MOD_REMESH", text="Reconstruct", main=ready)


class FEWVIEW_PT_advanced(_Panel, bpy.types.Panel):
    """Rarely needed"""

    bl_label = "Advanced"
    bl_parent_id = "FEWVIEW_PT_reconstruct"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """Where to compute, where to write, what to compare with."""
        layout, settings = self.layout, settings_of(context)
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.prop(settings, "device")
        layout.prop(settings, "seed")
        layout.prop(settings, "output", placeholder=str(jobs_parent(context)))
        layout.prop(settings, "masks")
        layout.prop(settings, "truth")


class FEWVIEW_PT_result(_Step, bpy.types.Panel):
    """Step 5"""

    bl_label = "5. Result"
    bl_idname = "FEWVIEW_PT_result"

    def state(self, context: bpy.types.Context) -> StepState:
        """How the step stands."""
        return result_state(result_or_none(context))

    def draw(self, context: bpy.types.Context) -> None:
        """The mesh, how far to trust it, and what to do with it."""
        layout, settings = self.layout, settings_of(context)
        draw_state(layout, self.state(context))
        result = result_or_none(context)
        if result is None:
            return
        folder = str(result.get(JOB, ""))
        for line in result_lines(Path(folder)) if folder else ():
            layout.label(text=line)
        layout.label(text="Show on the mesh:")
        row = layout.row(align=True)
        row.operator("fewview.show_colour")
        row.operator("fewview.show_support")
        row.operator("fewview.show_error")
        draw_text(layout, context, legend(result.data))
        target = in_scene(context.scene, settings.target)
        if target is not None:
            row = layout.row(align=True)
            row.operator("fewview.measure_error", icon="DRIVER_DISTANCE")
            row.prop(target, "hide_viewport", text="", emboss=True)
            numbers = numbers_of(result)
            if numbers is not None:
                draw_text(layout, context, numbers.text)
        column = layout.column(align=True)
        row = column.row(align=True)
        row.prop(settings, "decimate_ratio")
        row.operator("fewview.decimate", text="Decimate")
        column.operator("fewview.remesh", icon="MOD_REMESH")
        column.operator("fewview.export", icon="EXPORT")
        if folder and can_be_rendered(Path(folder)):
            column.operator("fewview.render_novel_views", icon="RENDER_STILL")
        if folder and has_report(Path(folder)):
            column.operator("fewview.open_report", icon="URL")
        _draw_camera_report(column, context)
        column.operator("fewview.open_folder", icon="FILE_FOLDER")


class FEWVIEW_PT_past_jobs(_Panel, bpy.types.Panel):
    """Results on the disk"""

    bl_label = "Past Jobs"
    bl_parent_id = "FEWVIEW_PT_result"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """Each with a button that brings it into the scene, and one for a result from anywhere."""
        found = list(islice(past_jobs(jobs_parent(context)), _MOST_PAST_JOBS))
        for job in found:
            shown = self.layout.operator("fewview.import_result", text=job.words, icon="IMPORT")
            shown.folder = str(job.folder)
        if not found:
            self.layout.label(text="None in the output folder")
        self.layout.operator("fewview.import_result", text="Import Result...", icon="FILE_FOLDER")


class FEWVIEW_PT_points(_Panel, bpy.types.Panel):
    """A surface without photographs"""

    bl_label = "Points Alone"
    bl_parent_id = "FEWVIEW_PT_main"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """What it does, how, and start."""
        layout, settings = self.layout, settings_of(context)
        draw_text(layout, context, "A closed surface on the points of the active mesh or point cloud")
        column = layout.column()
        column.use_property_split = True
        column.use_property_decorate = False
        column.prop(settings, "point_method")
        column.prop(settings, "point_normals")
        layout.operator("fewview.fit_points", icon="OUTLINER_OB_POINTCLOUD")


def _draw_camera_report(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    if camera_page_or_none(context) is not None:
        layout.operator("fewview.open_camera_report", icon="URL")


def _draw_render(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    settings = settings_of(context)
    column = layout.column()
    column.use_property_split = True
    column.use_property_decorate = False
    column.prop(settings, "target", placeholder="Active Object")
    column.prop(settings, "view_cameras")
    if settings.view_cameras == "GENERATED":
        column.prop(settings, "layout")
        column.prop(settings, "view_count")
        if settings.layout == "ARC":
            column.prop(settings, "arc")
        if settings.layout != "HEMISPHERE":
            column.prop(settings, "elevation")
        made = bool(generated(context.scene))
        text = "Generate Again" if made else "Generate Cameras"
        row = layout.row(align=True)
        draw_button(row, "fewview.generate_views", icon="OUTLINER_OB_CAMERA", text=text, main=not made)
        if made:
            row.operator("fewview.remove_views", icon="X", text="")
    elif settings.view_cameras == "ANIMATED":
        column.prop(settings, "frame_step")
    ready = settings.view_cameras != "GENERATED" or made
    if ready:
        main = not settings.images
        draw_button(layout, "fewview.render_views", icon="RENDER_STILL", text="Render Views", main=main)


class FEWVIEW_PT_render(_Panel, bpy.types.Panel):
    """Rarely needed settings of rendered views"""

    bl_label = "Render Settings"
    bl_parent_id = "FEWVIEW_PT_images"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only for rendered views."""
        return settings_of(context).source == "RENDER"

    def draw(self, context: bpy.types.Context) -> None:
        """Picture and cameras."""
        layout, settings = self.layout, settings_of(context)
        layout.use_property_split = True
        layout.use_property_decorate = False
        column = layout.column(align=True)
        column.prop(settings, "resolution_x")
        column.prop(settings, "resolution_y")
        layout.prop(settings, "engine")
        if settings.engine == "CYCLES":
            layout.prop(settings, "samples")
        if settings.view_cameras == "GENERATED":
            for name in ("lens_mm", "radius", "azimuth", "jitter", "view_seed"):
                layout.prop(settings, name)


def _draw_list(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    settings = settings_of(context)
    row = layout.row()
    row.template_list("FEWVIEW_UL_images", "", settings, "images", settings, "active_image", rows=4)
    column = row.column(align=True)
    column.operator("fewview.add_images", icon="ADD", text="")
    column.operator("fewview.remove_image", icon="REMOVE", text="")
    column.separator()
    column.operator("fewview.clear_images", icon="TRASH", text="")
    if 0 <= settings.active_image < len(settings.images):
        problem = settings.images[settings.active_image].problem
        if problem:
            draw_text(layout, context, problem, icon="ERROR")
    for problem in list_problems(settings):
        draw_text(layout, context, problem, icon="ERROR")


CLASSES = (
    FEWVIEW_UL_images,
    FEWVIEW_PT_main,
    FEWVIEW_PT_images,
    FEWVIEW_PT_render,
    FEWVIEW_PT_cameras,
    FEWVIEW_PT_region,
    FEWVIEW_PT_reconstruct,
    FEWVIEW_PT_advanced,
    FEWVIEW_PT_result,
    FEWVIEW_PT_past_jobs,
    FEWVIEW_PT_points,
)
