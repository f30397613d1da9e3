"""A mesh as the arrays that Blender stores, ready to be handed over; numpy, no Blender needed.

Everything that takes long is done here, where it may run in a thread: Blender would keep its user waiting
while it finds the edges and checks the faces.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .ply import PlyMesh

_LARGEST_COORDINATE = 1e9
"""As in the wire's protocol; far below what a float overflows at."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MeshArrays:
    """Blender's attributes of a mesh; indices are in range, no face or edge is there twice."""

    positions: NDArray[np.float32]
    """(vertices, 3), in the world frame."""
    edges: NDArray[np.int32]
    """(edges, 2): vertices."""
    corner_vertices: NDArray[np.int32]
    """(3 faces,)."""
    corner_edges: NDArray[np.int32]
    """(3 faces,): the edge from each corner to the next."""
    face_starts: NDArray[np.int32]
    """(faces,): each face's first corner."""
    colours_srgb: NDArray[np.float32] | None
    """(vertices, 4), 0 to 1 in steps of 1/255."""
    mean_linear: tuple[float, float, float]
    """Mean colour in linear light; grey where there are no colours."""
    support: NDArray[np.float32] | None
    """(vertices,)."""
    corner_coordinates: NDArray[np.float32] | None
    """(3 faces, 2): the UV map; None where there is no texture."""

    @property
    def num_faces(self) -> int:
        """Number of triangles."""
        return len(self.face_starts)


def mesh_arrays(mesh: PlyMesh, world_from_solved: NDArray[np.float64]) -> MeshArrays:
    """The arrays of a mesh that a similarity (4, 4) places in the world.

    Faces that use a vertex twice or are there twice are left out, as Blender's validation would do.
    Raises ValueError where the placed mesh would lie out of reach.
    """
    positions = mesh.positions @ world_from_solved[:3, :3].T + world_from_solved[:3, 3]
    if positions.size and not np.abs(positions).max() <= _LARGEST_COORDINATE:  # also for NaN
        raise ValueError("the mesh lies too far away or is too large for Blender")
    proper = are_proper(mesh.faces)
    faces = mesh.faces[proper]
    edges, corner_edges = edges_of(faces, len(positions))
    colours = None if mesh.colours_srgb is None else mesh.colours_srgb.astype(np.float32) / np.float32(255)
    return MeshArrays(
        positions=positions.astype(np.float32),
        edges=edges,
        corner_vertices=np.ascontiguousarray(faces).ravel(),
        corner_edges=corner_edges,
        face_starts=np.arange(0, 3 * len(faces), 3, dtype=np.int32),
        colours_srgb=colours,
        mean_linear=_mean_linear(mesh.colours_srgb),
        support=mesh.support,
        corner_coordinates=None if mesh.coordinates is None else mesh.coordinates[proper].reshape(-1, 2),
    )


def are_proper(faces: NDArray[np.int32]) -> NDArray[np.bool_]:
    """(faces,): whether each is of three different vertices, and the first of its triple."""
    a, b, c = np.sort(faces, axis=1).T
    order = np.lexsort((c, b, a))
    same = np.zeros(len(faces), bool)
    same[order[1:]] = (np.diff(a[order]) == 0) & (np.diff(b[order]) == 0) & (np.diff(c[order]) == 0)
    return (a != b) & (b != c) & ~same


def edges_of(faces: NDArray[np.int32], num_vertices: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Edges (edges, 2) of triangles, each once, and the edge (3 faces,) from each corner to the next."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    keys = np.minimum(start, end).astype(np.int64) * max(num_vertices, 1) + np.maximum(start, end)
    found, corner_edges = np.unique(keys, return_inverse=True)
    edges = np.stack(np.divmod(found, max(num_vertices, 1)), axis=-1)
    return edges.astype(np.int32), corner_edges.ravel().astype(np.int32)


def linear_from_srgb(srgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """IEC 61966-2-1; same shape."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).astype(np.float32)


def _mean_linear(colours_srgb: NDArray[np.uint8] | None) -> tuple[float, float, float]:
    if colours_srgb is None or not len(colours_srgb):
        return (0.5, 0.5, 0.5)
    linear = linear_from_srgb(np.arange(256, dtype=np.float32) / np.float32(255))
    red, green, blue = (float(linear[colours_srgb[:, channel]].mean()) for channel in range(3))
    return (red, green, blue)
