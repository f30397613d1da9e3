"""A made-up subject of which everything is known: a two-lobed body with a fine matt texture.

The body is star-shaped around `CENTRE`: its surface lies at `surface_radius(direction)`, a waist
between two lobes, with gentle bumps. Its colours are sums of waves with lengths between six and thirty
pixels, so that photographs of one ray a pixel hold no aliasing. The world is neither centred nor of
unit size, so that a frame that is forgotten somewhere shows.
"""

import json
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Bool, Float32, Float64, Int64
from PIL import Image

from backend.maths.raycast import RayCaster, camera_rays
from backend.scene import Camera, Lens, Region, SolvedCameras, SurfacePoints, View, transform_points

CENTRE = np.array([0.7, -0.4, 1.1])
SIZE = 2.5
"""World units; the body reaches 1.1 times that from its centre."""
OBJECT_UNIT = 1.2 * SIZE
"""Of the true region's object frame, in world units."""
DISTANCE = 4.0
"""Of the cameras from the centre, in SIZE."""

Points = Float64[np.ndarray, "points 3"]


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Views of the body and what is true of each of their pixels."""

    views: tuple[View, ...]
    depths: tuple[Float64[np.ndarray, "height width"], ...]
    """Along the camera's axis, world units; infinite off the body."""
    normals: tuple[Float64[np.ndarray, "height width 3"], ...]
    """World frame, unit, outwards; 0 off the body."""

    @property
    def cameras(self) -> list[Camera]:
        """Of the views."""
        return [view.camera for view in self.views]

    @property
    def coverage(self) -> tuple[Bool[np.ndarray, "height width"], ...]:
        """True on the body."""
        return tuple(np.isfinite(depth) for depth in self.depths)

    def without_masks(self) -> "Scene":
        """The same photographs with nothing cut out."""
        return replace(self, views=tuple(replace(view, mask=None) for view in self.views))

    def solved(self, sparse: Points | None = None) -> SolvedCameras:
        """The views as the cameras' stage gives them, with `sparse` seen by all."""
        sparse = np.zeros((0, 3)) if sparse is None else sparse
        return SolvedCameras(
            views=self.views,
            lenses=tuple(pinhole_lens(camera) for camera in self.cameras),
            unplaced=(),
            estimated=False,
            sparse_positions=sparse,
            sparse_visibility=np.ones((len(sparse), len(self.views)), bool),
            reprojection_error_px=None,
        )


def pinhole_lens(camera: Camera) -> Lens:
    """The lens of a photograph that is as large as its camera's picture and has no distortion."""
    params = (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px)
    return Lens(model="PINHOLE", width=camera.width, height=camera.height, params=params)


def surface_radius(directions: Points) -> Float64[np.ndarray, "points"]:
    """Distance of the surface from CENTRE in unit directions, in SIZE."""
    x, y, z = directions.T
    return np.asarray(0.7 + 0.4 * x**2 + 0.04 * np.sin(5 * y + 1) * np.cos(4 * z))


def _radius_gradient(directions: Points) -> Points:
    x, y, z = directions.T
    across_y = 0.2 * np.cos(5 * y + 1) * np.cos(4 * z)
    return np.stack([0.8 * x, across_y, -0.16 * np.sin(5 * y + 1) * np.sin(4 * z)], axis=-1)


def surface_points(directions: Points) -> Points:
    """Where the surface lies in unit directions from CENTRE, world frame."""
    return np.asarray(CENTRE + SIZE * surface_radius(directions)[:, None] * directions)


def surface_distance(points: Points) -> Float64[np.ndarray, "points"]:
    """Signed distance to first order, world units, > 0 outside: exact on the surface, good near it."""
    value, gradient = _implicit(points)
    return np.asarray(SIZE * value / np.linalg.norm(gradient, axis=-1))


def true_normals(points: Points) -> Points:
    """Unit outward normals of the surface below the points."""
    gradient = _implicit(points)[1]
    return np.asarray(gradient / np.linalg.norm(gradient, axis=-1, keepdims=True))


def _implicit(points: Points) -> tuple[Float64[np.ndarray, "points"], Points]:
    """|x| - surface_radius(x / |x|) and its gradient, x = (point - CENTRE) / SIZE."""
    x = (points - CENTRE) / SIZE
    length = np.linalg.norm(x, axis=-1, keepdims=True)
    direction = x / length
    slope = _radius_gradient(direction)
    along = (slope * direction).sum(axis=-1, keepdims=True)
    return length[:, 0] - surface_radius(direction), direction - (slope - along * direction) / length


