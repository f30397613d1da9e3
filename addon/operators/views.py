"""Step 1, rendered views: cameras around an object, and what they see."""

import os
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import bpy
import numpy as np
from bpy.props import StringProperty

from .. import jobs, render_worker, undo_step, view_cameras
from ..arguments import argument, fill_in
from ..camera_objects import selected_cameras
from ..job_folder import new_folder
from ..properties import FEWVIEW_PG_settings, settings_of
from ..scenes import has_camera, in_scene, object_named, reason_against_changes, scene_name_of, scene_named
from ..solved import read_solved
from ..true_mesh import WITH_SURFACE
from ..view_cameras import ViewPlan
from ..view_layout import LayoutKind, ViewLayout
from ..view_rendering import TRANSFORMS, TRUTH, View, ViewRequest
from .images import add_images
from .reconstruct import jobs_parent

MOST_VIEWS = 1000


class FEWVIEW_OT_generate_views(bpy.types.Operator):
    """Place cameras around the object, in place of those placed before; move them as you like"""

    bl_idname = "fewview.generate_views"
    bl_label = "Generate Cameras"
    bl_options = {"REGISTER", "UNDO"}

    target: StringProperty(name="Object", description="Name of the object to look at", options={"SKIP_SAVE"})
    arrangement: argument("layout")
    view_count: argument("view_count")
    arc: argument("arc")
    azimuth: argument("azimuth")
    elevation: argument("elevation")
    jitter: argument("jitter")
    view_seed: argument("view_seed")
    radius: argument("radius")
    lens_mm: argument("lens_mm")
    resolution_x: argument("resolution_x")
    resolution_y: argument("resolution_y")

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """There must be something to look at, in a scene that takes cameras."""
        if reason := reason_against_changes(context.scene):
            cls.poll_message_set(reason)
            return False
        if not any(made.type in WITH_SURFACE or made.type == "EMPTY" for made in context.scene.objects):
            cls.poll_message_set("Add an object to look at")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Make the cameras."""
        settings = settings_of(context)
        own = ("view_count", "arc", "azimuth", "elevation", "jitter", "view_seed", "radius", "lens_mm")
        same = (*own, "resolution_x", "resolution_y")
        fill_in(self, settings, {"arrangement": "layout", **{name: name for name in same}})
        try:
            target = _target(context, self) or context.view_layer.objects.active
            if target is None:
                raise ValueError("There is no object to look at: select one")
            cameras = view_cameras.generate(context.scene, target, self._plan())
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        settings.target, settings.view_cameras = target, "GENERATED"
        self.report({"INFO"}, f"{len(cameras)} cameras look at {target.name}")
        return {"FINISHED"}

    def _plan(self) -> ViewPlan:
        """Raises ValueError for numbers that make no sense."""
        layout = ViewLayout(
            kind=LayoutKind[self.arrangement],
            num_views=self.view_count,
            arc_deg=float(np.rad2deg(self.arc)),
            azimuth_deg=float(np.rad2deg(self.azimuth)),
            elevation_deg=float(np.rad2deg(self.elevation)),
            jitter=self.jitter,
            seed=self.view_seed,
        )
        return ViewPlan(
            layout=layout,
            lens_mm=self.lens_mm,
            width=self.resolution_x,
            height=self.resolution_y,
            distance=self.radius,
        )


class FEWVIEW_OT_remove_views(bpy.types.Operator):
    """Remove the cameras that Generate Cameras made"""

    bl_idname = "fewview.remove_views"
    bl_label = "Remove Generated Cameras"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """There must be some."""
        if not view_cameras.generated(context.scene):
            cls.poll_message_set("There are no generated cameras")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove them."""
        view_cameras.remove(context.scene)
        return {"FINISHED"}


