"""Positional encoding: coordinates as waves, so that a small network can follow fine detail.

NeRF (Mildenhall et al., arXiv:2003.08934), eq. 4: (sin(2^k pi x), cos(2^k pi x)) for k = 0, 1, ...
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def positional_encoding(
    x: Float[Tensor, "*batch coordinates"], frequencies: int
) -> Float[Tensor, "*batch features"]:
    """sin(2^k pi x) for k below `frequencies` and each coordinate, then the cosines in the same order.

    The usual pi * 2^k * x is rounded after it has grown: at k = 15 its phase is off by 1e-2 in float32. Here
    2^k x is exact, whole turns are taken off exactly, and only then is there a product with pi, so that the
    error is below 5e-7 at every frequency. Finite x with 2^k x in the range of its floating type.
    """
    scale = 2.0 ** torch.arange(frequencies, device=x.device, dtype=x.dtype)
    half_turns = x[..., None, :] * scale[:, None]
    phase = math.pi * (half_turns - 2 * (half_turns / 2).round()).flatten(start_dim=-2)
    return torch.cat([phase.sin(), phase.cos()], dim=-1)
