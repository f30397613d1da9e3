"""Linear systems on a grid, solved without their matrix."""

from collections.abc import Callable

import torch
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
    energy = _product(residual, direction)
    for _ in range(steps):
        image = apply(direction)
        step = energy / _product(direction, image).clamp(min=1e-30)
        solution.addcmul_(step, direction)
        residual.addcmul_(step, image, value=-1)
        conditioned = residual / diagonal
        before, energy = energy, _product(residual, conditioned)
        direction = conditioned.addcmul_(energy / before.clamp(min=1e-30), direction)
    return solution


def _product(
    a: Float[Tensor, "nodes nodes nodes"], b: Float[Tensor, "nodes nodes nodes"]
) -> Float[Tensor, ""]:
    """Of two fields as vectors, without a third to hold the terms."""
    return torch.dot(a.flatten(), b.flatten())
