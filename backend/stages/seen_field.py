"""A field as the pixels of a photograph see it, and photographs made smaller for looking at it."""

from dataclasses import dataclass

import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from ..maths.geometry import Pinhole, pixel_centres, ray_directions
from ..maths.grid import locate, value_and_gradient
from .silhouettes import grid_crossing, grid_entry


@dataclass(frozen=True, kw_only=True)
class SeenField:
    """Where the rays of some pixels meet a field; of those that miss it, `hit` alone means anything."""

    hit: Bool[Tensor, "pixels"]
    depth: Float[Tensor, "pixels"]
    """Along the camera's axis."""
    positions: Float[Tensor, "pixels 3"]
    normals: Float[Tensor, "pixels 3"]
    """Out of the surface."""
    directions: Float[Tensor, "pixels 3"]
    """Away from the camera, of unit length."""
    cosine: Float[Tensor, "pixels"]
    """Between the normal and the way back to the camera."""


def seen_field(
    camera: Pinhole, where: Bool[Tensor, "height width"], distance: Float[Tensor, "nodes nodes nodes"]
) -> SeenField:
    """The field, on the grid of the camera's frame, at those pixels; row by row, as `where` selects them."""
    along_axis = ray_directions(camera, pixel_centres(camera.width, camera.height, distance.device)[where])
    directions = F.normalize(along_axis, dim=-1)
    origins = camera.position.expand_as(directions)
    crossing = grid_crossing(distance, origins, directions, grid_entry(origins, directions))
    positions = origins + crossing.along[:, None] * directions
    _, gradient = value_and_gradient(distance, locate(positions, len(distance)))
    normals = F.normalize(gradient, dim=-1)
    return SeenField(
        hit=crossing.hit,
        depth=crossing.along / along_axis.norm(dim=-1),
        positions=positions,
        normals=normals,
        directions=directions,
        cosine=-(normals * directions).sum(dim=-1),
    )


def smaller(camera: Pinhole, share: float) -> Pinhole:
    """The camera of the picture at that share of its size, of at least a pixel."""
    return camera.scaled(max(round(share * camera.width), 1), max(round(share * camera.height), 1))


def at_size(image: Float[Tensor, "height width"], camera: Pinhole) -> Float[Tensor, "rows columns"]:
    """The nearest values, at a smaller camera's pixels."""
    size = (camera.height, camera.width)
    return F.interpolate(image[None, None], size=size, mode="nearest-exact")[0, 0]
