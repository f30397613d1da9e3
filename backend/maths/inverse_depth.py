"""Depth maps as inverse depth, in which a plane of space is an affine function of the pixel.

w(u, v) = 1 / z.  For the plane n . X = 1 in camera axes, w = n_x x + n_y y + n_z with
x = (u - cx) / fx, y = (v - cy) / fy; so slopes of w give the normal in closed form.
"""

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Float32, Int, Int64
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from ..kernels import plane_fits
from ..kernels.compiled import floats
from ..kernels.side_by_side import bands_side_by_side
from .correlation import window_moments
from .geometry import Pinhole, pixel_centres
from .pieces import connected_pieces


def fit_planes(
    inverse_depth: Float[Tensor, "height width"], weight: Float[Tensor, "height width"], radius: int
) -> Float[Tensor, "3 height width"]:
    """Weighted least-squares plane around every pixel: (value there, slope in u, slope in v), per pixel.

    A weak prior pulls the slopes to 0, so that windows with hardly any weight stay finite: by the share
    0.01 / (0.01 + variance of the window's pixels), 0.5 % for a full window of radius 2. What is
    measured where the weight is 0 has no say, whatever it is.
    """
    # less a mean, so that small slopes are not lost beside it
    usual = (weight * torch.where(weight > 0, inverse_depth, 0.0)).sum() / weight.sum().clamp(min=1e-9)
    beyond = torch.where(weight > 0, weight * (inverse_depth - usual), 0.0)
    if weight.device.type == "cpu" and weight.dtype == torch.float32:
        return _compiled_planes(weight, beyond, float(usual), radius)
    return planes_in_torch(weight, beyond, usual, radius)


def planes_in_torch(
    weight: Float[Tensor, "height width"],
    beyond: Float[Tensor, "height width"],
    usual: Float[Tensor, ""],
    radius: int,
) -> Float[Tensor, "3 height width"]:
    """`fit_planes` of the weighted values less `usual`; the reference for what is compiled."""
    of_weight = window_moments(weight, radius, second=True)
    of_values = window_moments(beyond, radius, second=False)
    total = of_weight[0].clamp(min=1e-9)
    mean_u, mean_v, mean_uu, mean_uv, mean_vv = of_weight[1:] / total
    mean_w, mean_uw, mean_vw = of_values / total
    prior = float(plane_fits.PRIOR)
    uu, uv, vv = mean_uu - mean_u**2 + prior, mean_uv - mean_u * mean_v, mean_vv - mean_v**2 + prior
    uw, vw = mean_uw - mean_u * mean_w, mean_vw - mean_v * mean_w
    determinant = uu * vv - uv * uv
    slope_u = (vv * uw - uv * vw) / determinant
    slope_v = (uu * vw - uv * uw) / determinant
    return torch.stack([usual + mean_w - slope_u * mean_u - slope_v * mean_v, slope_u, slope_v])


def _compiled_planes(
    weight: Float[Tensor, "height width"], beyond: Float[Tensor, "height width"], usual: float, radius: int
) -> Float[Tensor, "3 height width"]:
    """`fit_planes` on the CPU, bands of rows side by side."""
    around = [radius] * 4
    padded = floats(F.pad(weight, around)), floats(F.pad(beyond, around))
    height, width = weight.shape
    planes = np.empty((3, height, width), np.float32)

    def fit(rows: tuple[int, int]) -> None:
        plane_fits.fit_planes(rows, *padded, np.float32(usual), radius, planes)

    bands_side_by_side(fit, height, torch.get_num_threads())
    return torch.from_numpy(planes)


def normals_from_planes(
    planes: Float[Tensor, "3 height width"], camera: Pinhole
) -> Float[Tensor, "height width 3"]:
    """Unit normals towards the camera, object frame, of planes from `fit_planes`."""
    k = camera.intrinsics
    pixels = pixel_centres(camera.width, camera.height, planes.device)
    value, slope_u, slope_v = planes
    n_x, n_y = slope_u * k[0, 0], slope_v * k[1, 1]
    n_z = value - slope_u * (pixels[..., 0] - k[0, 2]) - slope_v * (pixels[..., 1] - k[1, 2])
    # n . X = 1 > 0 for the point seen, so n points away from the camera
    normal = -torch.stack([n_x, n_y, n_z], dim=-1)
    return F.normalize(normal, dim=-1) @ camera.camera_from_object[:3, :3]


def parabola_offset(
    before: Float[Tensor, "*batch"], best: Float[Tensor, "*batch"], after: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch"]:
    """Where, in steps from the middle one, the parabola through three costs is lowest; within half a step."""
    curvature = before - 2 * best + after
    offset = 0.5 * (before - after) / torch.where(curvature > 1e-12, curvature, 1.0)
    return torch.where(curvature > 1e-12, offset, 0.0).clamp(-0.5, 0.5)


def lowest_with_neighbours(
    cost: Float[Tensor, "*batch planes"],
) -> tuple[Int[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Index of the lowest cost on the last axis, and the sub-step offset of its parabola."""
    cost = cost.contiguous()  # along memory the search is five times as fast
    last = cost.shape[-1] - 1
    index = cost.argmin(dim=-1)
    around = torch.stack([(index - 1).clamp(min=0), index, (index + 1).clamp(max=last)], dim=-1)
    before, best, after = cost.gather(-1, around).unbind(-1)
    offset = parabola_offset(before, best, after)
    return index, torch.where((index > 0) & (index < last), offset, 0.0)


def distance_from_edges_px(
    inverse_depth: Float[Tensor, "height width"],
    subject: Bool[Tensor, "height width"],
    largest_step: Float[Tensor, "height width"],
) -> Float[Tensor, "height width"]:
    """Distance of every pixel to the nearest that is off the subject or beside a jump; 0 on those.

    A jump is where neighbours differ by more than `largest_step` of either, in the unit of `inverse_depth`.
    Without any edge it is the sum of the picture's sides.
    """
    smooth = subject.clone()
    for one, other in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        change = (inverse_depth[one] - inverse_depth[other]).abs()
        same = change <= torch.minimum(largest_step[one], largest_step[other])
        smooth[one] &= same
        smooth[other] &= same
    if smooth.all():
        return torch.full_like(inverse_depth, float(sum(smooth.shape)))
    distance = distance_transform_edt(smooth.cpu().numpy())
    return torch.tensor(distance, dtype=torch.float32, device=smooth.device)


def piece_sizes(
    measured: Bool[np.ndarray, "height width"],
    inverse_depth: Float32[np.ndarray, "height width"],
    largest_jump: float,
) -> Int64[np.ndarray, "height width"]:
    """How many measured pixels each is connected with: side by side, depths apart by less than that share."""
    height, width = measured.shape
    number = np.arange(height * width).reshape(height, width)
    pairs = []
    for one, other in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        apart = np.abs(inverse_depth[one] - inverse_depth[other])
        joined = measured[one] & measured[other] & (apart < largest_jump * inverse_depth[one])
        pairs.append(np.stack([number[one][joined], number[other][joined]]))
    piece = connected_pieces(np.concatenate(pairs, axis=1), height * width)
    sizes: Int64[np.ndarray, "height width"] = np.bincount(piece)[piece].reshape(height, width)
    return sizes
