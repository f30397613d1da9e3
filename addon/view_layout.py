"""Where the cameras of a rendered scene stand: pure functions, no Blender needed.

Camera poses are `world_from_camera`, 4x4 float64, in OpenGL axes (x right, y up, looking along -z),
which are also Blender's. The world is Z-up; the front of a scene is its -y side. Angles:

  azimuth    0 in front (camera on -y), 90 on +x, counter-clockwise seen from above
  elevation  0 level with the target, 90 straight above
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

GOLDEN_ANGLE_DEG = 180.0 * (3.0 - np.sqrt(5.0))
STEEPEST_DEG = 85.0
"""Above this the horizon, and with it the camera's roll, is no longer well defined."""


class LayoutKind(StrEnum):
    """How the views surround the object."""

    ARC = "arc"
    RING = "ring"
    HEMISPHERE = "hemisphere"


@dataclass(frozen=True, kw_only=True)
class ViewLayout:
    """Which directions an object is seen from."""

    kind: LayoutKind
    num_views: int
    arc_deg: float = 120.0
    """Angle between the first and the last view of an arc."""
    azimuth_deg: float = 0.0
    """Middle of an arc, first view of a ring."""
    elevation_deg: float = 20.0
    """Of an arc and a ring; a hemisphere spans 10 to 75."""
    jitter: float = 1.0
    """Strength of the irregularity of a hand-held camera; 0 gives exact spacing."""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.num_views < 1:
            raise ValueError(f"num_views must be at least 1, is {self.num_views}")
        if not 0 < self.arc_deg < 360:
            raise ValueError(f"arc_deg must lie between 0 and 360, is {self.arc_deg}")
        if abs(self.elevation_deg) > STEEPEST_DEG:
            raise ValueError(f"elevation_deg must lie within ±{STEEPEST_DEG:g}, is {self.elevation_deg}")
        if not 0 <= self.jitter <= 1:
            raise ValueError(f"jitter must lie between 0 and 1, is {self.jitter}")


@dataclass(frozen=True, kw_only=True)
class Lens:
    """A pinhole camera with square pixels and the principal point in the middle."""

    width: int
    height: int
    focal_px: float


def directions_deg(layout: ViewLayout) -> Array:
    """(views, 2): azimuth and elevation of each view, without jitter."""
    steps = np.arange(layout.num_views, dtype=np.float64)
    elevation = np.full(layout.num_views, layout.elevation_deg)
    match layout.kind:
        case LayoutKind.ARC:
            share = steps / (layout.num_views - 1) if layout.num_views > 1 else steps + 0.5
            azimuth = layout.azimuth_deg + layout.arc_deg * (share - 0.5)
        case LayoutKind.RING:
            azimuth = layout.azimuth_deg + 360.0 * steps / layout.num_views
        case LayoutKind.HEMISPHERE:
            # Equal steps in the sine of the elevation are equal areas on the sphere.
            low, high = np.sin(np.deg2rad([10.0, 75.0]))
            elevation = np.rad2deg(np.arcsin(low + (high - low) * (steps + 0.5) / layout.num_views))
            azimuth = layout.azimuth_deg + GOLDEN_ANGLE_DEG * steps
    return np.stack([azimuth, elevation], axis=-1)


def azimuth_spacing_deg(layout: ViewLayout) -> float:
    """Typical angle between neighbouring views."""
    match layout.kind:
        case LayoutKind.ARC:
            return layout.arc_deg / max(layout.num_views - 1, 1)
        case LayoutKind.RING:
            return 360.0 / layout.num_views
        case LayoutKind.HEMISPHERE:
            return float(np.rad2deg(np.sqrt(2 * np.pi / layout.num_views)))


def unit_vectors(directions: Array) -> Array:
    """(..., 3): from the target towards the camera, for (..., 2) azimuth and elevation in degrees."""
    azimuth, elevation = np.moveaxis(np.deg2rad(directions), -1, 0)
    level = np.cos(elevation)
    return np.stack([level * np.sin(azimuth), -level * np.cos(azimuth), np.sin(elevation)], axis=-1)


def world_from_camera_looking_at(position: Array, target: Array, *, roll_deg: float = 0.0) -> Array:
    """(4, 4): a camera at `position` with `target` on its axis and the horizon level but for the roll.

    Raises ValueError where the two coincide or the view is vertical: "up" has no meaning there.
    """
    backward = np.asarray(position, np.float64) - target
    right = np.cross([0.0, 0.0, 1.0], backward)
    if np.linalg.norm(right) <= 1e-9 * max(1.0, float(np.linalg.norm(backward))):
        raise ValueError(f"no level view from {position} to {target}: it is vertical or empty")
    backward, right = backward / np.linalg.norm(backward), right / np.linalg.norm(right)
    up = np.cross(backward, right)
    cosine, sine = np.cos(np.deg2rad(roll_deg)), np.sin(np.deg2rad(roll_deg))
    world_from_camera = np.eye(4)
    world_from_camera[:3, 0] = cosine * right + sine * up
    world_from_camera[:3, 1] = cosine * up - sine * right
    world_from_camera[:3, 2] = backward
    world_from_camera[:3, 3] = position
    return world_from_camera


def framing_distance(points: Array, rotation: Array, lens: Lens, *, margin: float = 0.04) -> float:
    """Smallest distance from which all points are in the picture but for a margin.

    Points (points, 3) are relative to the target on the camera's axis, `rotation` (3, 3) has the
    camera's axes as columns, the margin is a share of the picture on each side. A point at x, y, z
    along these axes is inside while |x| <= tan_x (distance - z), and likewise y.
    """
    in_camera = points @ rotation
    tangents = (0.5 - margin) / lens.focal_px * np.array([lens.width, lens.height])
    return float((in_camera[:, 2:] + np.abs(in_camera[:, :2]) / tangents).max())


def place_cameras(layout: ViewLayout, lens: Lens, *, points: Array, distance: float | None = None) -> Array:
    """(views, 4, 4): world_from_camera of views around the points (points, 3) that all hold them all.

    They look at the middle of the points' bounding box from one distance: the smallest that holds all
    points in all views, or the one that is given, where nothing is held for sure. The jitter turns by up
    to a tenth of the spacing, tilts by up to 3 degrees, rolls by up to 1.5 and steps back by up to
    6 percent: never closer, so nothing leaves the frame.
    """
    rng = np.random.default_rng(layout.seed)
    wobble = layout.jitter * rng.uniform(-1.0, 1.0, size=(layout.num_views, 4))
    directions = directions_deg(layout)
    directions[:, 0] += 0.1 * azimuth_spacing_deg(layout) * wobble[:, 0]
    directions[:, 1] = np.clip(directions[:, 1] + 3.0 * wobble[:, 1], -STEEPEST_DEG, STEEPEST_DEG)
    towards = unit_vectors(directions)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    poses = np.stack(
        [
            world_from_camera_looking_at(centre + unit, centre, roll_deg=1.5 * roll)
            for unit, roll in zip(towards, wobble[:, 3], strict=True)
        ]
    )
    if distance is None:
        distance = max(framing_distance(points - centre, pose[:3, :3], lens) for pose in poses)
    poses[:, :3, 3] = centre + distance * (1.0 + 0.06 * np.abs(wobble[:, 2:3])) * towards
    return poses
