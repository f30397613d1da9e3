"""Objects of a scene as one mesh in the world frame, as renders show them, modifiers and instances included.

Only the viewport's surface can be read: `as_rendered` makes it that of renders for a while. Not to be called
while Blender draws, when nothing may be written to the scene.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from .kept_settings import Change, changed

WITH_SURFACE = frozenset({"MESH", "CURVE", "SURFACE", "META", "FONT"})
"""Types of objects that Blender can turn into a mesh."""
FLAT = 1e-6
"""Volume over the cube of the size, below which a sheet has no inside that could tell its front."""
_OF_RENDERS = {
    "show_viewport": "show_render",
    "levels": "render_levels",
    "steps": "render_steps",
    "viewport_resolution": "resolution",
    "show_instancer_for_viewport": "show_instancer_for_render",
    "child_percent": "rendered_child_count",
    "simplify_subdivision": "simplify_subdivision_render",
    "simplify_child_particles": "simplify_child_particles_render",
}
"""Settings of the viewport, and those that take their place in renders, wherever something has both."""


@dataclass(frozen=True, kw_only=True)
class TrueMesh:
    """Triangles in the world frame, counter-clockwise seen from outside."""

    vertices: NDArray[np.float64]
    """(vertices, 3), metres."""
    normals: NDArray[np.float64]
    """(vertices, 3), unit."""
    faces: NDArray[np.int32]
    """(faces, 3)."""


def subject_of(target: Any) -> tuple[Any, ...]:
    """The object and those of its children that renders show: what a target stands for."""
    rendered = rendered_objects(bpy.context.view_layer)
    return (target, *(child for child in target.children_recursive if child in rendered))


def rendered_objects(view_layer: Any) -> set[Any]:
    """What renders of the view layer show, whether the viewport does or not."""
    layers = (layer for layer in _rendered_layers(view_layer) if not layer.exclude)
    return {made for layer in layers for made in layer.collection.objects if not made.hide_render}


@contextmanager
def as_rendered(objects: tuple[Any, ...]) -> Iterator[None]:
    """Let the viewport have these objects, and what they are instances of, as renders do."""
    collections = _instanced_collections(objects)
    inside = {made for collection in collections for made in collection.objects}
    around = [
        owner
        for layer in _rendered_layers(bpy.context.view_layer)
        if not set(objects).isdisjoint(layer.collection.all_objects)
        for owner in (layer, layer.collection)
    ]
    shown = [(owner, "hide_viewport", False) for owner in (*objects, *around)]
    shown += [(part, "hide_viewport", part.hide_render) for part in (*collections, *inside)]
    first = _differing([*shown, *_as_in_renders({bpy.context.scene.render, *objects, *inside})])
    with _unhidden(objects), changed(first):
        others = _instanced(objects) - inside  # only now modifiers make all that they make in renders
        with changed(_differing(_as_in_renders(others))):
            yield


def instanced_by(objects: tuple[Any, ...]) -> set[Any]:
    """Objects that appear as parts of these, by a collection, particles or Geometry Nodes."""
    with as_rendered(objects):
        return _instanced(objects)


def true_mesh(objects: tuple[Any, ...]) -> TrueMesh:
    """The objects as renders show them, modifiers and instances included, in one mesh.

    Raises ValueError where they have no surface, or none that is visible.
    """
    with as_rendered(objects):
        return _viewport_mesh(objects)


def _rendered_layers(view_layer: Any) -> Iterator[Any]:
    """Layer collections that are not hidden from renders; those that are excluded among them."""
    waiting = [view_layer.layer_collection]
    while waiting:
        layer = waiting.pop()
        if not layer.collection.hide_render:
            yield layer
            waiting.extend(layer.children)


@contextmanager
def _unhidden(objects: tuple[Any, ...]) -> Iterator[None]:
    """Without the closed eyes of the outliner, which renders do not look at."""
    hidden = [made for made in objects if made.hide_get()]
    for made in hidden:
        made.hide_set(False)
    try:
        yield
    finally:
        for made in hidden:
            made.hide_set(True)


def _instanced_collections(objects: Iterable[Any]) -> set[Any]:
    """Collections that empties show, with those inside."""
    found: set[Any] = set()
    waiting = list(objects)
    while waiting:
        made = waiting.pop()
        if made.instance_type != "COLLECTION" or made.instance_collection is None:
            continue
        inside = {made.instance_collection, *made.instance_collection.children_recursive} - found
        found |= inside
        waiting.extend(part for collection in inside for part in collection.objects)
    return found


def _as_in_renders(owners: Iterable[Any]) -> list[Change]:
    """The viewport's settings as those of renders: of these owners, their modifiers and particles."""
    everything, changes = [], []
    for owner in owners:
        particles = [system.settings for system in getattr(owner, "particle_systems", ())]
        changes += [(settings, "display_percentage", 100) for settings in particles]
        everything += [owner, *getattr(owner, "modifiers", ()), *particles]
    changes += [
        (owner, shown, getattr(owner, rendered))
        for owner in everything
        for shown, rendered in _OF_RENDERS.items()
        if hasattr(owner, shown) and hasattr(owner, rendered)
    ]
    return changes


