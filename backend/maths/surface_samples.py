"""Where to sample rays so that samples gather at a surface that is still being learned."""

import torch
from jaxtyping import Float
from torch import Tensor

from .rays import DistanceFunction, points_along
from .resampling import resample, strata
from .volume import blending_weights, log_transmittance

FIRST_SHARPNESS = 64.0
"""Of the first round of importance sampling, 1 / object unit; each later one has twice that of the last."""


def surface_samples(
    distance: DistanceFunction,
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    span: tuple[Float[Tensor, "rays"], Float[Tensor, "rays"]],
    *,
    uniform: int,
    rounds: int,
    per_round: int,
    generator: torch.Generator | None,
) -> Float[Tensor, "rays edges"]:
    """Distances from the origin, ascending: `uniform` over the span, then rounds where the surface may be.

    Directions are unit vectors; origins, span and the field's values share one unit of length.

    NeuS (arXiv:2106.10689), section 3.3: each round weighs the intervals so far as if the field were
    rendered with a sharpness of 64, 128, ..., whatever has been learned. The field is asked at the
    intervals' ends, so the weights are eq. 13 itself and need no guess at slopes. Without a generator
    nothing is drawn. No gradients.
    """

    def at(along: Float[Tensor, "rays samples"]) -> Float[Tensor, "rays samples"]:
        points = points_along(origins, directions, along)
        return distance(points.reshape(-1, 3)).reshape(along.shape)

    with torch.no_grad():
        near, far = span
        shares = strata(len(origins), uniform, generator, origins.device)
        edges = near[:, None] + (far - near)[:, None] * shares
        values = at(edges)
        for number in range(rounds):
            weights = blending_weights(log_transmittance(values, FIRST_SHARPNESS * 2.0**number))
            more = resample(edges, weights, strata(len(origins), per_round, None, origins.device))
            edges, order = torch.cat([edges, more], dim=-1).sort(dim=-1)
            values = torch.cat([values, at(more)], dim=-1).gather(-1, order)
    return edges
