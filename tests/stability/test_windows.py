"""Sums over windows of a picture, and planes fitted to what they hold."""

from collections.abc import Callable

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from backend.maths.correlation import window_sum
from backend.maths.inverse_depth import fit_planes
from tests.stability.sweep import Sweep, check, largest

RADII = (1, 3, 6)
Sum = Callable[[Tensor, int], Tensor]
"""From an image and a radius to the windows' sums."""
Fit = Callable[[Tensor, Tensor, int], Tensor]
"""From inverse depth, weight and radius to value and slopes."""


def running(values: Tensor, radius: int) -> Tensor:
    """Box filters as differences of running sums."""
    for axis in (-1, -2):
        ends = F.pad(values.transpose(axis, -1), (radius + 1, radius)).cumsum(dim=-1)
        values = (ends[..., 2 * radius + 1 :] - ends[..., : -2 * radius - 1]).transpose(axis, -1)
    return values


def sum_error(summed: Sum) -> float:
    """A picture of a million pixels from 0 to 1; in shares of the window's sum."""
    picture = torch.rand(1000, 1000, generator=torch.Generator().manual_seed(0))
    exact = (running(picture.double(), radius) for radius in RADII)
    return max(
        largest(summed(picture, radius), sums, sums) for radius, sums in zip(RADII, exact, strict=True)
    )


def moments_of_the_picture(inverse_depth: Tensor, weight: Tensor, radius: int) -> Tensor:
    """Least squares by running sums of u, v and their squares, counted from the picture's middle."""
    height, width = inverse_depth.shape
    v, u = torch.meshgrid(torch.arange(height) - height / 2, torch.arange(width) - width / 2, indexing="ij")
    terms = [torch.ones_like(u), u, v, inverse_depth, u * u, u * v, v * v, u * inverse_depth]
    sums = running(weight * torch.stack([*terms, v * inverse_depth]), radius)
    mean_u, mean_v, mean_w, uu, uv, vv, uw, vw = sums[1:] / sums[0]
    uu, uv, vv = uu - mean_u**2 + 1e-2, uv - mean_u * mean_v, vv - mean_v**2 + 1e-2
    uw, vw = uw - mean_u * mean_w, vw - mean_v * mean_w
    determinant = uu * vv - uv * uv
    slope_u, slope_v = (vv * uw - uv * vw) / determinant, (uu * vw - uv * uw) / determinant
    return torch.stack([mean_w + slope_u * (u - mean_u) + slope_v * (v - mean_v), slope_u, slope_v])


def slope_error(fit: Fit) -> float:
    """Slopes of 1e-4 a pixel on inverse depths of 0.3 to 30, weights from 0 to 1; in shares of 1e-4."""
    generator = torch.Generator().manual_seed(0)
    worst = 0.0
    for inverse_depth in (0.3, 3.0, 30.0):
        # what single precision makes of the map is part of the question, not of the error
        map_ = inverse_depth + 1e-4 * torch.arange(800.0).expand(400, -1)
        weight = torch.rand(400, 800, generator=generator)
        for radius in (3, 4):
            exact = fit_planes(map_.double(), weight.double(), radius)
            worst = max(worst, largest(fit(map_, weight, radius)[1:], exact[1:], 1e-4))
    return worst


SWEEPS = (
    Sweep(
        what="sums over windows of 3 to 13 pixels in a picture of a million, relative",
        usual_formula="differences of running sums",
        usual=lambda: sum_error(running),
        ours=lambda: sum_error(window_sum),
        tolerance=1e-6,
    ),
    Sweep(
        what="slopes of planes on maps from 0.3 to 30, in shares of a slope of 1e-4",
        usual_formula="running sums of coordinates and their squares",
        usual=lambda: slope_error(moments_of_the_picture),
        ours=lambda: slope_error(fit_planes),
        tolerance=1e-3,
    ),
)


@pytest.mark.parametrize("sweep", SWEEPS, ids=lambda sweep: sweep.what)
def test_sweep(sweep: Sweep) -> None:
    check(sweep)
