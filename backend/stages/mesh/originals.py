"""Colours straight from the photographs' files, at more pixels than the surface is found from."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from ...images import fitted_size, read_image
from ...maths.bilinear import bilinear
from ...maths.projection import in_pixels
from ...maths.sampling import colours_in_camera, mask_at
from ...scene import Camera, Lens, View
from ..cameras.lenses import colmap_lens, rescaled_lens

Colours = Callable[[Float64[np.ndarray, "points 3"]], Float64[np.ndarray, "points 4"]]
"""sRGB (0 to 1) and mask of a photograph where it shows points in its camera's axes, in front of it."""


@dataclass(frozen=True, kw_only=True)
class Original:
    """What a view was made from."""

    path: Path
    lens: Lens


def close_up_camera(view: View, original: Original | None, max_side_px: int) -> Camera:
    """The view's camera over as many pixels as `close_up` reads, which are not fewer than the view's."""
    if original is None:
        return view.camera
    width, height = fitted_size(original.lens.width, original.lens.height, max_side_px)
    return view.camera.resized(width, height) if width > view.camera.width else view.camera


def close_up(view: View, original: Original | None, max_side_px: int) -> Colours:
    """The photograph read again where its file has more pixels than the view, else the view itself.

    Where the lens bends light, the places of the points in the file are computed, so that the picture is
    resampled once. Raises ReconstructionError(PHOTO_UNREADABLE).
    """
    camera = close_up_camera(view, original, max_side_px)
    if original is None or camera is view.camera:
        return partial(colours_in_camera, view)
    image = read_image(original.path, max_side_px).image_srgb
    lens = rescaled_lens(colmap_lens(original.lens), image.shape[1], image.shape[0])

    def colours(in_camera: Float64[np.ndarray, "points 3"]) -> Float64[np.ndarray, "points 4"]:
        in_file = lens.img_from_cam(in_camera)
        return np.column_stack([bilinear(image, in_file), mask_at(view, in_pixels(in_camera, view.camera))])

    return colours
