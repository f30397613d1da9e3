"""Where a patch of surface, seen by one camera, truly lies in the picture of another: fractions of a pixel.

A patch is a square of pixels of the reference picture, carried by the plane of its surface. Cameras and plane
say where each of its pixels should lie in the other picture; measured is by how much the whole patch lies
beside that place. It is image registration by Gauss-Newton (Lucas and Kanade, IJCAI 1981).
"""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float64
from torch import Tensor

from ..scene import Camera
from .gauge import cross_matrix
from .geometry import Pinhole, ray_directions, sample_image

_LEAST_SPREAD = 1e-6
"""Of a patch, in grey: keeps one without any texture from dividing by zero."""


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """What was measured of each patch."""

    shift_px: Float[Tensor, "patches 2"]
    """(column, row) from the place where the cameras say it is to where it is."""
    correlation: Float[Tensor, "patches"]
    """Of the patches at that place, in [-1, 1]."""
    sigma_px: Float[Tensor, "patches"]
    """Standard deviation of the shift in its least certain direction, by what is left of difference."""


def patch_pixels(pixels: Float[Tensor, "patches 2"], radius: int) -> Float[Tensor, "patches patch_pixels 2"]:
    """The (2 radius + 1)^2 places, a pixel apart, around each pixel."""
    steps = torch.arange(-radius, radius + 1, dtype=pixels.dtype, device=pixels.device)
    rows, columns = torch.meshgrid(steps, steps, indexing="ij")
    return pixels[:, None] + torch.stack([columns, rows], dim=-1).reshape(-1, 2)


def on_planes(
    camera: Pinhole,
    pixels: Float[Tensor, "patches patch_pixels 2"],
    positions: Float[Tensor, "patches 3"],
    normals: Float[Tensor, "patches 3"],
) -> Float[Tensor, "patches patch_pixels 3"]:
    """Where the rays of each patch's pixels meet the plane through its position, object frame."""
    directions = ray_directions(camera, pixels)
    height = ((positions - camera.position) * normals).sum(dim=-1)
    along = height[:, None] / (directions * normals[:, None]).sum(dim=-1)
    return camera.position + along[..., None] * directions


def align(
    reference: Float[Tensor, "patches patch_pixels"],
    image: Float[Tensor, "height width"],
    places: Float[Tensor, "patches patch_pixels 2"],
    *,
    rounds: int,
    reach_px: float,
) -> Alignment:
    """The shifts of `places` in `image` at which the greys there are most like those of the reference.

    Gauss-Newton on the difference of patches of mean 0 and length 1, which is 2 (1 - correlation): gain and
    offset of either picture have no say. Steps are at most a pixel, shifts at most `reach_px` along an axis.
    """
    wanted = _standardised(reference)[0]
    layers = torch.stack([image, *_slopes(image)])
    shift = torch.zeros_like(places[:, 0])
    for _ in range(rounds):
        difference, slopes = _compared(wanted, layers, places + shift[:, None])
        step = _solved(slopes, difference)
        step = step * (1.0 / step.norm(dim=-1, keepdim=True).clamp(min=1.0))
        shift = (shift + step).clamp(-reach_px, reach_px)
    difference, slopes = _compared(wanted, layers, places + shift[:, None])
    left = difference.square().sum(dim=-1)
    information = torch.linalg.eigvalsh(slopes @ slopes.mT)[:, 0].clamp(min=_LEAST_SPREAD)
    return Alignment(
        shift_px=shift,
        correlation=1 - left / 2,
        sigma_px=(left / wanted.shape[1] / information).sqrt(),
    )


def _standardised(
    values: Float[Tensor, "patches patch_pixels"],
) -> tuple[Float[Tensor, "patches patch_pixels"], Float[Tensor, "patches 1"]]:
    """Patches of mean 0 and length 1, and the lengths they had."""
    flat = values - values.mean(dim=-1, keepdim=True)
    length = flat.norm(dim=-1, keepdim=True).clamp(min=_LEAST_SPREAD)
    return flat / length, length


def _slopes(
    image: Float[Tensor, "height width"],
) -> tuple[Float[Tensor, "height width"], Float[Tensor, "height width"]]:
    """Per pixel along columns and rows, by central differences."""
    padded = F.pad(image[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    across = (padded[1:-1, 2:] - padded[1:-1, :-2]) / 2
    down = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2
    return across, down


def _compared(
    wanted: Float[Tensor, "patches patch_pixels"],
    layers: Float[Tensor, "3 height width"],
    places: Float[Tensor, "patches patch_pixels 2"],
) -> tuple[Float[Tensor, "patches patch_pixels"], Float[Tensor, "patches 2 patch_pixels"]]:
    """What the standardised patch there lacks, and its derivative by a shift along columns and rows."""
    grey, *along = sample_image(layers, places[None])[0]
    there, length = _standardised(grey)
    slopes = torch.stack(along, dim=1) / length[..., None]
    slopes = slopes - slopes.mean(dim=-1, keepdim=True)
    slopes = slopes - (slopes @ there[..., None]) * there[:, None]
    return wanted - there, slopes


def _solved(
    slopes: Float[Tensor, "patches 2 patch_pixels"], difference: Float[Tensor, "patches patch_pixels"]
) -> Float[Tensor, "patches 2"]:
    """The least-squares shift; next to none along an edge, where there is nothing to see of it."""
    normal = slopes @ slopes.mT + _LEAST_SPREAD * torch.eye(2, dtype=slopes.dtype, device=slopes.device)
    step: Float[Tensor, "patches 2"] = torch.linalg.solve(normal, slopes @ difference[..., None])[..., 0]
    return step


def fundamental_matrix(a: Camera, b: Camera) -> Float64[np.ndarray, "3 3"]:
    """F of pixel_b^T F pixel_a = 0 for all points in space."""
    b_from_a = b.camera_from_world @ np.linalg.inv(a.camera_from_world)
    essential = cross_matrix(b_from_a[:3, 3]) @ b_from_a[:3, :3]
    fundamental: Float64[np.ndarray, "3 3"]
    fundamental = np.linalg.inv(b.intrinsics).T @ essential @ np.linalg.inv(a.intrinsics)
    return fundamental


def beside_epipolar_lines_px(
    a: Camera, b: Camera, pixels_a: Float64[np.ndarray, "points 2"], pixels_b: Float64[np.ndarray, "points 2"]
) -> Float64[np.ndarray, "points"]:
    """Signed distance of each pixel of b from the epipolar line of its pixel of a.

    No depth enters: it is what cameras alone have to answer for.
    """
    ones = np.ones((len(pixels_a), 1))
    lines = np.concatenate([pixels_a, ones], axis=1) @ fundamental_matrix(a, b).T
    heights = (lines * np.concatenate([pixels_b, ones], axis=1)).sum(axis=1)
    distances: Float64[np.ndarray, "points"] = heights / np.linalg.norm(lines[:, :2], axis=1)
    return distances
