"""Meshes of the backend as objects of a scene: the result, and previews of it while a job runs.

Objects that are made carry the custom properties of `camera_objects`: `fewview_job`, the job's folder, and
`fewview_role`. Work is done in steps short enough for a timer: reading, and all that is arithmetic, in a
thread that knows nothing of Blender, and the rest in a few steps. Between two steps the user may undo,
which takes away what was half made: then it is begun again.
"""

from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from . import colours
from .camera_objects import BAKED, JOB, ROLE
from .heat_map import SUPPORT
from .mesh_arrays import MeshArrays, mesh_arrays
from .ply import PlyMesh, read_ply
from .scenes import scene_named

MESH, PREVIEW = "mesh", "preview"
"""Values of `fewview_role`."""
_PATIENCE_S = 0.002
"""For the thread, in each step: who calls without a window has nothing else to do."""

T = TypeVar("T")
Stepwise = Generator[None, None, T]
"""Work in steps that gives something at its end."""


@dataclass(frozen=True, kw_only=True)
class MeshImport:
    """What is to be shown, and where."""

    job: str
    """The job's folder."""
    scene_name: str
    world_from_solved: NDArray[np.float64]
    """(4, 4) similarity; baked into the vertices."""
    name: str = ""
    """Of the result; that of the job's folder where this is empty."""
    texture: Path | None = None
    """The picture that the mesh's coordinates are for; it becomes a part of the .blend file."""
    parent_uid: int | None = None
    """`session_uid` of the object that the result shall follow when it is moved."""


def read_in_steps(path: Path) -> Stepwise[PlyMesh]:
    """A mesh with triangles. Raises as `read_ply` does, and ValueError where there are none."""
    mesh = yield from _in_thread(partial(read_ply, path))
    if not len(mesh.faces):
        raise ValueError(f"{path.name} has no triangles")
    return mesh


def import_mesh(mesh: PlyMesh, wanted: MeshImport) -> Stepwise[None]:
    """Show a result: smooth, coloured, selected, and known to `scene.fewview.result`.

    The caller pushes the undo step, at once: there is no step after the one that shows it. Raises
    ValueError where it would lie out of reach.
    """
    arrays = yield from _in_thread(partial(mesh_arrays, mesh, wanted.world_from_solved))
    uid = yield from _build(wanted.name or Path(wanted.job).name or "FewView", arrays)
    _show_result(uid, arrays, wanted)


def show_preview(path: Path, wanted: MeshImport) -> Stepwise[None]:
    """Show a preview in place of the last one; points without triangles are shown as vertices.

    No undo step. Raises as `read_ply` and `import_mesh` do.
    """
    arrays = yield from _in_thread(lambda: mesh_arrays(read_ply(path), wanted.world_from_solved))
    uid = yield from _build("FewView Preview", arrays)
    mesh = _mesh_or_none(uid)
    assert mesh is not None
    if arrays.colours_srgb is not None:
        colours.show_in_viewports(mesh)
    scene = scene_named(wanted.scene_name)
    preview = next((made for made in scene.objects if made.get(ROLE) == PREVIEW), None)
    if preview is None:
        preview = bpy.data.objects.new("FewView Preview", mesh)
        preview[JOB], preview[ROLE] = wanted.job, PREVIEW
        preview.hide_select = preview.hide_render = True  # it is gone in a moment
        scene.collection.objects.link(preview)
    else:
        before, preview.data = preview.data, mesh
        if before.users == 0:
            bpy.data.meshes.remove(before)
    yield


def remove_preview() -> None:
    """Remove the preview, as the result comes or the job ends."""
    for preview in [made for made in bpy.data.objects if made.get(ROLE) == PREVIEW and made.library is None]:
        mesh = preview.data
        bpy.data.objects.remove(preview)
        if mesh is not None and mesh.users == 0:
            bpy.data.meshes.remove(mesh)


def view_layer_of(scene: bpy.types.Scene) -> bpy.types.ViewLayer:
    """The view layer that a window shows of the scene, or else its first."""
    windows = bpy.context.window_manager.windows
    return next((window.view_layer for window in windows if window.scene == scene), scene.view_layers[0])


def select_alone(scene: bpy.types.Scene, made: bpy.types.Object) -> None:
    """Select the object and make it active, unless the user is in a mode that this would disturb."""
    view_layer = view_layer_of(scene)
    active = view_layer.objects.active
    if (active is not None and active.mode != "OBJECT") or made.name not in view_layer.objects:
        return
    for other in view_layer.objects:
        if other.select_get(view_layer=view_layer):
            other.select_set(False, view_layer=view_layer)
    made.select_set(True, view_layer=view_layer)
    view_layer.objects.active = made


