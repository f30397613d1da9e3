"""The points of an object of the scene in the world frame: what a surface is fitted to."""

from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..backend.point_methods import FEWEST_POINTS
from .true_mesh import evaluated_mesh

WITH_POINTS = frozenset({"MESH", "POINTCLOUD"})
"""Types of objects."""
_NORMAL = ("normal", "Normal")
"""Names of attributes that hold one."""


@dataclass(frozen=True, kw_only=True)
class ObjectPoints:
    """Points in the world frame."""

    positions: NDArray[np.float64]
    """(points, 3), metres."""
    normals: NDArray[np.float64] | None
    """(points, 3), unit, outwards; 0 where a point has none."""


def reason_against(made: bpy.types.Object | None) -> str:
    """Why no surface can be fitted to the object, for a tooltip; empty where it may."""
    if made is None or made.type not in WITH_POINTS:
        return "Select a mesh or a point cloud first"
    # With modifiers nobody knows before they are evaluated, which is too slow for a tooltip.
    count = len(made.data.vertices if made.type == "MESH" else made.data.points)
    if count < FEWEST_POINTS and not made.modifiers:
        return f"Only {count} points are in {made.name}, and {FEWEST_POINTS} are needed"
    return ""


def points_of(made: bpy.types.Object, *, normals_known: bool) -> ObjectPoints:
    """The object's vertices or points as the viewport has them, modifiers and instances included.

    Normals are left out unless they are known: those of its attribute `normal`, or where there is none its
    faces'. Raises ValueError where nothing is visible, or normals are known and there are none.
    """
    bpy.context.view_layer.update()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    found = []
    for instance in depsgraph.object_instances:
        owner = (instance.parent if instance.is_instance else instance.object).original
        if owner == made and instance.show_self and instance.object.type in WITH_POINTS:
            part = _evaluated(instance.object, np.array(instance.matrix_world, np.float64), normals_known)
            found.append(part)
    found = [part for part in found if len(part.positions)]
    if not found:
        raise ValueError(f"{made.name} has no visible points")
    normals = [part.normals for part in found if part.normals is not None]
    if normals_known and len(normals) < len(found):
        raise ValueError(
            f"{made.name} has neither normals nor faces to tell them: switch Normals Are Known off"
        )
    return ObjectPoints(
        positions=np.concatenate([part.positions for part in found]),
        normals=np.concatenate(normals) if normals_known else None,
    )


def _evaluated(made: Any, world_from_object: NDArray[np.float64], normals_known: bool) -> ObjectPoints:
    is_mesh = made.type == "MESH"
    data = made.to_mesh() if is_mesh else made.data
    positions = _vectors(data, "position")
    names = _NORMAL if normals_known else ()
    normals = next((found for name in names if (found := _vectors(data, name)) is not None), None)
    if is_mesh:
        made.to_mesh_clear()
    rotation = world_from_object[:3, :3]
    if normals is not None:
        normals = _unit(normals @ _cofactors(rotation).T)
    elif normals_known and is_mesh:
        faced = evaluated_mesh(made, world_from_object)
        normals = faced.normals if len(faced.faces) else None
    if positions is None:  # a point cloud without points has no attributes
        positions = np.zeros((0, 3))
    return ObjectPoints(positions=positions @ rotation.T + world_from_object[:3, 3], normals=normals)


def _vectors(data: Any, name: str) -> NDArray[np.float64] | None:
    """(points, 3): an attribute; None where there is none of vectors at points."""
    found = data.attributes.get(name)
    if found is None or (found.data_type, found.domain) != ("FLOAT_VECTOR", "POINT"):
        return None
    flat = np.empty(3 * len(found.data), np.float32)
    found.data.foreach_get("vector", flat)
    return flat.reshape(-1, 3).astype(np.float64)


def _cofactors(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3): what turns normals as the matrix turns points, outwards again where it mirrors.

    The inverse transposed, up to a positive factor, and finite where there is no inverse.
    """
    x, y, z = matrix
    cofactors = np.stack([np.cross(y, z), np.cross(z, x), np.cross(x, y)])
    return -cofactors if np.linalg.det(matrix) < 0 else cofactors


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of length 1; 0 where they are 0 or no numbers."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    unit: NDArray[np.float64] = np.divide(
        vectors, lengths, out=np.zeros_like(vectors), where=(lengths > 0) & np.isfinite(lengths)
    )
    return unit
