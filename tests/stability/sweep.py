"""Sweeps over hard cases, and how their largest errors are told: tests and docs/stability.md share them."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

Errors = dict[str, float]
"""The largest error of each case."""


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """The same cases by the usual formula and by ours, both in float32, as largest errors.

    An error that is not a number, or infinite, is infinite. Errors are one number, or one of each case.
    """

    what: str
    """What is computed, over which cases, and how the error is told."""
    usual_formula: str
    usual: Callable[[], float | Errors]
    ours: Callable[[], float | Errors]
    tolerance: float
    """Ours is below it in every case, the usual formula is not."""
    usual_holds: tuple[str, ...] = ()
    """Named cases in which the usual formula is as good."""


def check(sweep: Sweep) -> None:
    """Fails unless in each case our formula is within the tolerance and the usual one is not.

    In the cases where the usual one is said to hold, it has to.
    """
    ours, usual = by_case(sweep.ours()), by_case(sweep.usual())
    assert ours.keys() == usual.keys()
    assert set(sweep.usual_holds) <= usual.keys()
    for case in ours:
        assert ours[case] <= sweep.tolerance, f"{case}: {ours[case]:.2g}, more than {sweep.tolerance:.2g}"
        holds = usual[case] <= sweep.tolerance
        assert holds == (case in sweep.usual_holds), f"{case}: the usual formula is off by {usual[case]:.2g}"


def by_case(errors: float | Errors) -> Errors:
    """The errors of the cases; a single number is that of all of them."""
    return errors if isinstance(errors, dict) else {"all cases": errors}


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
