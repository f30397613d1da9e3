"""What is done with a result afterwards: fewer triangles, even ones, a file for another program."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import bpy
import numpy as np

from . import colours
from .camera_objects import ROLE
from .mesh_import import MESH, view_layer_of
from .scenes import in_scene

FORMATS = (".glb", ".ply", ".obj", ".stl")
_MODIFIER = "fewview_decimate"
"""Custom property of a result: the name of its Decimate modifier."""
_MOST_VOXELS = 1500
"""Along the diagonal: more fill the memory of a usual computer."""


def result_or_none(context: bpy.types.Context) -> bpy.types.Object | None:
    """The result that is meant: the active object if it is one, or else the one imported last."""
    active = context.view_layer.objects.active
    if active is not None and active.type == "MESH" and active.get(ROLE) == MESH:
        return active
    last = in_scene(context.scene, context.scene.fewview.result)
    return last if last is not None and last.type == "MESH" else None


def decimate(result: bpy.types.Object, ratio: float) -> None:
    """Keep this share of the triangles, by a modifier that can be changed and taken away again."""
    modifier = result.modifiers.get(result.get(_MODIFIER, ""))
    if modifier is None or modifier.type != "DECIMATE":
        modifier = result.modifiers.new("Decimate", "DECIMATE")
        result[_MODIFIER] = modifier.name
    modifier.decimate_type, modifier.ratio = "COLLAPSE", ratio


def usual_voxel(result: bpy.types.Object) -> float:
    """A voxel size that keeps the mesh's detail: the median length of its edges, in its own units."""
    mesh = result.data
    positions = np.empty(3 * len(mesh.vertices), np.float32)
    edges = np.empty(2 * len(mesh.edges), np.int32)
    if not len(edges):
        raise ValueError("The result has no triangles")
    mesh.attributes["position"].data.foreach_get("vector", positions)
    mesh.attributes[".edge_verts"].data.foreach_get("value", edges)
    ends = positions.reshape(-1, 3)[edges.reshape(-1, 2)]
    return float(np.median(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)))


def remesh(context: bpy.types.Context, result: bpy.types.Object, voxel: float) -> None:
    """Even triangles of a closed surface in place of the mesh's own; support and the vertices' colours stay.

    Raises ValueError where the voxels, in the object's units, would be too many or none.
    """
    mesh = result.data
    diagonal = float(np.linalg.norm(np.ptp(np.array(result.bound_box), axis=0)))
    if not 0 < diagonal / _MOST_VOXELS <= voxel:
        raise ValueError(
            f"Voxels of {voxel:.3g} are too small for this mesh: use {diagonal / _MOST_VOXELS:.3g}"
        )
    kind = colours.shown(mesh)
    mesh.remesh_mode, mesh.remesh_voxel_size, mesh.remesh_voxel_adaptivity = "VOXEL", voxel, 0.0
    mesh.use_remesh_preserve_attributes = True
    with context.temp_override(object=result, active_object=result, selected_objects=[result]):
        bpy.ops.object.voxel_remesh()
    result.data.shade_smooth()
    if colours.UV_MAP in result.data.uv_layers:
        # Blender carries it over; where charts met, new triangles would span all that lies between them.
        result.data.uv_layers.remove(result.data.uv_layers[colours.UV_MAP])
    if kind and colours.can_show(result.data, kind):
        colours.show(result.data, kind)


def export(context: bpy.types.Context, result: bpy.types.Object, path: Path) -> None:
    """Write the result, with its modifiers and the colours that it shows, in the format that the name says.

    Raises ValueError, in a sentence for the user, for other formats and where Blender cannot write it.
    """
    texture = colours.texture_or_none(result.data) if colours.shows_texture(result.data) else None
    writers: dict[str, Callable[[str], object]] = {
        ".glb": partial(_write_glb, textured=texture is not None),
        ".ply": lambda name: bpy.ops.wm.ply_export(
            filepath=name, export_selected_objects=True, export_colors="SRGB", export_attributes=True
        ),
        ".obj": partial(_write_obj, texture=texture),
        ".stl": lambda name: bpy.ops.wm.stl_export(filepath=name, export_selected_objects=True),
    }
    write = writers.get(path.suffix.lower())
    if write is None:
        raise ValueError(f"{path.suffix or path.name} is no format for a result: use {', '.join(FORMATS)}")
    materials = path.with_suffix(".mtl")
    if path.suffix.lower() == ".obj" and materials.exists() and not path.exists():
        raise ValueError(f"{materials} exists, of something else, and would be replaced: choose another name")
    with _selected_alone(context, result):
        try:
            write(str(path))
        except (RuntimeError, AttributeError) as error:  # the exporter's own report, or it is switched off
            raise ValueError(f"{path.name} could not be written: {error}") from error
    if not path.is_file():
        raise ValueError(f"{path} could not be written")


def _write_glb(name: str, *, textured: bool) -> None:
    wanted = {
        "use_selection": True,
        "export_apply": True,
        # other programs multiply a texture by the colours of vertices
        "export_vertex_color": "NONE" if textured else "ACTIVE",
        "export_all_vertex_colors": False,
        "export_attributes": True,
        "export_animations": False,
    }
    known = bpy.ops.export_scene.gltf.get_rna_type().properties.keys()  # they change between versions
    bpy.ops.export_scene.gltf(
        filepath=name, export_format="GLB", **{key: value for key, value in wanted.items() if key in known}
    )


def _write_obj(name: str, *, texture: bpy.types.Image | None) -> None:
    """Also the texture, as a file beside under a name that is free: it is packed, which the format cannot."""
    if texture is None:
        bpy.ops.wm.obj_export(filepath=name, export_selected_objects=True, export_colors=True)
        return
    beside = _free_name(Path(name))
    if texture.is_dirty or texture.packed_file is None:  # painted on, or unpacked
        texture.pack()
    beside.write_bytes(texture.packed_file.data)
    before, texture.filepath = texture.filepath, str(beside)
    try:
        bpy.ops.wm.obj_export(filepath=name, export_selected_objects=True, path_mode="STRIP")
    finally:
        texture.filepath = before


def _free_name(path: Path) -> Path:
    names = (path.with_name(f"{path.stem}_texture{number}.png") for number in ("", *range(2, 1000)))
    return next(name for name in names if not name.exists())


@contextmanager
def _selected_alone(context: bpy.types.Context, result: bpy.types.Object) -> Iterator[None]:
    """Blender's exporters write what is selected; afterwards the user's selection is as before."""
    view_layer = view_layer_of(context.scene)
    if not result.visible_get(view_layer=view_layer):
        raise ValueError(f"{result.name} is hidden: show it first")
    active = view_layer.objects.active
    before = [made for made in view_layer.objects if made.select_get(view_layer=view_layer)]
    try:
        for made in before:
            made.select_set(False, view_layer=view_layer)
        result.select_set(True, view_layer=view_layer)
        if not result.select_get(view_layer=view_layer):
            raise ValueError(f"{result.name} cannot be selected: make it selectable first")
        view_layer.objects.active = result
        yield
    finally:
        result.select_set(False, view_layer=view_layer)
        for made in before:
            made.select_set(True, view_layer=view_layer)
        view_layer.objects.active = active
