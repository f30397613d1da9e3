"""Agreement of image patches, robust to exposure and to noise.

Window sums go through running sums, so that their cost does not depend on the window; images are
first freed of their local mean, which keeps those running sums small and float32 exact enough.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


def window_sum(
    values: Float[Tensor, "*batch height width"], radius: int
) -> Float[Tensor, "*batch height width"]:
    """Sum over the (2 radius + 1)^2 window around every pixel; nothing is added beyond the border.

    ValueError if the image is not larger than the window along both axes.
    """
    for axis in (-1, -2):
        running = values.cumsum(axis)
        count = values.shape[axis]
        width = 2 * radius + 1
        if count <= width:
            raise ValueError(f"a window of {width} pixels needs a larger image than {tuple(values.shape)}")
        values = torch.empty_like(running)
        values.narrow(axis, 0, radius + 1).copy_(running.narrow(axis, radius, radius + 1))
        torch.sub(
            running.narrow(axis, width, count - width),
            running.narrow(axis, 0, count - width),
            out=values.narrow(axis, radius + 1, count - width),
        )
        torch.sub(
            running.narrow(axis, count - 1, 1),
            running.narrow(axis, count - width, radius),
            out=values.narrow(axis, count - radius, radius),
        )
    return values


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

    `noise` is the standard deviation that sensor and coding leave in a flat patch; its variance
    joins the denominator, so that flat patches score low whatever they are compared with.
    """
    weighted = warped * reference.subject
    products = torch.stack([weighted, weighted * warped, weighted * reference.image])
    sums = window_sum(products, reference.radius) / reference.count
    variance = (sums[1] - sums[0] * sums[0]).clamp(min=0)
    covariance = sums[2] - sums[0] * reference.mean
    floor = noise * noise
    return covariance * torch.rsqrt((reference.variance + floor) * (variance + floor))
