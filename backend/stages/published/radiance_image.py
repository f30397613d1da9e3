"""Pictures of a fitted radiance field from any camera."""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float32

from ...maths.geometry import pinhole_in_object, pixel_centres, ray_directions
from ...maths.radiance import composite
from ...maths.rays import sphere_span
from ...maths.volume import log_transparency
from ...scene import Camera, Progress, Region
from ..radiance import Radiance
from .radiance_field import RadianceField, sample_rays

_AT_ONCE = 1024
"""Rays in one call: with more, the networks' layers leave the processor's cache."""


@dataclass(frozen=True, kw_only=True)
class RadianceImage:
    """A field as a camera sees it."""

    colour_srgb: Float32[np.ndarray, "height width 3"]
    """Before the field's background; before black where it has none."""
    opacity: Float32[np.ndarray, "height width"]
    """Share of the light that the field takes."""


def radiance_image(
    field: RadianceField, radiance: Radiance, camera: Camera, *, device: torch.device, progress: Progress
) -> RadianceImage:
    """One ray through every pixel's centre; `field` is `radiance`, restored on the device."""
    region = Region(object_from_world=radiance.object_from_world)
    pinhole = pinhole_in_object(camera, region, device)
    background = torch.tensor(
        np.zeros(3, np.float32) if radiance.background_srgb is None else radiance.background_srgb
    ).to(device)
    pixels = pixel_centres(camera.width, camera.height, device).reshape(-1, 2)
    colour, opacity = background.expand(len(pixels), 3).clone(), pixels.new_zeros(len(pixels))
    directions = F.normalize(ray_directions(pinhole, pixels), dim=-1)
    origins = pinhole.position.expand_as(directions)
    near, far = sphere_span(origins, directions)
    parts = torch.split(torch.nonzero(far > near).flatten(), _AT_ONCE)
    with torch.no_grad():
        for number, part in enumerate(parts):
            progress(number / len(parts), "rendering")
            samples = sample_rays(field, origins[part], directions[part], None)
            colour[part] = composite(samples.log_pass, samples.colour, background[None])
            opacity[part] = -torch.expm1(log_transparency(samples.log_pass))
    shape = (camera.height, camera.width)
    return RadianceImage(
        colour_srgb=colour.reshape(*shape, 3).cpu().numpy(), opacity=opacity.reshape(shape).cpu().numpy()
    )