def _differing(changes: Iterable[Change]) -> list[Change]:
    """Without those that change nothing: Blender would compute the objects again."""
    return [(owner, name, value) for owner, name, value in changes if getattr(owner, name) != value]


def _instanced(objects: tuple[Any, ...]) -> set[Any]:
    bpy.context.view_layer.update()
    return {
        instance.object.original
        for instance in bpy.context.evaluated_depsgraph_get().object_instances
        if instance.is_instance and instance.parent.original in objects
    }


def _viewport_mesh(objects: tuple[Any, ...]) -> TrueMesh:
    bpy.context.view_layer.update()
    order = {made: index for index, made in enumerate(objects)}
    meshes: dict[tuple[int, Any], list[TrueMesh]] = {}
    others: dict[tuple[int, Any], list[TrueMesh]] = {}
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        made = instance.object
        owner = (instance.parent if instance.is_instance else made).original
        if owner in order and instance.show_self and made.type in WITH_SURFACE:
            part = evaluated_mesh(made, np.array(instance.matrix_world, np.float64))
            if len(part.faces):
                kind = meshes if made.type == "MESH" else others
                kind.setdefault((order[owner], made.original), []).append(part)
    # What curves, texts and the like evaluate to comes once more, as a mesh.
    found = sorted({**others, **meshes}.items(), key=lambda item: item[0][0])
    parts = [part for _, same in found for part in same]
    if not parts:
        raise ValueError("there is no visible surface")
    first_vertex = np.cumsum([0] + [len(part.vertices) for part in parts])
    return TrueMesh(
        vertices=np.concatenate([part.vertices for part in parts]),
        normals=np.concatenate([part.normals for part in parts]),
        faces=np.concatenate(
            [part.faces + np.int32(first) for part, first in zip(parts, first_vertex, strict=False)]
        ),
    )


def evaluated_mesh(made: Any, world_from_object: NDArray[np.float64]) -> TrueMesh:
    """An evaluated object in the world frame; one that is closed faces outwards.

    Without faces its normals are 0.
    """
    mesh = made.to_mesh()
    mesh.calc_loop_triangles()
    vertices = np.empty(len(mesh.vertices) * 3, np.float32)
    faces = np.empty(len(mesh.loop_triangles) * 3, np.int32)
    mesh.vertices.foreach_get("co", vertices)
    mesh.loop_triangles.foreach_get("vertices", faces)
    made.to_mesh_clear()
    vertices_world = vertices.reshape(-1, 3) @ world_from_object[:3, :3].T + world_from_object[:3, 3]
    triangles = faces.reshape(-1, 3)
    if not len(triangles):
        return TrueMesh(vertices=vertices_world, normals=np.zeros_like(vertices_world), faces=triangles)
    if np.linalg.det(world_from_object[:3, :3]) < 0:  # a mirror turns the triangles round
        triangles = triangles[:, ::-1]
    extent = np.linalg.norm(np.ptp(vertices_world, axis=0))
    if signed_volume(vertices_world, triangles) < -FLAT * extent**3:
        triangles = triangles[:, ::-1]
    normals = vertex_normals(vertices_world, triangles)
    return TrueMesh(vertices=vertices_world, normals=normals, faces=triangles)


def vertex_normals(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    """(vertices, 3): mean of the triangles' normals by area; 0 where a vertex has no triangle.

    Computed here because Blender's own are those that a file brought, where it brought any.
    """
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sums = np.stack(
        [
            np.bincount(faces.ravel(), weights=np.repeat(across[:, axis], 3), minlength=len(vertices))
            for axis in range(3)
        ],
        axis=-1,
    )
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    normals: NDArray[np.float64] = np.divide(sums, lengths, out=np.zeros_like(sums), where=lengths > 0)
    return normals


def signed_volume(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> float:
    """Volume in cubic metres, positive where the triangles face outwards; about the centre where open."""
    corners = (vertices - vertices.mean(axis=0))[faces]
    return float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0)


def bounding_sphere(mesh: TrueMesh) -> tuple[NDArray[np.float64], float]:
    """Centre of the bounding box and distance of the farthest vertex from it."""
    centre = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    return centre, float(np.linalg.norm(mesh.vertices - centre, axis=1).max())


def write_ply(path: Path, mesh: TrueMesh) -> None:
    """Binary PLY with vertex normals; float32 coordinates."""
    vertex = np.hstack([mesh.vertices, mesh.normals]).astype("<f4")
    face = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    face["count"], face["corners"] = 3, mesh.faces
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertex)}\n{properties}"
        f"element face {len(face)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path.write_bytes(header.encode("ascii") + vertex.tobytes() + face.tobytes())
