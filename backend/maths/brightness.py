"""Where a surface should be so that two photographs show the same colour: a first-order step along rays.

A matt surface is as bright from every side, also where it shows no texture that patches could be compared by.
Its shading changes from place to place; so along the ray of one photograph the brightness that another one
shows changes as well, and the depth at which both agree solves one linear equation (Lucas and Kanade, "An
Iterative Image Registration Technique", IJCAI 1981, with depth as the one unknown).

What shines is not as bright from every side, and its highlights, mirrored by a convex surface, look as if
they lay behind it. But a highlight has the colour of the light: it changes brightness and hardly the
differences between red, green and blue (as in Mallick et al., "Beyond Lambert", CVPR 2005). So brightness and
differences are channels of their own, each in units of its own noise.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from .correlation import window_sum, without_local_mean

_SIGMA_OF_MEDIAN_DEVIATION = 1.4826
"""A normal law's standard deviation, beside the median of what is off its middle."""
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
    """To where channels agree, by all pixels of a small window."""

    step: Float[Tensor, "height width"]
    """Along the ray, > 0 away from the camera; not finite where nothing in the window changes."""
    slope: Float[Tensor, "height width"]
    """Along the ray: the root of the channels' sum of mean squares over the window."""
    left_over: Float[Tensor, "height width"]
    """Difference that the step does not explain, root mean square over the window; each channel counts by its
    share in the squared slope."""


def channels_of(linear: Float[Tensor, "3 *places"]) -> Float[Tensor, "3 *places"]:
    """Brightness, and how much more red and green there is, in linear light, than what would be grey."""
    red, green, blue = linear
    return torch.stack([linear.mean(dim=0), red - blue, green - (red + blue) / 2])


def slopes_along(
    nearer: Float[Tensor, "..."], here: Float[Tensor, "..."], farther: Float[Tensor, "..."], reach: float
) -> Slopes:
    """Of brightness `reach` before a place, at it, and `reach` behind it."""
    change, bend = farther - nearer, farther + nearer - 2 * here
    return Slopes(slope=change / (2 * reach), straight=bend.abs() < STRAIGHT * change.abs())


def depth_steps(
    difference: Float[Tensor, "channels height width"],
    slope: Float[Tensor, "channels height width"],
    where: Bool[Tensor, "channels height width"],
    radius_px: int,
) -> DepthSteps:
    """The steps s with the least sum of (difference - slope s)^2 over each window, `where` both are known.

    `difference` is what the photograph that the rays are of shows, less what another shows of the same
    places; it and the slope are in units of the channel's noise.
    """
    count = window_sum(where.to(slope.dtype), radius_px).clamp(min=1)

    def mean(values: Float[Tensor, "channels height width"]) -> Float[Tensor, "channels height width"]:
        return window_sum(torch.where(where, values, 0.0), radius_px) / count

    squares, products = mean(slope.square()), mean(slope * difference)
    step = products.sum(dim=0) / squares.sum(dim=0)
    off = mean(difference.square()) - 2 * step * products + step.square() * squares
    left_over = (squares * off.clamp(min=0)).sum(dim=0) / squares.sum(dim=0)
    return DepthSteps(step=step, slope=squares.sum(dim=0).sqrt(), left_over=left_over.sqrt())


def exposure_ratio(
    here: Float[Tensor, "channels boxes"], there: Float[Tensor, "channels boxes"]
) -> Float[Tensor, "channels"]:
    """How many times more `there` is than `here`: the r with the least sum of |there - r here|, by channels.

    That is the median of the boxes' ratios, in which each weighs as much as there is `here`. All are 1 where
    that of the first channel differs from 1 by no more than chance: three standard errors of a median, by
    the ratios' median deviation from it.
    """
    weight = here.abs()
    ratios = torch.where(weight > 0, there / here, 0.0)
    ordered, order = ratios.sort(dim=-1)
    weights_up_to = weight.gather(-1, order).cumsum(dim=-1)
    middle = (weights_up_to < weights_up_to[:, -1:] / 2).sum(dim=-1)
    ratio = ordered.gather(-1, middle[:, None])[:, 0]
    spread = median_deviation(ratios[0] - ratio[0])
    error = math.sqrt(math.pi / 2 / here.shape[1]) * spread
    return torch.where((ratio[0] - 1).abs() > 3 * error, ratio, 1.0)


def median_deviation(off: Float[Tensor, "*channels values"]) -> Float[Tensor, "*channels"]:
    """Of values that are `off` their middle; the worst of them have no part in it."""
    return _SIGMA_OF_MEDIAN_DEVIATION * off.abs().median(dim=-1).values


def grain(
    difference: Float[Tensor, "channels height width"],
    where: Bool[Tensor, "height width"],
    radius_px: int,
) -> Float[Tensor, "channels"]:
    """Standard deviation of what goes from pixel to pixel: off the windows' means, `where` it is known.

    What is off in a few places, as along an edge, has no part in it. There must be one that is known.
    """
    known = where.to(difference.dtype)
    rough = torch.stack([without_local_mean(channel, known, radius_px) for channel in difference])
    return median_deviation(rough[:, where])


def means_of_cells(
    values: Float[Tensor, "channels places"], cell: Int64[Tensor, "places"], fewest: int
) -> Float[Tensor, "channels cells"]:
    """Over the places of each cell (numbered from 0) that holds at least so many."""
    count = torch.bincount(cell)
    sums = values.new_zeros((len(values), len(count))).index_add_(1, cell, values)
    return (sums / count.clamp(min=1))[:, count >= fewest]
