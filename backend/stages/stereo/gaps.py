"""Which patches of the backdrop's colour within a photograph's subject are gaps that show the backdrop.

A highlight that is blown out before white has that colour too. Through a gap nothing is seen, so no other
photograph has measured anything there; a highlight moves with the camera, and the others measure the
surface that it hides.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import binary_erosion, sum_labels

from ...maths.pieces import whole_pieces
from ...maths.projection import projected, shown
from ...scene import Camera, DepthMap, Region, SurfacePoints, View, transform_points
from ..measurements import SURE

_WITHIN_PX = 3
"""From a patch's outline: a point that falls nearer may belong to the surface beside it."""
_LEAST_COVER = 0.05
"""Of the density of points on what is not empty: a patch that others cover so densely is no gap."""


def without_covered_patches(
    maps: tuple[DepthMap, ...], points: SurfacePoints, views: tuple[View, ...], region: Region
) -> tuple[DepthMap, ...]:
    """The maps, with patches where other photographs have measured the surface no longer `empty`."""
    sure = points.confidence > SURE
    view_index = points.view_index[sure]
    world = transform_points(region.world_from_object, points.positions[sure].astype(np.float64))
    return tuple(
        _without_covered(map_, world[view_index != index], view.camera)
        for index, (map_, view) in enumerate(zip(maps, views, strict=True))
    )


def _without_covered(
    map_: DepthMap, others_world: Float64[np.ndarray, "points 3"], camera: Camera
) -> DepthMap:
    if map_.empty is None:
        return map_
    patches = whole_pieces(map_.empty)
    enclosed = np.unique(patches[patches > 0])
    if not len(enclosed):
        return map_
    pixels, depth = projected(others_world, camera)
    column, row = pixels[shown(pixels, depth, camera)].astype(int).T
    hits = np.zeros(map_.empty.shape)
    np.add.at(hits, (row, column), 1)
    inner = binary_erosion(map_.empty, iterations=_WITHIN_PX)
    area, found = (sum_labels(values, patches, enclosed) for values in (inner, hits * inner))
    covered = enclosed[found > _LEAST_COVER * area * hits[~map_.empty].mean()]
    return replace(map_, empty=map_.empty & ~np.isin(patches, covered))
