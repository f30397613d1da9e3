"""The true surface of a scene, and what exact cameras see of it."""

import numpy as np
from mathutils import Vector
from mathutils.bvhtree import BVHTree
from numpy.typing import NDArray

from addon.true_mesh import TrueMesh, bounding_sphere, signed_volume, true_mesh, vertex_normals, write_ply
from addon.view_layout import Lens

__all__ = [
    "TrueMesh",
    "bounding_sphere",
    "depth_and_normals",
    "ray_caster",
    "signed_volume",
    "true_mesh",
    "vertex_normals",
    "write_ply",
]


def ray_caster(mesh: TrueMesh) -> BVHTree:
    """A search tree over the triangles."""
    return BVHTree.FromPolygons(mesh.vertices.tolist(), mesh.faces.tolist(), all_triangles=True)


def depth_and_normals(
    tree: BVHTree, lens: Lens, world_from_camera: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What the camera sees through the centre of each pixel.

    (height, width) depth along the optical axis in metres, inf where nothing; (height, width, 3)
    normals of the triangles that were hit, world frame, 0 where nothing. Rays are cast rather than
    passes rendered: a pass mixes surfaces at edges and is read back differently in every Blender.
    """
    columns, rows = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    in_camera = np.stack(
        [
            (columns - lens.width / 2) / lens.focal_px,
            -(rows - lens.height / 2) / lens.focal_px,
            -np.ones_like(rows),
        ],
        axis=-1,
    ).reshape(-1, 3)
    lengths = np.linalg.norm(in_camera, axis=1)
    in_world = (in_camera / lengths[:, None]) @ world_from_camera[:3, :3].T
    origin = Vector(world_from_camera[:3, 3])
    depth = np.full(len(in_world), np.inf, np.float32)
    normals = np.zeros((len(in_world), 3), np.float32)
    for pixel, direction in enumerate(in_world.tolist()):
        _, normal, _, distance = tree.ray_cast(origin, direction)
        if distance is not None:
            depth[pixel] = distance / lengths[pixel]
            normals[pixel] = normal
    return depth.reshape(lens.height, lens.width), normals.reshape(lens.height, lens.width, 3)