def _in_thread(work: Callable[[], T]) -> Stepwise[T]:
    """What `work`, which must not touch Blender, returns or raises; meanwhile steps that do nothing."""
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="FewView reads") as reader:
        result = reader.submit(work)
        while not result.done():
            yield
            wait([result], timeout=_PATIENCE_S)
    return result.result()


def _build(name: str, arrays: MeshArrays) -> Stepwise[int]:
    """The `session_uid` of a new mesh, which nothing uses yet."""
    uid, done = 0, 0
    while done < len(_WORKS):
        mesh = _mesh_or_none(uid)
        if mesh is None:  # the first time, or undone
            mesh, done = bpy.data.meshes.new(name), 0
            uid = mesh.session_uid
        _WORKS[done](mesh, arrays)
        done += 1
        if done < len(_WORKS):  # no step between the last work and the use of the mesh: nothing can be undone
            yield
    return uid


def _mesh_or_none(uid: int) -> bpy.types.Mesh | None:
    return next((mesh for mesh in bpy.data.meshes if mesh.session_uid == uid), None)


def _add_vertices(mesh: bpy.types.Mesh, arrays: MeshArrays) -> None:
    mesh.vertices.add(len(arrays.positions))
    mesh.edges.add(len(arrays.edges))


def _add_corners(mesh: bpy.types.Mesh, arrays: MeshArrays) -> None:
    mesh.loops.add(len(arrays.corner_vertices))


def _fill_topology(mesh: bpy.types.Mesh, arrays: MeshArrays) -> None:
    _fill(mesh, "position", "vector", arrays.positions)
    _fill(mesh, ".edge_verts", "value", arrays.edges)
    _fill(mesh, ".corner_vert", "value", arrays.corner_vertices)
    _fill(mesh, ".corner_edge", "value", arrays.corner_edges)


def _add_faces(mesh: bpy.types.Mesh, arrays: MeshArrays) -> None:
    mesh.polygons.add(arrays.num_faces)
    mesh.polygons.foreach_set("loop_start", arrays.face_starts)


def _add_attributes(mesh: bpy.types.Mesh, arrays: MeshArrays) -> None:
    mesh.update()  # smooth: a new mesh is, until something marks its faces as sharp
    if arrays.support is not None:
        mesh.attributes.new(SUPPORT.attribute, "FLOAT", "POINT")
        _fill(mesh, SUPPORT.attribute, "value", arrays.support)
    if arrays.colours_srgb is not None:
        mesh.color_attributes.new(colours.COLOUR, "BYTE_COLOR", "POINT")
        # The bytes of the file are sRGB and stay what they are; `color` would take linear light.
        _fill(mesh, colours.COLOUR, "color_srgb", arrays.colours_srgb)
        colours.show(mesh, "COLOUR")
    if arrays.corner_coordinates is not None:
        mesh.uv_layers.new(name=colours.UV_MAP, do_init=False)
        _fill(mesh, colours.UV_MAP, "vector", arrays.corner_coordinates)


_WORKS = (_add_vertices, _add_corners, _fill_topology, _add_faces, _add_attributes)
"""In this order; each is short, as what takes time is memory that Blender fills for the first time."""


def _fill(mesh: bpy.types.Mesh, attribute: str, field: str, values: NDArray[Any]) -> None:
    """Through the attribute, which is a copy of memory; `vertices`, `loops` and `edges` go one by one."""
    if values.size:
        mesh.attributes[attribute].data.foreach_set(field, np.ascontiguousarray(values).ravel())


def _texture_or_none(path: Path | None) -> bpy.types.Image | None:
    """The picture, packed: the job's folder may be removed. Without it the vertices' colours are shown."""
    if path is None or not path.is_file():
        return None
    image = bpy.data.images.load(str(path))
    image.name = "FewView Texture"
    image.pack()
    return image


def _show_result(uid: int, arrays: MeshArrays, wanted: MeshImport) -> None:
    """The finished mesh as an object of the scene."""
    mesh = _mesh_or_none(uid)
    assert mesh is not None
    scene = scene_named(wanted.scene_name)
    if arrays.colours_srgb is not None:
        texture = None if arrays.corner_coordinates is None else _texture_or_none(wanted.texture)
        mesh.materials.append(colours.make_material("FewView Colors", arrays.mean_linear, texture))
        colours.show(mesh, "COLOUR")
        colours.show_in_viewports(mesh)
    remove_preview()
    made = bpy.data.objects.new(mesh.name, mesh)
    made[JOB], made[ROLE] = wanted.job, MESH
    made[BAKED] = wanted.world_from_solved.ravel().tolist()
    scene.collection.objects.link(made)
    parent = next((o for o in scene.objects if o.session_uid == wanted.parent_uid), None)
    if parent is not None:
        made.parent = parent
        made.matrix_parent_inverse = Matrix(np.linalg.inv(np.array(parent.matrix_world)).tolist())
    scene.fewview.result = made
    select_alone(scene, made)
