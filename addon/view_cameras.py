"""Cameras around an object as real camera objects, which the user may move before they render.

They carry the custom property `fewview_view`, their number, by which they are found; generating again
replaces them. World z is up.
"""

from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from .camera_objects import remove_object
from .intrinsics import SENSOR_WIDTH_MM
from .true_mesh import subject_of, true_mesh
from .view_layout import Lens, ViewLayout, place_cameras

VIEW = "fewview_view"
"""Name of the custom property."""
COLLECTION = "FewView Views"


@dataclass(frozen=True, kw_only=True)
class ViewPlan:
    """How an object is surrounded."""

    layout: ViewLayout
    lens_mm: float
    width: int
    height: int
    distance: float
    """From the middle of the object; 0 fits it into every picture."""


def generate(scene: bpy.types.Scene, target: bpy.types.Object, plan: ViewPlan) -> list[bpy.types.Object]:
    """Make the cameras in place of those generated before.

    Raises ValueError where the object has no visible surface.
    """
    try:
        points = true_mesh(subject_of(target)).vertices
    except ValueError as error:
        raise ValueError(f"{target.name}: {error}; show it, or choose another object") from error
    aspect = scene.render.pixel_aspect_y / scene.render.pixel_aspect_x
    focal_px = plan.lens_mm / SENSOR_WIDTH_MM * max(plan.width, plan.height * aspect)
    # Framing knows square pixels only: high ones are as if there were more rows.
    lens = Lens(width=plan.width, height=round(plan.height * aspect), focal_px=focal_px)
    poses = place_cameras(plan.layout, lens, points=points, distance=plan.distance or None)
    size = float(np.linalg.norm(np.ptp(points, axis=0))) / 2
    remove(scene)
    collection = _collection(scene)
    cameras = [_camera(collection, index, pose, plan, size) for index, pose in enumerate(poses)]
    scene.camera = scene.camera or cameras[0]
    return cameras


def generated(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The generated cameras of the scene, in order."""
    found = [made for made in scene.objects if VIEW in made and made.type == "CAMERA"]
    return sorted(found, key=lambda camera: (camera[VIEW], camera.name))


def remove(scene: bpy.types.Scene) -> int:
    """Remove the generated cameras, and say how many; their collection goes when it is empty."""
    cameras = generated(scene)
    for camera in cameras:
        remove_object(camera)
    collection = _collection_or_none(scene)
    if collection is not None and not collection.all_objects and not collection.children:
        bpy.data.collections.remove(collection)
    return len(cameras)


def _camera(
    collection: bpy.types.Collection, index: int, pose: NDArray[np.float64], plan: ViewPlan, size: float
) -> bpy.types.Object:
    data = bpy.data.cameras.new(f"View {index:03d}")
    camera = bpy.data.objects.new(f"View {index:03d}", data)
    camera[VIEW] = index
    collection.objects.link(camera)
    camera.matrix_world = Matrix(pose.tolist())
    data.sensor_fit, data.sensor_width, data.lens = "AUTO", SENSOR_WIDTH_MM, plan.lens_mm
    data.display_size = 0.3 * size
    data.clip_start, data.clip_end = 0.01 * size, max(1000.0 * size, 100.0)
    return camera


def _collection_or_none(scene: bpy.types.Scene) -> bpy.types.Collection | None:
    return next((c for c in scene.collection.children_recursive if VIEW in c), None)


def _collection(scene: bpy.types.Scene) -> bpy.types.Collection:
    found = _collection_or_none(scene)
    if found is None:
        found = bpy.data.collections.new(COLLECTION)
        found[VIEW] = True
        scene.collection.children.link(found)
    return found
