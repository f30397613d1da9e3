"""Where to sample rays again, given how much each of their intervals matters.

A ray's edges cut it into intervals; their weights are taken for a density that is constant in each, and
new positions are drawn from it by its inverse distribution function (NeRF, arXiv:2003.08934, section 5.2).
"""

import torch
from jaxtyping import Float
from torch import Tensor

_BELOW_ONE = 1 - 2.0**-24
"""Largest float32 below 1: (count - 1 + 0.99999994) / count rounds to 1, which lies in no interval."""


def strata(
    rays: int, count: int, generator: torch.Generator | None, device: torch.device
) -> Float[Tensor, "rays count"]:
    """One number in each of `count` equal parts of [0, 1), ascending: drawn, or its middle.

    Without a generator it is the middle.
    """
    if generator is None:
        within = torch.full((rays, count), 0.5, device=device)
    else:
        within = torch.rand((rays, count), generator=generator, device=generator.device).to(device)
    return ((torch.arange(count, device=device) + within) / count).clamp(max=_BELOW_ONE)


def resample(
    edges: Float[Tensor, "rays edges"],
    weights: Float[Tensor, "rays intervals"],
    shares: Float[Tensor, "rays samples"],
) -> Float[Tensor, "rays samples"]:
    """Position below which the given shares, in [0, 1), of a ray's weight lie; ascending as they are.

    Weights are finite and not negative, of any size down to the smallest; an interval without weight gets no
    sample, a single one with weight gets all. Where a ray has no weight at all, every place counts alike. The
    result carries no gradient: where to look is not what is learned from what is seen.
    """
    with torch.no_grad():
        lengths = edges.diff(dim=-1)
        largest = weights.amax(dim=-1, keepdim=True)
        # Divided by the largest first: the sum of huge weights would be infinite.
        mass = torch.where(largest > 0, weights / torch.where(largest > 0, largest, 1.0), lengths)
        # A parallel sum may step back in its last digit; the largest so far does not.
        below = mass.cumsum(dim=-1).cummax(dim=-1).values
        total = below[:, -1:]
        below = torch.where(total > 0, below / torch.where(total > 0, total, 1.0), 1.0)
        # The first interval whose upper share is larger than the one asked for: never one without mass.
        interval = torch.searchsorted(below, shares.contiguous(), right=True)
        upper = below.gather(-1, interval)
        lower = torch.where(interval > 0, below.gather(-1, (interval - 1).clamp(min=0)), 0.0)
        part = (shares - lower) / (upper - lower)
        return edges.gather(-1, interval).lerp(edges.gather(-1, interval + 1), part)
