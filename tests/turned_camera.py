"""A camera that looks at the middle of the object frame from any side, and what it sees of a ball there."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from backend.maths.geometry import Pinhole, pixel_centres, ray_directions


def turned_camera(angle_deg: float, *, focal_px: float, size: int) -> Pinhole:
    """Three units away from the middle, turned about y; a square picture."""
    a = math.radians(angle_deg)
    camera_from_object = torch.eye(4)
    camera_from_object[:3, :3] = torch.tensor(
        [[math.cos(a), 0, -math.sin(a)], [0, 1, 0], [math.sin(a), 0, math.cos(a)]]
    )
    camera_from_object[2, 3] = 3.0
    intrinsics = torch.tensor([[focal_px, 0, size / 2], [0, focal_px, size / 2], [0, 0, 1]])
    return Pinhole(intrinsics=intrinsics, camera_from_object=camera_from_object, width=size, height=size)


def ball_depth(camera: Pinhole, radius: float) -> Float[Tensor, "height width"]:
    """Along the axis, of a ball around the middle; 0 where it is missed."""
    rays = ray_directions(camera, pixel_centres(camera.width, camera.height, torch.device("cpu")))
    a, b = (rays * rays).sum(-1), (rays * camera.position).sum(-1)
    root = b * b - a * (camera.position.square().sum() - radius**2)
    return torch.where(root > 0, (-b - root.clamp(min=0).sqrt()) / a, 0.0)
