"""The camera, and how Cycles renders what it sees."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from addon.png import critical_chunks
from addon.view_layout import Lens

SENSOR_WIDTH_MM = 36.0


def add_camera(lens: Lens, *, distance: float) -> Any:
    """A camera of the lens's field of view; `distance` to the subject sets its clipping range."""
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    bpy.context.scene.collection.objects.link(camera)
    camera.data.sensor_fit = "HORIZONTAL"
    camera.data.sensor_width = SENSOR_WIDTH_MM
    camera.data.lens = lens.focal_px * SENSOR_WIDTH_MM / lens.width
    camera.data.clip_start, camera.data.clip_end = 0.01 * distance, 100.0 * distance
    bpy.context.scene.camera = camera
    return camera


def set_up_cycles(lens: Lens, *, samples: int, exposure_stops: float, transparent: bool) -> None:
    """Cycles on the CPU, plain sRGB, 8-bit PNG; the same input gives the same bytes."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = samples
    scene.cycles.use_adaptive_sampling = True
    scene.cycles.adaptive_threshold = 0.03
    # Off: a denoiser paints over the fine texture that stereo lives on.
    scene.cycles.use_denoising = False
    scene.cycles.max_bounces = 3
    scene.cycles.caustics_reflective = scene.cycles.caustics_refractive = False
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.exposure = exposure_stops
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = lens.width, lens.height, 100
    render.film_transparent = transparent
    render.use_persistent_data = True
    render.dither_intensity = 0.0
    image = render.image_settings
    image.file_format, image.color_mode, image.color_depth = "PNG", "RGBA", "8"


def render_view(path: Path, camera: Any, world_from_camera: NDArray[np.float64], *, noise_seed: int) -> None:
    """Renders one picture. Each view has its own noise, as each photograph has."""
    scene = bpy.context.scene
    camera.matrix_world = Matrix(world_from_camera.tolist())
    scene.cycles.seed = noise_seed
    scene.render.filepath = str(path)
    with quiet_output():
        bpy.ops.render.render(write_still=True)
    path.write_bytes(critical_chunks(path.read_bytes()))


@contextmanager
def quiet_output() -> Iterator[None]:
    """Hides what Blender's C++ side writes to descriptor 1: a line for every few samples."""
    sys.stdout.flush()
    kept = os.dup(1)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)
