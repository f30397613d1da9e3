"""Pixels that are worth a ray, and the rays through them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..maths.geometry import Pinhole, pixel_centres, ray_directions
from ..maths.rays import sphere_span
from .measurements import Measurements


@dataclass(frozen=True, kw_only=True)
class Pixels:
    """Pixels of all views."""

    view: Int[Tensor, "pixels"]
    where: Float[Tensor, "pixels 2"]
    colour: Float[Tensor, "pixels 3"]
    coverage: Float[Tensor, "pixels"]
    """The mask's value, or nan where there is no mask."""


def worthy_pixels(scene: Measurements) -> Pixels:
    """On and just around the subject: where the mask is, or where something was measured."""
    near = [
        outline < 8 if outline is not None else F.max_pool2d((depth > 0).float()[None], 5, 1, 2)[0] > 0
        for outline, depth in zip(scene.outlines, scene.sure_depths, strict=True)
    ]
    return _pixels_at(scene, near)


def pixels_of_unit_sphere(scene: Measurements) -> Pixels:
    """Those whose rays go through the unit sphere of the frame."""
    meets = []
    for camera in scene.cameras:
        pixels = pixel_centres(camera.width, camera.height, camera.intrinsics.device).reshape(-1, 2)
        directions = F.normalize(ray_directions(camera, pixels), dim=-1)
        entry, leave = sphere_span(camera.position.expand_as(directions), directions)
        meets.append((leave > entry).reshape(camera.height, camera.width))
    return _pixels_at(scene, meets)


def _pixels_at(scene: Measurements, worthy: Sequence[Bool[Tensor, "_ _"]]) -> Pixels:
    parts = []
    for index, (image, mask, near) in enumerate(zip(scene.images, scene.masks, worthy, strict=True)):
        rows, columns = torch.nonzero(near, as_tuple=True)
        coverage = (
            mask[rows, columns] if mask is not None else torch.full_like(rows, math.nan, dtype=torch.float32)
        )
        where = torch.stack([columns, rows], dim=-1) + 0.5
        parts.append((torch.full_like(rows, index), where, image[:, rows, columns].T, coverage))
    view, where, colour, coverage = (torch.cat(column) for column in zip(*parts, strict=True))
    return Pixels(view=view, where=where, colour=colour, coverage=coverage)


def rays_through(
    cameras: Sequence[Pinhole], pixels: Pixels, chosen: Int[Tensor, "rays"]
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays 3"]]:
    """Origins and unit directions of chosen pixels."""
    origins = pixels.where.new_empty((len(chosen), 3))
    directions = torch.empty_like(origins)
    view = pixels.view[chosen]
    for index, camera in enumerate(cameras):
        mine = view == index
        origins[mine] = camera.position
        directions[mine] = F.normalize(ray_directions(camera, pixels.where[chosen[mine]]), dim=-1)
    return origins, directions
