"""Pinhole projection and warps between views, in torch.

Names: `intrinsics` is K (3x3), pixel = K X / depth; `b_from_a` are 4x4 rigid transforms; pixels are
(column, row) with the centre of the top left pixel at (0.5, 0.5); inverse depth is 1 / z, not 1 / distance.
"""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from ..scene import Camera, Region


@dataclass(frozen=True, kw_only=True, eq=False)
class Pinhole:
    """A camera of the object frame as tensors; lengths in object units. One is equal to itself alone."""

    intrinsics: Float[Tensor, "3 3"]
    camera_from_object: Float[Tensor, "4 4"]
    width: int
    height: int

    @cached_property
    def position(self) -> Float[Tensor, "3"]:
        """Centre of projection, object frame."""
        return -self.camera_from_object[:3, :3].T @ self.camera_from_object[:3, 3]

    def cpu(self) -> "Pinhole":
        """The same camera in the processor's memory."""
        return replace(
            self, intrinsics=self.intrinsics.cpu(), camera_from_object=self.camera_from_object.cpu()
        )

    def scaled(self, width: int, height: int) -> "Pinhole":
        """The same camera over an image of another size."""
        scale = self.intrinsics.new_tensor([[width / self.width], [height / self.height], [1.0]])
        return replace(self, intrinsics=self.intrinsics * scale, width=width, height=height)

    def cropped(self, left: int, top: int, width: int, height: int) -> "Pinhole":
        """The same camera over a window of its image."""
        shift = torch.zeros_like(self.intrinsics)
        shift[0, 2], shift[1, 2] = left, top
        return replace(self, intrinsics=self.intrinsics - shift, width=width, height=height)


def pinhole_in_object(camera: Camera, region: Region, device: torch.device) -> Pinhole:
    """The camera with object_from_world's similarity moved into it: rotation stays a rotation."""
    camera_from_object = camera.camera_from_world @ region.world_from_object
    camera_from_object[:3] /= region.radius_world
    return Pinhole(
        intrinsics=torch.tensor(camera.intrinsics, dtype=torch.float32, device=device),
        camera_from_object=torch.tensor(camera_from_object, dtype=torch.float32, device=device),
        width=camera.width,
        height=camera.height,
    )


def pixel_centres(width: int, height: int, device: torch.device) -> Float[Tensor, "height width 2"]:
    """(column, row) of every pixel's centre."""
    rows, columns = torch.meshgrid(
        torch.arange(height, device=device) + 0.5, torch.arange(width, device=device) + 0.5, indexing="ij"
    )
    return torch.stack([columns, rows], dim=-1)


def project(
    camera: Pinhole, points: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch"]]:
    """Pixel and depth of points of the object frame; the pixel means nothing where depth <= 0."""
    in_camera = points @ camera.camera_from_object[:3, :3].T + camera.camera_from_object[:3, 3]
    depth = in_camera[..., 2]
    homogeneous = in_camera @ camera.intrinsics.T
    return homogeneous[..., :2] / torch.where(depth > 0, depth, 1.0)[..., None], depth


def ray_directions(camera: Pinhole, pixels: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
    """Directions in the object frame, scaled so that position + depth * direction has that depth."""
    k = camera.intrinsics
    y = (pixels[..., 1] - k[1, 2]) / k[1, 1]
    x = (pixels[..., 0] - k[0, 2] - k[0, 1] * y) / k[0, 0]
    return torch.stack([x, y, torch.ones_like(x)], dim=-1) @ camera.camera_from_object[:3, :3]


def unproject(
    camera: Pinhole, pixels: Float[Tensor, "*batch 2"], depth: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 3"]:
    """Points of the object frame at given depths: the inverse of `project`."""
    return camera.position + depth[..., None] * ray_directions(camera, pixels)


def seen_places(camera: Pinhole, depth: Float[Tensor, "height width"]) -> Float[Tensor, "height width 3"]:
    """What each pixel of the camera shows at its depth, object frame."""
    return unproject(camera, pixel_centres(camera.width, camera.height, depth.device), depth)


@lru_cache(maxsize=1024)  # the same few pairs are compared at every step; inverting takes a GPU long
def epipolar_map(source: Pinhole, reference: Pinhole) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """(A, b) such that reference pixel u at inverse depth w is seen at A [u 1] + w b, homogeneous."""
    source_from_reference = source.camera_from_object @ torch.linalg.inv(reference.camera_from_object)
    rotation, translation = source_from_reference[:3, :3], source_from_reference[:3, 3]
    a = source.intrinsics @ rotation @ torch.linalg.inv(reference.intrinsics)
    return a, source.intrinsics @ translation


def warp_pixels(
    a: Float[Tensor, "3 3"],
    b: Float[Tensor, "3"],
    pixels: Float[Tensor, "height width 2"],
    inverse_depth: Float[Tensor, "planes height width"],
) -> Float[Tensor, "planes height width 2"]:
    """Where the source sees reference pixels at the given inverse depths; far outside where it is behind."""
    base, divisor = _in_source(a, b, pixels, inverse_depth)
    where = inverse_depth.new_empty((*inverse_depth.shape, 2))
    for axis in (0, 1):
        torch.div(torch.addcmul(base[axis], inverse_depth, b[axis]), divisor, out=where[..., axis])
    return where


def match_speed_px(
    a: Float[Tensor, "3 3"],
    b: Float[Tensor, "3"],
    pixels: Float[Tensor, "height width 2"],
    inverse_depth: Float[Tensor, "height width"],
) -> Float[Tensor, "height width"]:
    """Pixels by which what `warp_pixels` gives moves in the source, per unit of inverse depth."""
    (x, y, z), divisor = _in_source(a, b, pixels, inverse_depth)
    return torch.hypot(z * b[0] - x * b[2], z * b[1] - y * b[2]) / divisor.square()


def _in_source(
    a: Float[Tensor, "3 3"],
    b: Float[Tensor, "3"],
    pixels: Float[Tensor, "height width 2"],
    inverse_depth: Float[Tensor, "*planes height width"],
) -> tuple[tuple[Float[Tensor, "height width"], ...], Float[Tensor, "*planes height width"]]:
    """Where the source sees the pixels at infinity, homogeneous, and the divisor at the inverse depths."""
    column, row = pixels.unbind(dim=-1)
    x, y, z = ((a[axis, 0] * column).add_(a[axis, 1] * row).add_(a[axis, 2]) for axis in range(3))
    divisor = z + inverse_depth * b[2]
    return (x, y, z), torch.where(divisor > 1e-6, divisor, 1e-9)  # behind: thrown out of the image


def inside(pixels: Float[Tensor, "*batch 2"], width: int, height: int) -> Bool[Tensor, "*batch"]:
    """True where a pixel lies in the image."""
    x, y = pixels[..., 0], pixels[..., 1]
    return (x >= 0) & (x < width) & (y >= 0) & (y < height)


def sample_image(
    image: Float[Tensor, "channels height width"],
    pixels: Float[Tensor, "batch rows columns 2"],
    mode: str = "bilinear",
) -> Float[Tensor, "batch channels rows columns"]:
    """Interpolated values at pixels; the border's values outside the image.

    The batch axis is what torch spreads over threads: keep it larger than one.
    """
    height, width = image.shape[1:]
    scale = pixels.new_tensor([2.0 / width, 2.0 / height])
    grid = (pixels * scale - 1.0).clamp(-4.0, 4.0)
    return F.grid_sample(
        image.expand(len(pixels), -1, -1, -1), grid, mode=mode, padding_mode="border", align_corners=False
    )
