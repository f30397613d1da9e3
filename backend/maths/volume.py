"""From signed distances along rays to blending weights: the only place where a distance becomes an opacity.

Names, after NeuS (Wang et al., arXiv:2106.10689):

  distance   signed, at the S + 1 edges of a ray's S intervals, > 0 outside
  sharpness  s, inverse width of the surface band, 1 / object unit
  weight     share of a pixel's colour that an interval gives; a ray's weights sum to its opacity
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import logsigmoid, pad


def log_transmittance(
    distance: Float[Tensor, "rays edges"], sharpness: float | Float[Tensor, ""]
) -> Float[Tensor, "rays intervals"]:
    """Log of the share of light that passes each interval; 0 where the ray moves away from the surface.

    NeuS, eq. 13: 1 - alpha_i = Phi(s f_{i+1}) / Phi(s f_i) with the logistic Phi, at most 1. As a difference
    of logs it is exact where both are near 0 (deep inside) and where both are near 1 (far outside).
    """
    log_phi = logsigmoid(sharpness * distance)
    return (log_phi[:, 1:] - log_phi[:, :-1]).clamp(max=0.0)


def log_transmittance_of_middles(
    distance: Float[Tensor, "rays intervals"],
    slope: Float[Tensor, "rays intervals"],
    edges: Float[Tensor, "rays edges"],
    sharpness: float | Float[Tensor, ""],
) -> Float[Tensor, "rays intervals"]:
    """The same from the distance and its slope along the ray in the middle of each interval, as NeuS does it.

    The distance at an interval's two ends is continued from its middle: neighbours need not agree there.
    """
    rise = 0.5 * slope * edges.diff(dim=-1)
    before, after = logsigmoid(sharpness * (distance - rise)), logsigmoid(sharpness * (distance + rise))
    return (after - before).clamp(max=0.0)


def annealed_slope(slope: Float[Tensor, "rays intervals"], done: float) -> Float[Tensor, "rays intervals"]:
    """Slope of the distance along the ray for `log_transmittance_of_middles`, never above 0.

    Of the published program: at the start (`done` = 0) a surface that is seen from behind absorbs as well,
    half as steeply, and gets gradients; at the end (1) only what the ray enters does.
    """
    return -((0.5 - 0.5 * slope).clamp(min=0) * (1 - done) + (-slope).clamp(min=0) * done)


def blending_weights(log_pass: Float[Tensor, "rays intervals"]) -> Float[Tensor, "rays intervals"]:
    """Weight of every interval: light that reaches it times what it absorbs."""
    # Summed over the intervals before, not over all less the own: that would lose them next to -1e7.
    reaching = torch.exp(pad(log_pass[:, :-1].cumsum(dim=-1), (1, 0)))
    return -torch.expm1(log_pass) * reaching


def log_transparency(log_pass: Float[Tensor, "rays intervals"]) -> Float[Tensor, "rays"]:
    """Log of the share of light that passes the whole ray."""
    return log_pass.sum(dim=-1)
