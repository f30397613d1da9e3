"""How far places are from a mesh."""

import numpy as np
import trimesh

from backend.maths.nearest import nearest_tree


def from_surface(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Distance of each point from the nearest triangle; those whose middles are nearest are asked."""
    triangles = vertices[faces]
    _, near = nearest_tree(triangles.mean(axis=1)).query(points, k=32)
    repeated = np.repeat(points, 32, axis=0)
    closest = trimesh.triangles.closest_point(triangles[near.ravel()], repeated)
    return np.asarray(np.linalg.norm(closest - repeated, axis=1).reshape(-1, 32).min(axis=1))
