"""Detail: what stereo measured, on a finer grid than the one on which sides are told apart.

Silhouettes and free space are inequalities about where the subject may be at all. Asking them costs most of a
fit, and a finer grid does not answer them better. So on this grid points alone speak, and where none does the
field is held as it was. How fine it is, pixels say, and how well two photographs agree on a place: a finer
grid shows their noise.
"""

import math
from collections.abc import Callable
from statistics import median

import torch
from jaxtyping import Float
from torch import Tensor

from ...maths.evidence import PointDistances, cell_px, scatter_between
from ...maths.grid import refined, spacing
from ...maths.smooth_fit import fit_smooth
from ...scene import Decision
from ..measurements import Measurements
from .linear_fit import LinearConfig, for_textured, points_near_nodes, stereo_weights

_LEAST_PX = 1.5
"""Side of a cell in pixels: patches of seven show nothing finer."""
_MOST_SCATTER = 0.075
"""Of the places that two photographs measure, in cells. Measured, with 256 nodes: 0.03 to 0.07 where a finer
grid makes errors less or photographs clearer, 0.10 to 0.20 where it makes what is smooth uneven."""
_WORTH_IT = 1.5
"""Times as many nodes along each axis as the field has, at least."""
_HELD = 1.0
"""Weight of the field as it was, beside that of points, where there are none."""
_SPEAKING = 0.1
"""Weight of points with which they half let go of it."""
_STEPS = 30
"""Of conjugate gradients."""


def add_detail(
    scene: Measurements,
    distance: Float[Tensor, "coarse coarse coarse"],
    most: int,
    config: LinearConfig,
    there_is_time: Callable[[int], bool],
) -> tuple[Float[Tensor, "nodes nodes nodes"], Decision]:
    """The field on up to `most` nodes along each axis, with detail if there is such, or as it was; and why.

    `there_is_time` for so many nodes.
    """
    coarse, config = len(distance), for_textured(config)
    if most < _WORTH_IT * coarse:
        return distance, Decision(what="detail", choice="left out", because="the preset")
    px = median(cell_px(camera, coarse) for camera in scene.cameras)
    weights = stereo_weights(scene, config)
    scatter = scatter_between(scene.positions, scene.normals, weights, scene.view_index, spacing(coarse) / 2)
    cells = scatter / spacing(coarse)
    nodes = min(most, int(coarse * min(px / _LEAST_PX, _MOST_SCATTER / max(cells, torch.finfo().tiny))))
    because = f"a cell of the grid is {px:.1f} pixels wide, and " + (
        f"two photographs differ by {cells:.2f} cells"
        if math.isfinite(cells)
        else "hardly any place was measured by two photographs"
    )
    wanted = nodes >= _WORTH_IT * coarse
    if not wanted or not there_is_time(nodes):
        because += "; there is no time left" if wanted else ""
        return distance, Decision(what="detail", choice="left out", because=because)
    measured = points_near_nodes(scene, config, nodes)
    detail = Decision(what="detail", choice=f"points on a grid of {nodes}", because=because)
    return held_but_for(refined(distance, nodes), measured, config.smoothness), detail


def held_but_for(
    before: Float[Tensor, "nodes nodes nodes"], measured: PointDistances, smoothness: float
) -> Float[Tensor, "nodes nodes nodes"]:
    """The smoothest field near the points' planes that is as `before` where there are none."""
    held = _HELD / (1 + (measured.weight / _SPEAKING).square())
    weight = held + measured.weight
    target = (held * before + measured.weight * measured.distance) / weight
    return fit_smooth(target, weight, before, smoothness=smoothness, steps=_STEPS)
