"""Where in a patch its texture lies: what tells the depth of the patch, and of its middle."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from .correlation import window_moments

_OF_A_PIXEL = 0.5
"""Variance, in square pixels, that is added to where texture lies: so thin is no edge."""


def leverage(
    image: Float[Tensor, "height width"],
    subject: Bool[Tensor, "height width"],
    radius: int,
    noise: float,
) -> Float[Tensor, "height width"]:
    """By how much the depth of a patch's middle varies more than if its texture lay evenly around it; >= 1.

    A patch is a plane of inverse depth, and its depth is known where its gradient is. With squared
    gradients g^2 as weights, the plane's value in the middle has the variance (1 + m' C^-1 m) / sum g^2,
    m being where the texture lies on average and C its covariance (the leverage of weighted least
    squares): a smooth place beside an edge has the edge's depth, continued. Noise lies evenly everywhere,
    and what is off the subject is no texture. `noise` must be larger than 0.
    """
    inner = F.max_pool2d((~subject).float()[None], 3, 1, 1)[0] == 0
    along, down = torch.zeros_like(image), torch.zeros_like(image)
    along[:, 1:-1] = (image[:, 2:] - image[:, :-2]) / 2
    down[1:-1] = (image[2:] - image[:-2]) / 2
    energy = (along.square() + down.square()) * inner + (0.5 * noise) ** 2
    sums = window_moments(energy, radius, second=True)
    mean_u, mean_v, mean_uu, mean_uv, mean_vv = sums[1:] / sums[0]
    uu, uv, vv = (
        mean_uu - mean_u**2 + _OF_A_PIXEL,
        mean_uv - mean_u * mean_v,
        mean_vv - mean_v**2 + _OF_A_PIXEL,
    )
    beside = vv * mean_u**2 - 2 * uv * mean_u * mean_v + uu * mean_v**2
    found: Float[Tensor, "height width"] = 1 + beside / (uu * vv - uv * uv)
    return found
