"""The sphere around what is to be reconstructed: an empty of the scene, and the best guess where it is."""

from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from .camera_objects import POINTS, ROLE, objects_of
from .frames import chosen_job_or_none, world_from_cameras_or_none
from .job_folder import CAMERAS, inside, results_in
from .placing import region_in_solved, sphere_around
from .scenes import in_scene
from .solved import read_solved
from .true_mesh import bounding_sphere, subject_of, true_mesh

REGION = "region"
"""Value of `fewview_role`."""
_MARGIN = 1.05
Sphere = tuple[NDArray[np.float64], float]
"""Centre (3,) and radius."""


def region_or_none(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """The empty, if the scene has one."""
    return in_scene(scene, scene.fewview.region)


def region_of(scene: bpy.types.Scene, cameras: str | None) -> Sphere | None:
    """The region in the frame of the cameras that a job is given; None to have the backend find it.

    Raises ValueError where these have no place in the scene, so that the empty says nothing to a job; where
    the empty has no size; or the placement cannot be turned back.
    """
    empty = region_or_none(scene)
    if empty is None:
        return None
    world = None if cameras is None else world_from_cameras_or_none(scene, Path(cameras))
    if world is None:
        raise ValueError(
            "The region needs the cameras of these photographs in the scene: estimate or load them in step 2 "
            "first, or remove the region"
        )
    return region_in_solved(world, np.array(empty.matrix_world), empty.empty_display_size)


def place_region(scene: bpy.types.Scene, sphere: Sphere) -> bpy.types.Object:
    """Move the scene's region to this sphere in the world; made where there is none."""
    centre, radius = sphere
    empty = region_or_none(scene)
    if empty is None:
        empty = bpy.data.objects.new("FewView Region", None)
        empty[ROLE] = REGION
        scene.collection.objects.link(empty)
        empty.empty_display_type = "SPHERE"
        scene.fewview.region = empty
    # In units of what it shows, so that its scale reads as the radius.
    empty.empty_display_size = 1.0
    empty.matrix_world = Matrix.Translation(centre.tolist()) @ Matrix.Scale(radius, 4)
    return empty


def remove_region(scene: bpy.types.Scene) -> None:
    """Forget the region; the empty goes if it is one of ours."""
    empty = scene.fewview.region
    scene.fewview.region = None
    if empty is not None and empty.get(ROLE) == REGION and empty.type == "EMPTY":
        bpy.data.objects.remove(empty)


def guess(scene: bpy.types.Scene) -> tuple[Sphere, str]:
    """The sphere that the backend found, or else around the target, or else at the cursor; and which."""
    for sphere, source in ((_backend_sphere(scene), "the cameras"), (_target_sphere(scene), "the object")):
        if sphere is not None:
            return sphere, source
    return (np.array(scene.cursor.location, np.float64), 1.0), "the 3D cursor"


def fitted(scene: bpy.types.Scene) -> tuple[Sphere, str]:
    """The sphere around the sparse points, or that of the backend, or around the target; and which.

    Raises ValueError where there is nothing to fit to.
    """
    points = _points_or_none(scene)
    if points is not None:
        try:
            return sphere_around(*points), "the points"
        except ValueError:
            pass  # too few, or all in one place: the next best
    for sphere, source in ((_backend_sphere(scene), "the cameras"), (_target_sphere(scene), "the object")):
        if sphere is not None:
            return sphere, source
    raise ValueError("There is nothing to fit the region to: estimate the cameras first, or choose an object")


def _points_or_none(scene: bpy.types.Scene) -> tuple[NDArray[np.float64], NDArray[np.float64] | None] | None:
    """Sparse points (points, 3) in the world and, where they have any, their weights."""
    job = chosen_job_or_none(scene.fewview)
    found = [] if job is None else objects_of(scene, str(job), POINTS)
    chosen = next((made for made in found if made.type == "MESH"), None)
    if chosen is None:
        return None
    mesh = chosen.data
    flat = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", flat)
    world = np.array(chosen.matrix_world, np.float64)
    weights = None
    confidence = mesh.attributes.get("confidence") or mesh.attributes.get("support")
    if confidence is not None and confidence.data_type == "FLOAT" and confidence.domain == "POINT":
        values = np.empty(len(mesh.vertices), np.float32)
        confidence.data.foreach_get("value", values)
        weights = values.astype(np.float64)
    return flat.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3], weights


def _backend_sphere(scene: bpy.types.Scene) -> Sphere | None:
    """What the backend found with the cameras, in the world."""
    folder = chosen_job_or_none(scene.fewview)
    if folder is None:
        return None
    cameras = results_in(folder) / CAMERAS
    try:
        solved = read_solved(inside(folder, cameras))
    except ValueError:  # no such file any more: the next best guess
        return None
    world = world_from_cameras_or_none(scene, cameras)
    if world is None or solved.region_centre is None or solved.region_radius is None:
        return None
    scale = float(np.cbrt(abs(np.linalg.det(world[:3, :3]))))
    return world[:3, :3] @ np.array(solved.region_centre) + world[:3, 3], solved.region_radius * scale


def _target_sphere(scene: bpy.types.Scene) -> Sphere | None:
    """Around the object that the views were rendered of."""
    target = in_scene(scene, scene.fewview.target)
    if target is None:
        return None
    try:
        centre, radius = bounding_sphere(true_mesh(subject_of(target)))
    except ValueError:  # hidden, or without a surface
        return None
    return (centre, radius * _MARGIN) if radius > 0 else None
