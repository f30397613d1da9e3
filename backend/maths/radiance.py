"""Emission and absorption along a ray: from densities and colours at intervals to a pixel's colour.

Names, after NeRF (Mildenhall et al., arXiv:2003.08934), eq. 1 to 5:

  density       sigma >= 0, 1 / object unit: absorption per length, constant in an interval
  edges         where a ray's S intervals begin and end, ascending; delta is an interval's length
  log_pass      -sigma delta, log of the share of light that passes the interval
  weight        share of a pixel's colour that an interval gives, from volume.blending_weights
"""

import torch
from jaxtyping import Float
from torch import Tensor

from .volume import blending_weights, log_transparency


def log_pass_of_density(
    density: Float[Tensor, "rays intervals"], edges: Float[Tensor, "rays edges"]
) -> Float[Tensor, "rays intervals"]:
    """-sigma delta; 0 in an interval without length, however dense. The product is finite."""
    return -density * edges.diff(dim=-1)


def composite(
    log_pass: Float[Tensor, "rays intervals"],
    colour: Float[Tensor, "rays intervals channels"],
    background: Float[Tensor, "*#rays channels"],
) -> Float[Tensor, "rays channels"]:
    """C = sum_i T_i (1 - exp(-sigma_i delta_i)) c_i + T_end c_background: NeRF, eq. 3, with all of the light.

    Exact for densities and colours that are constant in intervals. Weights and T_end sum to 1, so that
    colours in a range stay in it.
    """
    through = log_transparency(log_pass).exp()
    return torch.einsum("ri,ric->rc", blending_weights(log_pass), colour) + through[:, None] * background


def mean_colour(
    log_pass: Float[Tensor, "rays intervals"], colour: Float[Tensor, "rays intervals channels"]
) -> Float[Tensor, "rays channels"]:
    """Of what is opaque on a ray, whatever is behind; darker where its opacity is below a thousandth."""
    weights = blending_weights(log_pass)
    opacity = weights.sum(dim=-1, keepdim=True)
    return torch.einsum("ri,ric->rc", weights, colour) / opacity.clamp(min=1e-3)


def weight_bound(
    edges: Float[Tensor, "rays edges"],
    proposal_edges: Float[Tensor, "rays proposal_edges"],
    proposal_weights: Float[Tensor, "rays proposal_intervals"],
) -> Float[Tensor, "rays intervals"]:
    """Sum of the proposal's weights over its intervals that share some length with each interval.

    mip-NeRF 360 (Barron et al., arXiv:2111.12077), eq. 12: no histogram whose integral over every set of
    intervals agrees with the proposal's can have more weight in the interval. Light between the end of the
    proposal and the end of the ray is not counted.
    """
    summed = torch.nn.functional.pad(proposal_weights.cumsum(dim=-1), (1, 0))
    last = proposal_weights.shape[-1]
    first = torch.searchsorted(proposal_edges, edges[:, :-1].contiguous(), right=True) - 1
    after = torch.searchsorted(proposal_edges, edges[:, 1:].contiguous())
    first, after = first.clamp(0, last), after.clamp(0, last)
    return (summed.gather(-1, after) - summed.gather(-1, first)).clamp(min=0)


def proposal_loss(
    weights: Float[Tensor, "rays intervals"], bound: Float[Tensor, "rays intervals"]
) -> Float[Tensor, ""]:
    """Mean over rays of sum_i max(0, w_i - bound_i)^2 / w_i: only too little weight is a fault.

    mip-NeRF 360, eq. 13. As w ((w - bound)_+ / w)^2 the quotient is in [0, 1], so that value and gradient, at
    most 2 in size, are finite for every w >= 0, without an epsilon. `weights` get no gradient: the proposal
    follows the field, never the other way round.
    """
    weights = weights.detach()
    missing = (weights - bound).clamp(min=0) / torch.where(weights > 0, weights, 1.0)
    return (weights * missing.square()).sum(dim=-1).mean()
