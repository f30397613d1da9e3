"""Pictures of a mesh for the report: its colours, clay under studio light, and maps of a value.

All functions take and return sRGB in [0, 1]; light is added up in linear light. Directions of light
are in the camera's frame (x right, y down, z forward), so that the lamps move with the camera.
"""

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64
from PIL import Image

from ..images import resized
from ..maths.projection import up_of
from ..maths.raycast import MeshImage
from ..maths.srgb import srgb_from_linear
from ..scene import Camera

JPEG_QUALITY = 86

CLAY_LINEAR = np.array([0.60, 0.56, 0.52])
INSIDE_LINEAR = np.array([0.16, 0.20, 0.30])
"""Faces seen from behind are bluish: the surface is open there."""
BEHIND_COSINE = 0.3
"""Interpolated normals turn away by less at the outline of a coarse mesh, where no face shows its back."""
KEY_LIGHT = np.array([-0.45, -0.65, -0.61])
FILL_LIGHT = np.array([0.75, -0.05, -0.66])

SUPPORT_STOPS_SRGB = np.array([[201, 84, 29], [240, 196, 106], [94, 178, 168], [15, 106, 122]]) / 255
"""From guessed to measured by several photographs; told apart by the colour blind too."""
ERROR_STOPS_SRGB = np.array([[245, 241, 232], [252, 196, 110], [226, 88, 52], [110, 9, 30]]) / 255
"""From no error to the map's limit and beyond."""

TURNTABLE_FIELD_OF_VIEW_DEG = 30.0
TURNTABLE_ELEVATION_DEG = 18.0


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A picture of the page, as a file."""

    jpeg: bytes
    width: int
    height: int
    alt: str
    """What it shows, for those who cannot see it."""

    @property
    def data_uri(self) -> str:
        """The file as an address that holds it."""
        return "data:image/jpeg;base64," + base64.b64encode(self.jpeg).decode("ascii")


def picture(image_srgb: Float[np.ndarray, "height width 3"], size: tuple[int, int], alt: str) -> Picture:
    """The image as a JPEG file of (width, height); shrinking averages, which smooths jagged edges."""
    width, height = size
    pixels = np.round(resized(image_srgb, width, height).clip(0, 1) * 255).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=JPEG_QUALITY, optimize=True)
    return Picture(jpeg=file.getvalue(), width=width, height=height, alt=alt)


def before_backdrop(
    colours_srgb: Float[np.ndarray, "covered 3"], coverage: Bool[np.ndarray, "height width"]
) -> Float32[np.ndarray, "height width 3"]:
    """The covered pixels, row by row, before a light grey backdrop, a little darker at its foot."""
    top, foot = np.array([0.945, 0.950, 0.957]), np.array([0.835, 0.845, 0.860])
    image = np.empty((*coverage.shape, 3), np.float32)
    image[:] = top + np.linspace(0, 1, len(coverage))[:, None, None] * (foot - top)
    image[coverage] = colours_srgb
    return image


def clay(image: MeshImage, camera: Camera) -> Float32[np.ndarray, "height width 3"]:
    """The mesh as unpainted clay under a key light from the upper left and a fill light."""
    normals, from_behind = _towards_camera(image, camera)
    surface = np.where(from_behind[:, None], INSIDE_LINEAR, CLAY_LINEAR)
    key, fill = (np.maximum(normals @ light, 0.0) for light in (KEY_LIGHT, FILL_LIGHT))
    sky = 0.5 - 0.5 * normals[:, 1]
    light = 0.05 + 0.95 * key + 0.16 * fill + 0.14 * sky
    return before_backdrop(srgb_from_linear(surface * light[:, None]).clip(0, 1), image.coverage)


def value_map(
    image: MeshImage, camera: Camera, stops_srgb: Float[np.ndarray, "stops 3"]
) -> Float32[np.ndarray, "height width 3"]:
    """The mesh in the colours of its `support` (0 first stop, 1 last), shaded lightly to show its shape."""
    normals, _ = _towards_camera(image, camera)
    shade = 0.62 + 0.38 * np.maximum(normals @ KEY_LIGHT, 0.0) ** 0.8
    colours = colour_at(image.support[image.coverage], stops_srgb)
    return before_backdrop(colours * shade[:, None], image.coverage)


def colour_at(
    values: Float[np.ndarray, "values"], stops_srgb: Float[np.ndarray, "stops 3"]
) -> Float64[np.ndarray, "values 3"]:
    """Colours between evenly spaced stops for values from 0 to 1; values beyond keep the end's colour."""
    positions = np.linspace(0, 1, len(stops_srgb))
    return np.stack([np.interp(values, positions, channel) for channel in stops_srgb.T], axis=-1)


