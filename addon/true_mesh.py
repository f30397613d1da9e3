"""Objects of a scene as one mesh in the world frame, modifiers and instances included."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

WITH_SURFACE = frozenset({"MESH", "CURVE", "SURFACE", "META", "FONT"})
"""Types of objects that Blender can turn into a mesh."""
FLAT = 1e-6
"""Volume over the cube of the size, below which a sheet has no inside that could tell its front."""


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
    """The object and all its children: what a target stands for."""
    return (target, *target.children_recursive)


def true_mesh(objects: tuple[Any, ...]) -> TrueMesh:
    """The objects as the viewport has them, modifiers and instances included, in one mesh.

    Raises ValueError where they have no surface, or none that is visible.
    """
    bpy.context.view_layer.update()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    order = {made: index for index, made in enumerate(objects)}
    found: list[tuple[int, TrueMesh]] = []
    for instance in depsgraph.object_instances:
        owner = (instance.parent if instance.is_instance else instance.object).original
        if owner in order and instance.show_self and instance.object.type in WITH_SURFACE:
            part = evaluated_mesh(instance.object, np.array(instance.matrix_world, np.float64))
            found.append((order[owner], part))
    parts = [part for _, part in sorted(found, key=lambda item: item[0]) if len(part.faces)]
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
