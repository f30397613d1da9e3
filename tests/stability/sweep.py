"""Sweeps over hard cases, and how their largest errors are told: tests and docs/stability.md share them."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """The same cases by the usual formula and by ours, both in float32, as largest errors.

    An error that is not a number, or infinite, is infinite.
    """

    what: str
    """What is computed, over which cases, and how the error is told."""
    usual_formula: str
    usual: Callable[[], float]
    ours: Callable[[], float]
    tolerance: float
    """Ours is below it, the usual formula is not."""


def check(sweep: Sweep) -> None:
    """Fails unless our formula is within the tolerance and the usual one is not."""
    ours, usual = sweep.ours(), sweep.usual()
    assert ours <= sweep.tolerance, f"ours: {ours:.2g}, more than {sweep.tolerance:.2g}"
    assert usual > sweep.tolerance, f"the usual formula is as good: {usual:.2g}"


def largest(found: Tensor, exact: Tensor, relative_to: Tensor | float = 1.0) -> float:
    """Largest difference, as a multiple of `relative_to`; infinite where something is not finite."""
    if not bool(found.isfinite().all()):
        return math.inf
    return float(((found.double() - exact.double()).abs() / relative_to).max())


def gradient(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """Of a sum of the function's values, at a place."""
    place = at.detach().clone().requires_grad_()
    (found,) = torch.autograd.grad(function(place).sum(), place)
    return found