def turntable_cameras(
    cameras: Sequence[Camera], vertices: Float64[np.ndarray, "vertices 3"], num_cameras: int, size_px: int
) -> tuple[Camera, ...]:
    """Cameras evenly around the mesh, from between the given cameras' sides, all of it in the picture.

    The first camera is half a step aside from the mean of the given ones, so that the views are new ones.
    """
    low, high = np.quantile(vertices, [0.01, 0.99], axis=0)
    centre = (low + high) / 2
    radius = float(np.quantile(np.linalg.norm(vertices - centre, axis=1), 0.99)) or 1.0
    up = up_of(cameras)
    towards = np.mean([_direction(camera.position - centre) for camera in cameras], axis=0)
    front = _level_direction(towards, up)
    side = np.cross(up, front)
    distance = radius / np.sin(np.radians(TURNTABLE_FIELD_OF_VIEW_DEG / 2)) * 1.03
    elevation = np.radians(TURNTABLE_ELEVATION_DEG)
    found = []
    for index in range(num_cameras):
        azimuth = 2 * np.pi * (index + 0.5) / num_cameras
        level = np.cos(azimuth) * front + np.sin(azimuth) * side
        backwards = np.cos(elevation) * level + np.sin(elevation) * up
        found.append(_looking_at(centre, centre + distance * backwards, up, size_px))
    return tuple(found)


def _looking_at(
    target: Float64[np.ndarray, "3"],
    position: Float64[np.ndarray, "3"],
    up: Float64[np.ndarray, "3"],
    size_px: int,
) -> Camera:
    """A square camera of the turntable's field of view."""
    forward = _direction(target - position)
    right = _direction(np.cross(forward, up))
    rotation = np.stack([right, np.cross(forward, right), forward])
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3], camera_from_world[:3, 3] = rotation, -rotation @ position
    focal_px = size_px / 2 / np.tan(np.radians(TURNTABLE_FIELD_OF_VIEW_DEG / 2))
    return Camera(
        camera_from_world=camera_from_world,
        fx_px=float(focal_px),
        fy_px=float(focal_px),
        cx_px=size_px / 2,
        cy_px=size_px / 2,
        width=size_px,
        height=size_px,
    )


def _level_direction(
    vector: Float64[np.ndarray, "3"], up: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "3"]:
    """Unit vector of what of the vector is across up; any across up where that is nothing."""
    across = vector - vector @ up * up
    if np.linalg.norm(across) < 1e-6:  # cameras all around, or straight above
        axis = np.eye(3)[np.argmin(np.abs(up))]
        across = axis - axis @ up * up
    return _direction(across)


def _direction(vector: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    return np.asarray(vector / np.linalg.norm(vector))


def _towards_camera(
    image: MeshImage, camera: Camera
) -> tuple[Float32[np.ndarray, "covered 3"], Bool[np.ndarray, "covered"]]:
    """Of the covered pixels: normals in the camera's axes, turned towards it, and which had to be turned."""
    normals = image.normal_world[image.coverage] @ camera.camera_from_world[:3, :3].T.astype(np.float32)
    rows, columns = np.nonzero(image.coverage)
    x, y = (columns + 0.5 - camera.cx_px) / camera.fx_px, (rows + 0.5 - camera.cy_px) / camera.fy_px
    away = (normals[:, 0] * x + normals[:, 1] * y + normals[:, 2]) / np.sqrt(x**2 + y**2 + 1)
    from_behind = away > BEHIND_COSINE
    return np.where(from_behind[:, None], -normals, normals), from_behind
