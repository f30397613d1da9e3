"""How what was solved from photographs stands in the scene; numpy, no Blender needed.

Estimated cameras have a frame of their own: any direction may be up, and any length one. Transforms are
similarities, 4x4 float64, and cameras have Blender's axes (x right, y up, looking along -z).
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_FEWEST_POINTS = 20
_UNEVEN = 1e-4
"""Relative difference of squared scales; Blender's transforms have seven digits."""
_ALIKE = 0.01
_LOW = 0.02
"""Share of points that may lie under the floor: they are the wrong ones."""


def upright_from_solved(
    world_from_camera: Array, centre: Array, radius: float, *, up: Array, points: Array | None = None
) -> Array:
    """(4, 4): similarity that puts what was solved upright into Blender's world.

    `world_from_camera` (cameras, 4, 4), `centre` (3,) and `radius` of the region, the unit vector `up` (3,)
    and the sparse points (points, 3) are in the frame that was solved. There `up` becomes +z, the mean view
    looks along +y (the thing shows its front in Blender's front view), the region's radius is
    1 m and its centre lies above the origin. The floor, z = 0, is where the lowest points of the region
    are, but for 2 %; without enough points it is the region's lowest point.
    Raises ValueError where there is no camera or a number is unusable.
    """
    poses, middle = np.asarray(world_from_camera, np.float64), np.asarray(centre, np.float64)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not len(poses) or not np.isfinite(poses).all():
        raise ValueError("no usable cameras to place the scene by")
    if middle.shape != (3,) or not np.isfinite(middle).all() or not 0 < radius < np.inf:
        raise ValueError(f"the region at {centre} with radius {radius} is not usable")
    forward = _front(poses, up)
    rotation = np.stack([np.cross(forward, up), forward, up])
    upright = np.eye(4)
    upright[:3, :3] = rotation / radius
    upright[:3, 3] = -rotation @ middle / radius
    upright[2, 3] -= _floor(upright, points)
    return upright


def region_in_solved(
    world_from_solved: Array, world_from_empty: Array, display_size: float
) -> tuple[Array, float]:
    """Centre (3,) and radius, in the solved frame, of the sphere that an empty shows.

    The largest of the empty's three scales counts: what its sphere holds is always held.
    Raises ValueError where the empty has no extent or one of the transforms cannot be turned back.
    """
    solved_from_world = inverse_similarity(world_from_solved)
    solved_from_empty = solved_from_world @ np.asarray(world_from_empty, np.float64)
    if not np.isfinite(solved_from_empty).all():
        raise ValueError("the region stands nowhere: a number of its transform is not finite")
    # Not the columns' lengths: a sheared empty (a child of a scaled one) is longer between its axes.
    radius = abs(display_size) * float(np.linalg.norm(solved_from_empty[:3, :3], ord=2))
    if not 0 < radius < np.inf:
        raise ValueError("the region has no size")
    return solved_from_empty[:3, 3].copy(), radius


