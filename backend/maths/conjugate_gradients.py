"""Linear systems on a grid, solved without their matrix."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from .repeated import State, repeated


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

    def step(state: State) -> State:
        solution, residual, direction, energy = state
        image = apply(direction)
        length = energy / _product(direction, image).clamp(min=1e-30)
        residual = torch.addcmul(residual, length, image, value=-1)
        conditioned = residual / diagonal
        left = _product(residual, conditioned)
        turned = conditioned.addcmul_(left / energy.clamp(min=1e-30), direction)
        return torch.addcmul(solution, length, direction), residual, turned, left

    residual = right - apply(start)
    direction = residual / diagonal
    return repeated(step, (start, residual, direction, _product(residual, direction)), steps)[0]


def _product(
    a: Float[Tensor, "nodes nodes nodes"], b: Float[Tensor, "nodes nodes nodes"]
) -> Float[Tensor, ""]:
    """Of two fields as vectors, without a third to hold the terms."""
    return torch.dot(a.flatten(), b.flatten())
