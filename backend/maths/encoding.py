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


def wave_window(frequencies: int, coordinates: int, active: float) -> Float[Tensor, "features"]:
    """Weights for `positional_encoding` that let `active` of the frequencies count, the lowest first.

    Linear between whole numbers. Coarse before fine, as in BARF (Lin et al., arXiv:2104.06405, eq. 14) and,
    for few photographs, FreeNeRF (Yang et al., arXiv:2303.07418): high waves fit pixels before a shape.
    """
    weight = (active - torch.arange(frequencies)).clamp(0, 1)
    return weight.repeat_interleave(coordinates).repeat(2)
