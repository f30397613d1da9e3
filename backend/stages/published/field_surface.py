"""From a distance that is a function of place to one on a grid around the surface."""

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from ...maths.grid import node_positions
from ...maths.rays import DistanceFunction
from ...scene import Region
from ..surface import COARSEST, Surface, tight_frame

_AT_ONCE = 2**16
"""Points in one call of the function: memory for more would not make it quicker."""


def field_surface(distance: DistanceFunction, region: Region, nodes: int, device: torch.device) -> Surface:
    """The distance in the region's unit sphere on a grid of its own, laid tightly around the inside.

    Raises ReconstructionError(NO_SURFACE) if there is no inside.
    """
    frame_from_object = tight_frame(on_grid(distance, np.eye(4), COARSEST, device))
    return surface_in(distance, region, frame_from_object, nodes, device)


def surface_in(
    distance: DistanceFunction,
    region: Region,
    frame_from_object: Float64[np.ndarray, "4 4"],
    nodes: int,
    device: torch.device,
) -> Surface:
    """The distance on a grid over the cube of a frame without rotation against the region's."""
    grid = on_grid(distance, frame_from_object, nodes, device)
    return Surface(
        distance=grid.cpu().numpy(), grid_from_world=region.part(frame_from_object).object_from_world
    )


def on_grid(
    distance: DistanceFunction,
    frame_from_object: Float64[np.ndarray, "4 4"],
    nodes: int,
    device: torch.device,
) -> Float[Tensor, "nodes nodes nodes"]:
    """The distance at the nodes of the frame's cube, in its units, cut off at the region's unit sphere.

    Outside the sphere no ray ever asked the function: what it says there is chance.
    """
    object_from_frame = np.linalg.inv(frame_from_object)
    scale = float(object_from_frame[0, 0])
    middle = torch.tensor(object_from_frame[:3, 3], dtype=torch.float32, device=device)
    points = node_positions(nodes, device).reshape(-1, 3) * scale + middle
    with torch.no_grad():
        values = torch.cat([distance(part) for part in torch.split(points, _AT_ONCE)])
    return (torch.maximum(values, points.norm(dim=-1) - 1) / scale).reshape(nodes, nodes, nodes)
