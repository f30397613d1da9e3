"""From a distance that is a function of place to one on a grid around the surface."""

import torch
from jaxtyping import Float
from torch import Tensor

from ..maths.grid import node_positions
from ..maths.rays import DistanceFunction
from ..scene import Region
from .surface import COARSEST, Surface, tight_frame

_AT_ONCE = 2**16
"""Points in one call of the function: memory for more would not make it quicker."""


def field_surface(distance: DistanceFunction, region: Region, nodes: int, device: torch.device) -> Surface:
    """The distance in the region's unit sphere on a grid of its own, laid tightly around the inside.

    Raises ReconstructionError(NO_SURFACE) if there is no inside.
    """
    frame = region.part(tight_frame(on_grid(distance, region, region, COARSEST, device)))
    return surface_in(distance, region, frame, nodes, device)


def surface_in(
    distance: DistanceFunction, region: Region, frame: Region, nodes: int, device: torch.device
) -> Surface:
    """The distance on a grid over the cube of a frame."""
    grid = on_grid(distance, region, frame, nodes, device)
    return Surface(distance=grid.cpu().numpy(), grid_from_world=frame.object_from_world)


def on_grid(
    distance: DistanceFunction, region: Region, frame: Region, nodes: int, device: torch.device
) -> Float[Tensor, "nodes nodes nodes"]:
    """The distance at the nodes of the frame's cube, in its units, cut off at the region's unit sphere.

    Outside the sphere no ray ever asked the function: what it says there is chance.
    """
    region_from_frame = region.object_from_world @ frame.world_from_object
    scale = frame.radius_world / region.radius_world
    middle = torch.tensor(region_from_frame[:3, 3], dtype=torch.float32, device=device)
    points = node_positions(nodes, device).reshape(-1, 3) * scale + middle
    with torch.no_grad():
        values = torch.cat([distance(part) for part in torch.split(points, _AT_ONCE)])
    return (torch.maximum(values, points.norm(dim=-1) - 1) / scale).reshape(nodes, nodes, nodes)
