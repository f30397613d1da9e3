"""Where a surface should be so that two photographs are equally bright: a first-order step along rays.

A matt surface is as bright from every side, also where it shows no texture that patches could be compared by.
Its shading changes from place to place; so along the ray of one photograph the brightness that another one
shows changes as well, and the depth at which both agree solves one linear equation (Lucas and Kanade, "An
Iterative Image Registration Technique", IJCAI 1981, with depth as the one unknown).
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int64
from torch import Tensor

STRAIGHT = 0.3
"""Largest difference between the slope on one side and on both, beside the latter: texture finer than the way
looked at agrees in many places, shading in one."""


@dataclass(frozen=True, kw_only=True)
class Slopes:
    """Of the brightness that another photograph shows along the rays of one."""

    slope: Float[Tensor, "..."]
    """Per unit along the ray."""
    straight: Bool[Tensor, "..."]
    """Whether it is about the same on both sides, and not 0."""


@dataclass(frozen=True, kw_only=True)
class DepthSteps:
    """To where brightness agrees, by all pixels of a small window."""

    step: Float[Tensor, "height width"]
    """Along the ray, > 0 away from the camera; not finite where nothing in the window changes."""
    slope: Float[Tensor, "height width"]
    """Of brightness along the ray, root mean square over the window."""
    left_over: Float[Tensor, "height width"]
    """Difference of brightness that the step does not explain, root mean square over the window."""


def slopes_along(
    nearer: Float[Tensor, "..."], here: Float[Tensor, "..."], farther: Float[Tensor, "..."], reach: float
) -> Slopes:
    """Of brightness `reach` before a place, at it, and `reach` behind it."""
    change, bend = farther - nearer, farther + nearer - 2 * here
    return Slopes(slope=change / (2 * reach), straight=bend.abs() < STRAIGHT * change.abs())


def depth_steps(
    difference: Float[Tensor, "height width"],
    slope: Float[Tensor, "height width"],
    where: Bool[Tensor, "height width"],
    radius_px: int,
) -> DepthSteps:
    """The steps s with the least sum of (difference - slope s)^2 over each window, `where` both are known.

    `difference` is the brightness in the photograph that the rays are of, less what another shows of the
    same places.
    """
    side = 2 * radius_px + 1

    def mean(values: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
        known = torch.where(where, values, 0.0)
        return F.avg_pool2d(known[None, None], side, stride=1, padding=radius_px)[0, 0]

    share = mean(torch.ones_like(difference))
    squares = mean(slope.square())
    step = mean(slope * difference) / squares
    left_over = (mean(difference.square()) - step.square() * squares).clamp(min=0)
    return DepthSteps(step=step, slope=(squares / share).sqrt(), left_over=(left_over / share).sqrt())


def exposure_ratio(here: Float[Tensor, "places"], there: Float[Tensor, "places"]) -> Float[Tensor, ""]:
    """How many times brighter `there` is than `here`: the median of the places' ratios."""
    return (there / here.clamp(min=torch.finfo(here.dtype).tiny)).median()


def means_of_cells(
    values: Float[Tensor, "places"], cell: Int64[Tensor, "places"], fewest: int
) -> Float[Tensor, "cells"]:
    """Over the places of each cell (numbered from 0) that holds at least so many."""
    count = torch.bincount(cell)
    sums = torch.zeros_like(count, dtype=values.dtype).index_add_(0, cell, values)
    return (sums / count.clamp(min=1))[count >= fewest]
