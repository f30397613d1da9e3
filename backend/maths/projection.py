"""Where cameras show points of the world: numpy, float64; maths/geometry.py does the same in torch."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Float64

from ..scene import Camera, transform_points
from .upright import up_direction


def projected(
    points: Float[np.ndarray, "points 3"], camera: Camera
) -> tuple[Float64[np.ndarray, "points 2"], Float64[np.ndarray, "points"]]:
    """Pixels and depths of points (world frame); pixels mean something where the depth is > 0."""
    in_camera = transform_points(camera.camera_from_world, points)
    return in_pixels(in_camera, camera), in_camera[:, 2]


def in_pixels(in_camera: Float[np.ndarray, "points 3"], camera: Camera) -> Float64[np.ndarray, "points 2"]:
    """Pixels of points in the camera's axes; they mean something where z > 0."""
    depth, homogeneous = in_camera[:, 2:], in_camera @ camera.intrinsics.T
    return np.asarray(homogeneous[:, :2] / np.where(depth > 0, depth, 1.0))


def in_picture(points: Float[np.ndarray, "points 3"], camera: Camera) -> Bool[np.ndarray, "points"]:
    """True where a point lies in front of the camera and within its picture's edges."""
    return shown(*projected(points, camera), camera)


def shown(
    pixels: Float64[np.ndarray, "points 2"], depth: Float64[np.ndarray, "points"], camera: Camera
) -> Bool[np.ndarray, "points"]:
    """The same of points that have been projected."""
    within = (pixels >= 0) & (pixels < [camera.width, camera.height])
    return np.asarray(within.all(axis=1) & (depth > 0))


def up_of(cameras: Sequence[Camera]) -> Float64[np.ndarray, "3"]:
    """Unit vector of the world that is up, for photographs held upright, as Blender has it."""
    rights, bottoms, forwards = np.stack([camera.camera_from_world[:3, :3] for camera in cameras], axis=1)
    return up_direction(rights, -bottoms, -forwards)
