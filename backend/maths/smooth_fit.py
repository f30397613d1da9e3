"""The smoothest function on a grid that agrees with measurements at its nodes.

Minimises  sum_i weight_i (f_i - target_i)^2 + smoothness * |Laplacian f|^2  over all nodes, which is
linear (Calakli and Taubin, "SSD: smooth signed distance surface reconstruction", 2011, in its
simplest discrete form): solved by conjugate gradients, to start from a coarser grid's solution.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from ..kernels import bending
from ..kernels.compiled import floats
from .conjugate_gradients import conjugate_gradients
from .grid import laplacian


def fit_smooth(
    target: Float[Tensor, "nodes nodes nodes"],
    weight: Float[Tensor, "nodes nodes nodes"],
    start: Float[Tensor, "nodes nodes nodes"],
    *,
    smoothness: float,
    steps: int,
) -> Float[Tensor, "nodes nodes nodes"]:
    """What minimises the energy above, on the nodes: `steps` of conjugate gradients from `start`.

    Values and targets share one unit; weights and smoothness count beside each other. The diagonal is the
    preconditioner.
    """
    if weight.device.type == "cpu" and weight.dtype == torch.float32:
        solution = bending.conjugate_gradients(
            floats(weight),
            smoothness,
            floats(weight * target),
            floats(start),
            steps=steps,
            threads=torch.get_num_threads(),
        )
        return torch.from_numpy(solution)
    return in_torch(target, weight, start, smoothness=smoothness, steps=steps)


def in_torch(
    target: Float[Tensor, "nodes nodes nodes"],
    weight: Float[Tensor, "nodes nodes nodes"],
    start: Float[Tensor, "nodes nodes nodes"],
    *,
    smoothness: float,
    steps: int,
) -> Float[Tensor, "nodes nodes nodes"]:
    """`fit_smooth` on any device and in any precision; the reference for what is compiled."""
    diagonal = weight + smoothness * bending.DIAGONAL

    def apply(f: Tensor) -> Tensor:
        return weight * f + smoothness * laplacian(laplacian(f))

    return conjugate_gradients(apply, diagonal, weight * target, start, steps=steps)
