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
    distance: Float[Tensor, "rays edges"], sharpness: float
) -> Float[Tensor, "rays intervals"]:
    """Log of the share of light that passes each interval; 0 where the ray moves away from the surface.

    NeuS, eq. 13: 1 - alpha_i = Phi(s f_{i+1}) / Phi(s f_i) with the logistic Phi, at most 1. As a difference
    of logs it is exact where both are near 0 (deep inside) and where both are near 1 (far outside).
    """
    log_phi = logsigmoid(sharpness * distance)
    return (log_phi[:, 1:] - log_phi[:, :-1]).clamp(max=0.0)


def blending_weights(log_pass: Float[Tensor, "rays intervals"]) -> Float[Tensor, "rays intervals"]:
    """Weight of every interval: light that reaches it times what it absorbs."""
    # Summed over the intervals before, not over all less the own: that would lose them next to -1e7.
    reaching = torch.exp(pad(log_pass[:, :-1].cumsum(dim=-1), (1, 0)))
    return -torch.expm1(log_pass) * reaching


def log_transparency(log_pass: Float[Tensor, "rays intervals"]) -> Float[Tensor, "rays"]:
    """Log of the share of light that passes the whole ray."""
    return log_pass.sum(dim=-1)
