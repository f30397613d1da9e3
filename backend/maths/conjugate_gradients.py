"""Linear systems on a grid, solved without their matrix."""

from collections.abc import Callable

from jaxtyping import Float
from torch import Tensor


def conjugate_gradients(
    apply: Callable[[Tensor], Tensor],
    diagonal: Float[Tensor, "nodes nodes nodes"],
    right: Float[Tensor, "nodes nodes nodes"],
    start: Float[Tensor, "nodes nodes nodes"],
    *,
    steps: int,
) -> Float[Tensor, "nodes nodes nodes"]:
    """`steps` towards apply(f) = right, from `start`, which is kept; the diagonal is the preconditioner.

    `apply` is linear, symmetric and positive definite (Hestenes and Stiefel, 1952).
    """
    solution = start.clone()
    residual = right - apply(solution)
    direction = residual / diagonal
    energy = (residual * direction).sum()
    for _ in range(steps):
        image = apply(direction)
        step = energy / (direction * image).sum().clamp(min=1e-30)
        solution += step * direction
        residual -= step * image
        conditioned = residual / diagonal
        before, energy = energy, (residual * conditioned).sum()
        direction = conditioned + (energy / before.clamp(min=1e-30)) * direction
    return solution