class FEWVIEW_OT_render_views(bpy.types.Operator):
    """Render the views into a new folder, and take them and their exact cameras for the reconstruction"""

    bl_idname = "fewview.render_views"
    bl_label = "Render Views"

    target: StringProperty(
        name="Object",
        description="Name of the object that is the subject; empty to render all of the scene",
        options={"SKIP_SAVE"},
    )
    view_cameras: argument("view_cameras")
    frame_step: argument("frame_step")
    engine: argument("engine")
    samples: argument("samples")
    resolution_x: argument("resolution_x")
    resolution_y: argument("resolution_y")
    output: argument("output")

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Cameras, and no other job."""
        if jobs.running() is not None:
            cls.poll_message_set("Wait for the running job, or cancel it")
            return False
        if not has_camera(context.scene):
            cls.poll_message_set("Generate cameras first, or add one")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Render here where nobody waits for Blender, else in a second one."""
        same = ("view_cameras", "frame_step", "engine", "samples", "resolution_x", "resolution_y")
        fill_in(self, settings_of(context), {name: name for name in same})
        try:
            request = self._request(context)
            folder = new_folder(jobs_parent(context, self.output), "views")
            if render_worker.needs_waiting():
                for sentence in render_worker.render_here(request, folder):
                    self.report({"WARNING"}, sentence)
                for _ in take_views(context.scene.session_uid, folder):
                    pass
                return {"FINISHED"}
            self._start(context.scene, request, folder)
        except (ValueError, OSError, RuntimeError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return jobs.follow(self)

    def _request(self, context: bpy.types.Context) -> ViewRequest:
        """Raises ValueError where there is nothing to render."""
        views = _views(context, self.view_cameras, self.frame_step)
        if len(views) > MOST_VIEWS:
            raise ValueError(f"{len(views)} views are too many: take fewer frames")
        target, chosen = _target(context, self), settings_of(context).target
        if target is None and chosen is not None and not self.properties.is_property_set("target"):
            raise ValueError(f"{chosen.name} is no longer in the scene: choose another object, or none")
        return ViewRequest(
            scene=context.scene.name_full,
            view_layer=context.view_layer.name,
            views=views,
            target=None if target is None else target.name_full,
            engine=self.engine,
            samples=self.samples,
            width=self.resolution_x,
            height=self.resolution_y,
        )

    def _start(self, scene: bpy.types.Scene, request: ViewRequest, folder: Path) -> None:
        try:
            render_worker.prepare(scene, request, folder)
        except (RuntimeError, OSError) as error:
            render_worker.clean(folder)
            raise ValueError(
                f"The scene cannot be copied to {folder}: is the disk full? ({error})"
            ) from error
        scene_uid = scene.session_uid
        jobs.start(
            "Rendering views",
            render_worker.worker_command(folder),
            folder=folder,
            log_path=folder / render_worker.LOG,
            on_finished=lambda _: take_views(scene_uid, folder),
            on_end=partial(render_worker.clean, folder),
            remedy=f"The views and their cameras are in {folder}.",
            environment=os.environ,
            noisy_start=True,
        )
        running = jobs.running()
        if running is not None:
            running.warnings += render_worker.not_copied()


def take_views(scene_uid: int, folder: Path) -> Iterator[None]:
    """Make the rendered views of a folder what is reconstructed, with their cameras and the truth.

    In steps for a timer; the last is an undo step. Raises ValueError where the folder is not usable.
    """
    solved = read_solved(folder / TRANSFORMS)
    yield
    settings: FEWVIEW_PG_settings = scene_named(scene_name_of(scene_uid)).fewview
    settings.images.clear()
    add_images(settings, [folder / camera.name for camera in solved.cameras])
    settings.source, settings.camera_source = "RENDER", "KNOWN"
    settings.cameras_path = str(folder / TRANSFORMS)
    truth = folder / TRUTH
    settings.truth = str(truth) if truth.is_file() else ""
    settings.masks = settings.cameras_job = ""
    settings.root = None  # the views' cameras stand in the world
    yield
    undo_step.push("Render Views")


def _target(context: bpy.types.Context, operator: bpy.types.Operator) -> bpy.types.Object | None:
    """The object of the argument, or of the scene's settings where there is none. Raises ValueError."""
    if not operator.properties.is_property_set("target"):
        return in_scene(context.scene, settings_of(context).target)
    if not operator.target:
        return None
    return object_named(context.scene, operator.target)


def _views(context: bpy.types.Context, source: str, frame_step: int) -> tuple[View, ...]:
    """What is to be rendered. Raises ValueError with the remedy where that is nothing."""
    scene = context.scene
    match source:
        case "ANIMATED":
            if scene.camera is None:
                raise ValueError("The scene has no camera: choose one in the scene's properties")
            return tuple(
                View(camera="", frame=frame)
                for frame in range(scene.frame_start, scene.frame_end + 1, frame_step)
            )
        case "SELECTED":
            cameras = selected_cameras(context.view_layer)
            remedy = "No camera is selected: select those to render from"
        case _:
            cameras = view_cameras.generated(scene)
            remedy = "There are no generated cameras: press Generate Cameras first"
    if not cameras:
        raise ValueError(remedy)
    return tuple(View(camera=camera.name_full) for camera in cameras)


CLASSES = (FEWVIEW_OT_generate_views, FEWVIEW_OT_remove_views, FEWVIEW_OT_render_views)
