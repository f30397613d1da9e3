"""The smoothest function on a grid that agrees with measurements at its nodes.

Minimises  sum_i weight_i (f_i - target_i)^2 + smoothness * |Laplacian f|^2  over all nodes, which is
linear (Calakli and Taubin, "SSD: smooth signed distance surface reconstruction", 2011, in its
simplest discrete form): solved by conjugate gradients, to start from a coarser grid's solution.
"""

from jaxtyping import Float
from torch import Tensor

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
    """`steps` of conjugate gradients with the diagonal as preconditioner, from `start`."""
    diagonal = weight + smoothness * 42.0  # 6^2 + 6: the biharmonic stencil's middle

    def apply(f: Tensor) -> Tensor:
        return weight * f + smoothness * laplacian(laplacian(f))

    return conjugate_gradients(apply, diagonal, weight * target, start, steps=steps)
