"""The surface of points alone as a mesh."""

import numpy as np

from ..maths.grid import spacing
from ..scene import Progress, SurfaceMesh
from .mesh import (
    MeshConfig,
    level_set,
    measured_share,
    only_used,
    simplified,
    vertex_normals,
    without_small_pieces,
)
from .point_cloud import PointCloud
from .train import Surface

_GREY = 180


def mesh_of_points(
    surface: Surface, cloud: PointCloud, config: MeshConfig, *, progress: Progress
) -> SurfaceMesh:
    """The zero level as a grey mesh in the world frame; `support` is how near points are."""
    progress(0.0, "level set")
    vertices, faces = level_set(surface)
    faces = without_small_pieces(vertices, faces, config.smallest_piece)
    vertices, faces = only_used(vertices, faces)
    progress(0.4, "simplifying")
    vertices, faces = simplified(vertices, faces, config.max_faces)
    progress(0.8, "support")
    cell = spacing(len(surface.distance)) / np.cbrt(np.linalg.det(surface.grid_from_world[:3, :3]))
    sure = np.ones(len(cloud.positions), np.float32)
    return SurfaceMesh(
        vertices=vertices,
        faces=faces,
        normals=vertex_normals(vertices, faces).astype(np.float32),
        colours_srgb=np.full((len(vertices), 3), _GREY, np.uint8),
        support=measured_share(vertices, cloud.positions, sure, cell).astype(np.float32),
        decisions=surface.decisions,
    )