def inverse_similarity(b_from_a: Array) -> Array:
    """(4, 4): the way back. Raises ValueError where the transform is none or flattens everything."""
    matrix = np.asarray(b_from_a, np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-30:
        raise ValueError("the placement cannot be turned back: one of its scales is 0")
    inverse: Array = np.asarray(np.linalg.inv(matrix), np.float64)
    return inverse


def solved_from_camera(world_from_solved: Array, world_from_camera: Array) -> Array:
    """(4, 4): a camera's pose in the frame that was solved, a rotation and a translation.

    It sees there what the camera sees in the world. Raises ValueError where the frame is mirrored, or
    scaled differently along its axes or by 0: then no pinhole does.
    """
    solved_from_world = inverse_similarity(world_from_solved)
    linear = np.asarray(world_from_solved, np.float64)[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    if scale < 0 or np.abs(linear.T @ linear / scale**2 - np.eye(3)).max() > _UNEVEN:
        raise ValueError("it is mirrored, or scaled differently along its axes: give it one positive scale")
    pose: Array = solved_from_world @ world_from_camera
    pose[:3, :3] *= scale
    return pose


def similarity_between(points_a: Array, points_b: Array) -> Array:
    """(4, 4): b_from_a, the similarity that brings points (points, 3) nearest to others, one by one.

    In least squares, without mirroring (Umeyama, Least-Squares Estimation of Transformation Parameters
    Between Two Point Patterns, 1991). Raises ValueError where half of the points stay farther away than
    1 % of the mean distance from their middle: no similarity made one of the other.
    """
    mean_a, mean_b = points_a.mean(axis=0), points_b.mean(axis=0)
    from_a, from_b = points_a - mean_a, points_b - mean_b
    if not from_a.any():
        raise ValueError("the points lie all in one place")
    left, stretches, right = np.linalg.svd(from_b.T @ from_a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = (left * signs) @ right
    scale = float(stretches @ signs) / float((from_a**2).sum())
    off = np.linalg.norm(from_b - scale * from_a @ rotation.T, axis=1)
    if not np.median(off) < _ALIKE * np.linalg.norm(from_b, axis=1).mean():
        raise ValueError("the points do not have the same shape")
    b_from_a = np.eye(4)
    b_from_a[:3, :3] = scale * rotation
    b_from_a[:3, 3] = mean_b - b_from_a[:3, :3] @ mean_a
    return b_from_a


def sphere_around(points: Array, weights: Array | None = None) -> tuple[Array, float]:
    """Centre (3,) and radius of a sphere around what most points (points, 3) belong to.

    Far points, as of a background, are left out: those more than three times as far from the weighted
    median as the weighted median distance. The centre is the middle between the 2 % and the 98 %
    quantile along each axis, the radius 5 % more than the 98 % quantile of the distance from there.
    Raises ValueError where there are too few points or they have no extent.
    """
    points = np.asarray(points, np.float64)
    weights = np.ones(len(points)) if weights is None else np.asarray(weights, np.float64)
    good = np.isfinite(points).all(axis=1) & np.isfinite(weights) & (weights > 0)
    points, weights = points[good], weights[good]
    if len(points) < _FEWEST_POINTS:
        raise ValueError(f"{len(points)} points are too few to fit a region to")
    median = np.array([weighted_quantile(axis, weights, 0.5) for axis in points.T])
    distances = np.linalg.norm(points - median, axis=1)
    near = distances <= 3 * weighted_quantile(distances, weights, 0.5)
    points, weights = points[near], weights[near]
    centre = np.array(
        [sum(weighted_quantile(axis, weights, share) for share in (_LOW, 1 - _LOW)) / 2 for axis in points.T]
    )
    radius = 1.05 * weighted_quantile(np.linalg.norm(points - centre, axis=1), weights, 1 - _LOW)
    if not radius > 0:
        raise ValueError("the points lie all in one place")
    return centre, radius


def weighted_quantile(values: Array, weights: Array, share: float) -> float:
    """The smallest value such that values up to it have at least this share of the weight."""
    order = np.argsort(values)
    reached = np.cumsum(weights[order])
    return float(values[order[min(np.searchsorted(reached, share * reached[-1]), len(order) - 1)]])


def _front(world_from_camera: Array, up: Array) -> Array:
    """(3,): the level unit vector along which the cameras look.

    A full ring of cameras looks along none: then the first one decides, and where it looks straight up
    or down, its picture's top, or its right side for a camera on its side.
    """
    first = world_from_camera[0]
    for direction in (-world_from_camera[:, :3, 2].mean(axis=0), -first[:3, 2], first[:3, 1]):
        level = direction - up * (direction @ up)
        length = float(np.linalg.norm(level))
        if length > 0.05:
            return np.asarray(level / length)
    level = np.cross(up, first[:3, 0])
    return np.asarray(level / np.linalg.norm(level))


def _floor(upright_from_solved: Array, points: Array | None) -> float:
    """Height of the floor where the region is the unit sphere around the origin."""
    if points is None or not len(points):
        return -1.0
    placed = np.asarray(points, np.float64) @ upright_from_solved[:3, :3].T + upright_from_solved[:3, 3]
    heights = placed[np.linalg.norm(placed, axis=1) <= 1.0, 2]
    return float(np.quantile(heights, _LOW)) if len(heights) >= _FEWEST_POINTS else -1.0
