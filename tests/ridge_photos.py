"""Photographs of a textured ridge, or of a flat wall, by rays: each pixel is one bilinear sample."""

import math
from functools import cache
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from backend.maths.bilinear import bilinear
from backend.scene import Photo

WIDTH, HEIGHT, FOCAL_PX = 400, 300, 420.0
SLOPE = 0.8
"""The scene is a ridge, z = slope |x|, its edge towards the cameras at negative z."""


@cache
def texture() -> np.ndarray:
    """Waves of three sizes, grey."""
    rng = np.random.default_rng(0)
    layers = [gaussian_filter(rng.normal(size=(1024, 1024)), s) * s for s in (1.5, 4.0, 12.0)]
    grey = sum(layers) / np.std(sum(layers))
    return np.clip(0.5 + 0.2 * grey, 0, 1).astype(np.float32)


def look_at_origin(position: np.ndarray, turn_deg: float = 0.0) -> np.ndarray:
    """camera_from_world of a camera that looks at the origin, then turned about its vertical axis."""
    forward = -position / np.linalg.norm(position)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    rotation = Rotation.from_euler("y", turn_deg, degrees=True).as_matrix() @ rotation
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ position
    return pose


def arc_pose(angle_deg: float) -> np.ndarray:
    """Three units from the origin, on an arc that winds up and down."""
    angle = math.radians(angle_deg)
    return look_at_origin(np.array([3 * math.sin(angle), 0.4 * math.sin(2 * angle), -3 * math.cos(angle)]))


def render(camera_from_world: np.ndarray, slope: float = SLOPE, focal_px: float = FOCAL_PX) -> np.ndarray:
    """The ridge as seen through a pinhole with its principal point in the middle."""
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    rays = np.stack([columns / focal_px, rows / focal_px, np.ones_like(rows)], axis=-1)
    rays = rays @ camera_from_world[:3, :3]
    origin = -camera_from_world[:3, :3].T @ camera_from_world[:3, 3]
    nearest = np.full(rows.shape, np.inf)
    for side in (-1.0, 1.0):
        # side * slope * x - z = 0, valid where x is on that side.
        distance = (origin[2] - side * slope * origin[0]) / (side * slope * rays[..., 0] - rays[..., 2])
        valid = (distance > 0) & ((origin[0] + distance * rays[..., 0]) * side >= 0)
        nearest = np.where(valid, np.minimum(nearest, distance), nearest)
    hit = origin + np.where(np.isfinite(nearest), nearest, 0.0)[..., None] * rays
    along = hit[..., 0] * math.hypot(1, slope)
    places = np.stack([512 + 190 * along, 512 + 190 * hit[..., 1]], axis=-1)
    grey = bilinear(texture()[..., None], places).astype(np.float32)
    return np.repeat(grey, 3, axis=2)


def make_photo(name: str, image: np.ndarray, focal_px: float | None = None) -> Photo:
    """As if read from a file."""
    return Photo(
        name=name,
        path=Path(name),
        image_srgb=image.astype(np.float32),
        mask=None,
        original_width=WIDTH,
        original_height=HEIGHT,
        focal_px=focal_px,
    )
