"""Agreement of image patches, robust to exposure and to noise.

Window sums are put together from sums of 1, 2, 4, ... neighbours: their cost grows with the logarithm of
the window, and unlike differences of running sums they lose nothing where the rest of the image is bright.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor


def window_sum(
    values: Float[Tensor, "*batch height width"], radius: int
) -> Float[Tensor, "*batch height width"]:
    """Sum over the (2 radius + 1)^2 window around every pixel; nothing is added beyond the border."""
    return _sum_along(_sum_along(values, -1, radius), -2, radius)


def window_moments(
    values: Float[Tensor, "height width"], radius: int, *, second: bool
) -> Float[Tensor, "moments height width"]:
    """Sums over the window of values times 1, u, v and, if asked, u^2, u v, v^2; u and v from its middle."""
    offsets = torch.arange(-radius, radius + 1, dtype=values.dtype, device=values.device)
    v, u = torch.meshgrid(offsets, offsets, indexing="ij")
    moments = torch.stack([torch.ones_like(u), u, v, *((u * u, u * v, v * v) if second else ())])
    return F.conv2d(values[None, None], moments[:, None], padding=radius)[0]


def _sum_along(
    values: Float[Tensor, "*batch height width"], axis: int, radius: int
) -> Float[Tensor, "*batch height width"]:
    """Put together from the sums of 1, 2, 4, ... neighbours."""
    count, width = values.shape[axis], 2 * radius + 1
    block = F.pad(values, (radius, radius) if axis == -1 else (0, 0, radius, radius))
    total, start, size = block.narrow(axis, 0, count), 1, 1
    while 2 * size <= width:
        shorter = block.shape[axis] - size
        block = block.narrow(axis, 0, shorter) + block.narrow(axis, size, shorter)
        size *= 2
        if width & size:
            total = total + block.narrow(axis, start, count)
            start += size
    return total


def window_mean(
    values: Float[Tensor, "height width"], weight: Float[Tensor, "height width"], radius: int
) -> Float[Tensor, "height width"]:
    """Weighted mean over the window around every pixel; 0 where there is no weight."""
    sums = window_sum(torch.stack([weight * values, weight]), radius)
    return sums[0] / sums[1].clamp(min=1e-3)


def without_local_mean(
    image: Float[Tensor, "height width"], subject: Float[Tensor, "height width"], radius: int
) -> Float[Tensor, "height width"]:
    """The image less the subject's mean over a window; 0 off the subject."""
    return (image - window_mean(image, subject, radius)) * subject


@dataclass(frozen=True, kw_only=True)
class PatchStatistics:
    """Mean and spread of the reference's patches, computed once for many comparisons."""

    image: Float[Tensor, "height width"]
    subject: Float[Tensor, "height width"]
    """Weight of each pixel in the patches it belongs to: 0 off the subject, so that what lies behind a
    silhouette has no say in the depth of the rim."""
    count: Float[Tensor, "height width"]
    mean: Float[Tensor, "height width"]
    variance: Float[Tensor, "height width"]
    radius: int


def patch_statistics(
    image: Float[Tensor, "height width"], subject: Float[Tensor, "height width"], radius: int
) -> PatchStatistics:
    """Statistics of the (2 radius + 1)^2 patches of an image, weighted by `subject`."""
    sums = window_sum(torch.stack([subject, subject * image, subject * image * image]), radius)
    count = sums[0].clamp(min=1e-3)
    mean = sums[1] / count
    variance = (sums[2] / count - mean * mean).clamp(min=0)
    return PatchStatistics(
        image=image, subject=subject, count=count, mean=mean, variance=variance, radius=radius
    )


def correlation(
    reference: PatchStatistics, warped: Float[Tensor, "planes height width"], noise: float
) -> Float[Tensor, "planes height width"]:
    """Normalised cross-correlation of patches, in [-1, 1], shrunk towards 0 where there is only noise.

    `noise` is the standard deviation that sensor and coding leave in a flat patch, in the images' unit; its
    variance joins the denominator, so that flat patches score low whatever they are compared with.
    """
    weighted = warped * reference.subject
    products = torch.stack([weighted, weighted * warped, weighted * reference.image])
    sums = window_sum(products, reference.radius) / reference.count
    variance = (sums[1] - sums[0] * sums[0]).clamp(min=0)
    covariance = sums[2] - sums[0] * reference.mean
    floor = noise * noise
    return covariance * torch.rsqrt((reference.variance + floor) * (variance + floor))
