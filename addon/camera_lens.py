"""Blender's camera objects as pinholes and poses, and back."""

import bpy
import numpy as np
from numpy.typing import NDArray

from .intrinsics import (
    LensSettings,
    Pinhole,
    Raster,
    pinhole_from_settings,
    rendered_size,
    settings_from_pinhole,
)

_NOT_A_ROTATION = 1e-4


def pinhole_of(scene: bpy.types.Scene, camera: bpy.types.Object) -> Pinhole:
    """The pinhole that renders with this camera and the scene's settings have.

    Raises ValueError for cameras that are none.
    """
    data, render = camera.data, scene.render
    if data.type != "PERSP":
        raise ValueError(f"{camera.name} is no perspective camera: change its Type to Perspective")
    width, height = rendered_size(render.resolution_x, render.resolution_y, render.resolution_percentage)
    raster = Raster(
        width=width, height=height, aspect_x=render.pixel_aspect_x, aspect_y=render.pixel_aspect_y
    )
    lens = LensSettings(
        lens_mm=data.lens,
        sensor_fit=data.sensor_fit,
        sensor_width_mm=data.sensor_width,
        sensor_height_mm=data.sensor_height,
        shift_x=data.shift_x,
        shift_y=data.shift_y,
    )
    return pinhole_from_settings(lens, raster)


def world_from_camera(camera: bpy.types.Object) -> NDArray[np.float64]:
    """(4, 4) pose in OpenGL axes; scale is no part of it, as Blender leaves it out too.

    Raises ValueError where the object is mirrored or sheared.
    """
    pose = np.array(camera.matrix_world.normalized(), np.float64)
    rotation = pose[:3, :3]
    if np.linalg.det(rotation) < 0 or np.abs(rotation.T @ rotation - np.eye(3)).max() > _NOT_A_ROTATION:
        raise ValueError(f"{camera.name} is mirrored or sheared: apply its scale, and its parents'")
    return pose


def apply_lens(data: bpy.types.Camera, pinhole: Pinhole, *, pixel_aspect: float) -> None:
    """Give a camera the pinhole's lens, for a scene with this pixel aspect."""
    lens = settings_from_pinhole(pinhole, pixel_aspect=pixel_aspect)
    data.type, data.sensor_fit = "PERSP", lens.sensor_fit
    data.sensor_width = lens.sensor_width_mm
    data.lens = lens.lens_mm
    data.shift_x, data.shift_y = lens.shift_x, lens.shift_y
