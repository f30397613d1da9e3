"""What is assumed of the side that no photograph shows: a ball behind what was measured."""

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ...maths.angles import widest_angle_deg
from ...maths.geometry import project
from ...maths.grid import node_positions
from ..measurements import Measurements

LEAST_RADIUS = 0.3
"""Of the ball, in half widths of the subject."""
LEAST_BOUNDED_RADIUS = 0.5
"""The same where silhouettes bound the depth: they cut a ball that is too deep, one too small stays."""
DEEPEST = 1.4
"""The same, at most: as deep as the subject is across its diagonal."""
_MOST = (0.02, 0.98)
"""Of the points, between these shares."""


def ball_behind(scene: Measurements, radius: float, nodes: int) -> Float[Tensor, "nodes nodes nodes"]:
    """(|x - c|^2 - r^2) / 2r of the ball that touches the middle of the measured points from behind.

    Its radius is given in half widths of the subject. Of no points it is a ball in the region's middle.
    """
    mean_p, mean_n = _middle(scene), _mean(scene, scene.normals)
    r = radius * _half_width(scene, mean_p)
    apart = node_positions(nodes, scene.positions.device) - (mean_p - r * mean_n)
    return (apart.square().sum(dim=-1) - r * r) / (2 * r)


def explained_radius(scene: Measurements) -> float:
    """All that measured points say of the ball's radius, in half widths of the subject; at most 1.

    Least squares of p = c + r n over points and normals: for points on one side what the turning of their
    normals says. Where photographs are taken from all around, no side is left to be assumed, and the
    flattest ball disturbs least; and where nothing was measured, the subject is as deep as wide.
    """
    if not len(scene.positions):
        return 1.0
    mean_p, mean_n = _mean(scene, scene.positions), _mean(scene, scene.normals)
    turned = scene.normals - mean_n
    spread = _mean(scene, turned.square()).sum()
    together = _mean(scene, (scene.positions - mean_p) * turned).sum()
    turning = float(together / spread.clamp(min=1e-6)) / _half_width(scene, mean_p)
    least = LEAST_RADIUS + depth_is_bounded(scene) * (LEAST_BOUNDED_RADIUS - LEAST_RADIUS)
    explained = min(max(turning, least), 1.0)
    return explained + is_all_around(scene) * (1 - explained)


def seen_depth(scene: Measurements) -> float:
    """From front to back of what was measured, half of it, in half widths of the subject; at most 1.

    Along the points' mean normal, without the nearest and the farthest fiftieth. 0 where silhouettes bound
    the depth, for then points lie on more sides than one.
    """
    if not len(scene.positions):
        return 0.0
    along = scene.positions @ F.normalize(_mean(scene, scene.normals), dim=0)
    farthest, nearest = np.quantile(along.cpu().numpy(), _MOST)
    half = float(nearest - farthest) / 2 / _half_width(scene, _mean(scene, scene.positions))
    return (1 - depth_is_bounded(scene)) * min(half, 1.0)


def _middle(scene: Measurements) -> Float[Tensor, "3"]:
    return _mean(scene, scene.positions) if len(scene.positions) else scene.region_centre


def _mean(scene: Measurements, values: Float[Tensor, "points 3"]) -> Float[Tensor, "3"]:
    """Over the points, weighted by their confidence; 0 of none."""
    if not len(values):
        return values.new_zeros(3)
    return (scene.confidence / scene.confidence.sum()) @ values


def widest_view_angle_deg(scene: Measurements) -> float:
    """Largest angle between two cameras, seen from the region's middle."""
    apart = torch.stack([c.position for c in scene.cameras]) - scene.region_centre
    return widest_angle_deg(F.normalize(apart.cpu().double(), dim=-1).numpy())


def depth_is_bounded(scene: Measurements) -> float:
    """Whether silhouettes bound the depth: 0 if the photographs are taken from one side, 1 if from many."""
    return _ramp(widest_view_angle_deg(scene), 50.0, 90.0)


def is_all_around(scene: Measurements) -> float:
    """Whether no side is unseen: 0 if photographs are taken from within 125 degrees, 1 from 160 on.

    The direction farthest from all cameras is 180 - a / 2 degrees from the nearest one, where a is the widest
    angle: behind the subject for an arc of a, beneath it for a ring that looks down by 90 - a / 2.
    """
    return _ramp(widest_view_angle_deg(scene), 125.0, 160.0)


def _ramp(value: float, none: float, full: float) -> float:
    """0 up to one value, 1 from another on."""
    return min(max((value - none) / (full - none), 0.0), 1.0)


def _half_width(scene: Measurements, at: Float[Tensor, "3"]) -> float:
    """Largest half extent of the subject across the views, at the distance of a point of it."""
    widths = []
    for camera, outline in zip(scene.cameras, scene.outlines, strict=True):
        if outline is not None and bool((outline < 0).any()):
            rows, columns = torch.nonzero(outline < 0, as_tuple=True)
            middle_r, middle_c = (rows.max() + rows.min()) / 2, (columns.max() + columns.min()) / 2
            reach_px = torch.hypot(rows - middle_r, columns - middle_c).max()
            depth = project(camera, at)[1]
            widths.append(float(reach_px * depth / camera.intrinsics[0, 0]))
    return max(widths) if widths else 0.6 * scene.region_radius
