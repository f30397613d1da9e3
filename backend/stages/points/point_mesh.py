"""The surface of points alone as a mesh."""

import numpy as np

from ...scene import Progress, SurfaceMesh, within
from ..mesh.extraction import MeshConfig, measured_share, simplified_level_set, vertex_normals
from ..surface import Surface
from .point_cloud import PointCloud

_GREY = 180


def mesh_of_points(
    surface: Surface, cloud: PointCloud, config: MeshConfig, *, progress: Progress
) -> SurfaceMesh:
    """The zero level as a grey mesh in the world frame; `support` is how near points are."""
    vertices, faces = simplified_level_set(surface, config, progress=within(progress, 0.0, 0.8))
    progress(0.8, "support")
    sure = np.ones(len(cloud.positions), np.float32)
    return SurfaceMesh(
        vertices=vertices,
        faces=faces,
        normals=vertex_normals(vertices, faces).astype(np.float32),
        colours_srgb=np.full((len(vertices), 3), _GREY, np.uint8),
        support=measured_share(vertices, cloud.positions, sure, surface.reach_world).astype(np.float32),
        decisions=surface.decisions,
    )