def texture_srgb(points: Points) -> Points:
    """Colours in (0, 1): for each channel sixteen waves of random direction, length and phase."""
    random = np.random.default_rng(7)
    shape = (3, 16)
    direction = random.normal(size=(*shape, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    wave_length = np.exp(random.uniform(np.log(0.1), np.log(0.5), shape))
    phase = random.uniform(0, 2 * np.pi, shape)
    turns = (points - CENTRE) / SIZE @ (direction / wave_length[..., None]).reshape(-1, 3).T
    waves = np.cos(2 * np.pi * turns + phase.ravel()).reshape(len(points), *shape).sum(axis=-1)
    colours: Points = 0.5 + 0.4 * np.tanh(waves / 4)
    return colours


@cache
def true_mesh() -> trimesh.Trimesh:
    """The body as 82 thousand triangles, less than 1e-4 SIZE off."""
    ball = trimesh.creation.icosphere(6)
    return trimesh.Trimesh(surface_points(np.asarray(ball.vertices)), ball.faces, process=False)


@cache
def true_caster() -> RayCaster:
    """For rays against the body."""
    faces: Int64[np.ndarray, "faces 3"] = np.asarray(true_mesh().faces, np.int64)
    return RayCaster(np.asarray(true_mesh().vertices), faces)


def diagonal() -> float:
    """Of the body's bounding box, world units: what errors are measured in."""
    return float(np.linalg.norm(true_mesh().extents))


def true_region() -> Region:
    """A sphere around the body with a tenth of room."""
    object_from_world = np.eye(4)
    object_from_world[:3, :3] /= OBJECT_UNIT
    object_from_world[:3, 3] = -CENTRE / OBJECT_UNIT
    return Region(object_from_world=object_from_world)


def faced_points(cameras: list[Camera]) -> SurfacePoints:
    """Of the true surface, each of the camera it faces most, without those that face none; object frame."""
    world = np.asarray(true_mesh().vertices)[::20]
    normals = true_normals(world)
    towards = np.stack([camera.position for camera in cameras]) - world[:, None]
    facing = (towards / np.linalg.norm(towards, axis=-1, keepdims=True) @ normals[..., None])[..., 0]
    faced = facing.max(axis=1) > 0
    count = int(faced.sum())
    return SurfacePoints(
        positions=transform_points(true_region().object_from_world, world[faced]).astype(np.float32),
        normals=normals[faced].astype(np.float32),
        colours_srgb=texture_srgb(world[faced]).astype(np.float32),
        confidence=np.ones(count, np.float32),
        num_views=np.full(count, 2),
        view_index=facing[faced].argmax(axis=1),
    )


def plain_points(
    positions: Points, *, confidence: float = 1.0, view_index: Int64[np.ndarray, "points"] | None = None
) -> SurfacePoints:
    """Points of the object frame of which only their places matter; of the first photograph."""
    count = len(positions)
    return SurfacePoints(
        positions=positions.astype(np.float32),
        normals=np.tile(np.float32([0, 0, 1]), (count, 1)),
        colours_srgb=np.full((count, 3), 0.5, np.float32),
        confidence=np.full(count, confidence, np.float32),
        num_views=np.full(count, 2),
        view_index=np.zeros(count, np.int64) if view_index is None else view_index,
    )


def camera_at(azimuth_deg: float, height: float, width: int) -> Camera:
    """At DISTANCE, looking at CENTRE; z is up, azimuth 0 is at -y, the height is in SIZE; 4:3."""
    azimuth = np.deg2rad(azimuth_deg)
    position = np.array([np.sin(azimuth), -np.cos(azimuth), height / DISTANCE])
    position *= DISTANCE * SIZE / np.linalg.norm(position)
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = rotation
    camera_from_world[:3, 3] = -rotation @ (CENTRE + position)
    rows = width * 3 // 4
    # principal point off the middle and unequal focal lengths, as calibrated cameras have them
    return Camera(
        camera_from_world=camera_from_world,
        fx_px=1.45 * width,
        fy_px=1.44 * width,
        cx_px=0.51 * width,
        cy_px=0.49 * rows,
        width=width,
        height=rows,
    )


def arc_cameras(count: int, spread_deg: float, width: int) -> list[Camera]:
    """Evenly over an arc, alternating in height."""
    azimuths = np.linspace(-spread_deg / 2, spread_deg / 2, count)
    return [camera_at(float(a), 0.6 + 0.5 * (i % 2), width) for i, a in enumerate(azimuths)]


def ring_cameras(count: int, width: int) -> list[Camera]:
    """All around, alternating in height."""
    return arc_cameras(count, 360.0 * (count - 1) / count, width)


GROUND_Z = CENTRE[2] - 0.68 * SIZE
"""Of the ground, which the body's lowest part sinks into by a little."""


def photographed(
    cameras: list[Camera], *, textured: bool = True, wall: bool = False, ground: bool = False
) -> Scene:
    """The body from each camera, masked, before black or a textured wall; evenly grey without texture.

    With `ground` it lies on a textured disc of 2.5 SIZE; depths and masks are of the body all the same.
    """
    views, depths, normals = [], [], []
    for index, camera in enumerate(cameras):
        origins, directions = camera_rays(camera)
        hits = true_caster().cast(origins, directions)
        hit, shape = hits.hit, (camera.height, camera.width)
        to_ground = ground_distance(origins, directions) if ground else np.full(len(hit), np.inf)
        hit &= hits.distance < to_ground
        points = origins[hit] + hits.distance[hit, None] * directions[hit]
        image = np.zeros((len(hit), 3), np.float32)
        if wall:
            image[~hit] = _wall_srgb(origins[~hit], directions[~hit])
        on_ground = ~hit & np.isfinite(to_ground)
        image[on_ground] = texture_srgb(
            origins[on_ground] + to_ground[on_ground, None] * directions[on_ground] + SIZE
        )
        image[hit] = texture_srgb(points) if textured else 0.8
        depth, normal = np.full(len(hit), np.inf), np.zeros((len(hit), 3))
        depth[hit] = (points - camera.position) @ camera.camera_from_world[2, :3]
        normal[hit] = true_normals(points)
        mask: Float32[np.ndarray, "height width"] = hit.reshape(shape).astype(np.float32)
        name = f"view_{index:02d}.png"
        views.append(View(name=name, camera=camera, image_srgb=image.reshape(*shape, 3), mask=mask))
        depths.append(depth.reshape(shape))
        normals.append(normal.reshape(*shape, 3))
    return Scene(views=tuple(views), depths=tuple(depths), normals=tuple(normals))


def ground_distance(origins: Points, directions: Points) -> Float64[np.ndarray, "points"]:
    """How far along rays the ground is, in lengths of their directions; infinite where they miss it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (GROUND_Z - origins[:, 2]) / directions[:, 2]
        across = np.linalg.norm((origins + along[:, None] * directions - CENTRE)[:, :2], axis=1)
    return np.where((along > 0) & (across < 2.5 * SIZE), along, np.inf)


def _wall_srgb(origins: Points, directions: Points) -> Points:
    """Colours of a sphere around everything, four times as far and as coarse as the body."""
    radius = 4 * DISTANCE * SIZE
    apart = origins - CENTRE
    half = (apart * directions).sum(axis=-1)
    along = -half + np.sqrt(half**2 - (apart**2).sum(axis=-1) + radius**2)
    return texture_srgb(CENTRE + (apart + along[:, None] * directions) / 4)


def write_scene(scene: Scene, folder: Path) -> None:
    """PNG photographs (alpha: the mask) with transforms.json in `folder`/images, and `folder`/truth.ply."""
    images = folder / "images"
    images.mkdir(parents=True)
    frames = []
    for view in scene.views:
        mask = np.ones(view.image_srgb.shape[:2]) if view.mask is None else view.mask
        pixels = np.concatenate([view.image_srgb, mask[..., None]], axis=-1)
        Image.fromarray(np.round(pixels * 255).astype(np.uint8)).save(images / view.name)
        frames.append(_frame(view))
    (images / "transforms.json").write_text(json.dumps({"camera_model": "PINHOLE", "frames": frames}))
    true_mesh().export(folder / "truth.ply")


def _frame(view: View) -> dict[str, object]:
    """One frame of nerfstudio's transforms.json, whose camera axes are OpenGL's: y up, z backward."""
    camera = view.camera
    world_from_camera = np.linalg.inv(camera.camera_from_world)
    return {
        "file_path": view.name,
        "transform_matrix": (world_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist(),
        "fl_x": camera.fx_px,
        "fl_y": camera.fy_px,
        "cx": camera.cx_px,
        "cy": camera.cy_px,
        "w": camera.width,
        "h": camera.height,
    }
