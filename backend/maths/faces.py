"""What the triangles of a mesh are by themselves."""

import numpy as np
from jaxtyping import Float64, Int64


def area_vectors(
    vertices: Float64[np.ndarray, "vertices 3"], faces: Int64[np.ndarray, "faces 3"]
) -> Float64[np.ndarray, "faces 3"]:
    """Normals of the faces, outwards where these are counter-clockwise, twice as long as their areas."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def face_areas(
    vertices: Float64[np.ndarray, "vertices 3"], faces: Int64[np.ndarray, "faces 3"]
) -> Float64[np.ndarray, "faces"]:
    """Area of every face."""
    return np.asarray(np.linalg.norm(area_vectors(vertices, faces), axis=1) / 2)
