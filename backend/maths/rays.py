"""Searching rays for the surface of a distance field."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

_TOGETHER = 8
"""Steps of all rays before those that are done are left out."""
DistanceFunction = Callable[[Float[Tensor, "points 3"]], Float[Tensor, "points"]]


@dataclass(frozen=True, kw_only=True)
class Crossing:
    """Where rays meet the surface, or come nearest to it."""

    along: Float[Tensor, "rays"]
    """Distance from the origin."""
    hit: Bool[Tensor, "rays"]


def points_along(
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    along: Float[Tensor, "rays samples"],
) -> Float[Tensor, "rays samples 3"]:
    """o + t d for every ray at each of its own t."""
    return origins[:, None] + along[..., None] * directions[:, None]


def sphere_entry(
    origins: Float[Tensor, "rays 3"], directions: Float[Tensor, "rays 3"]
) -> Float[Tensor, "rays"]:
    """Where rays enter the unit sphere; 0 if they start inside; the nearest point if they miss it."""
    return sphere_span(origins, directions)[0]


def sphere_span(
    origins: Float[Tensor, "rays 3"], directions: Float[Tensor, "rays 3"]
) -> tuple[Float[Tensor, "rays"], Float[Tensor, "rays"]]:
    """Where rays enter and leave the unit sphere, as `sphere_entry`; the same place twice if they miss it."""
    middle = -(origins * directions).sum(dim=-1)
    half_squared = 1 - (origins + middle[:, None] * directions).square().sum(dim=-1)
    half = half_squared.clamp(min=0).sqrt()
    return (middle - half).clamp(min=0), (middle + half).clamp(min=0)


def first_crossing(
    distance: DistanceFunction,
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    start: Float[Tensor, "rays"],
    *,
    reach: float = 2.0,
    shortest: float = 0.005,
    longest: float = 0.1,
    steps: int = 40,
) -> Crossing:
    """Sphere tracing from `start`, `shortest` to `longest` a step; the crossing by the secant.

    Far from the surface a fitted field may grow faster than the distance, and whole steps would leap over it.

    A ray that never meets the surface gets the place where it came nearest, so that the silhouette
    can be moved towards or away from it. Rays end `reach` after their start.
    """
    place, hit = start.clone(), torch.zeros_like(start, dtype=torch.bool)
    number, end, infinite = torch.arange(len(start), device=start.device), start + reach, start + torch.inf
    going, state = [origins, directions, end], [start, start, infinite, infinite, place, hit]
    for first in range(0, steps, _TOGETHER):
        for _ in range(first, min(first + _TOGETHER, steps)):
            state = _traced(distance, shortest, longest, *going, *state)
        _, last, _, _, at, met = state
        place[number], hit[number] = at, met
        left = ~met & (last < going[2])
        number, going, state = number[left], [x[left] for x in going], [x[left] for x in state]
    return Crossing(along=place, hit=hit)


def _traced(
    distance: DistanceFunction,
    shortest: float,
    longest: float,
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    end: Float[Tensor, "rays"],
    along: Float[Tensor, "rays"],
    last: Float[Tensor, "rays"],
    before: Float[Tensor, "rays"],
    nearest: Float[Tensor, "rays"],
    at: Float[Tensor, "rays"],
    met: Bool[Tensor, "rays"],
) -> list[Tensor]:
    """One step of rays that are at `along`: the same of what changes, from `along` to `met`.

    `last` is the place before, `before` the distance there, `at` where a ray met the surface or was nearest.
    """
    here = distance(origins + along[:, None] * directions)
    closer = (here < nearest) & ~met
    nearest, at = torch.where(closer, here, nearest), torch.where(closer, along, at)
    new = (here <= 0) & ~met
    share = torch.where(before.isfinite(), before / (before - here).clamp(min=1e-9), 1.0)
    at = torch.where(new, last + share * (along - last), at)
    further = (along + (0.95 * here).clamp(shortest, longest)).minimum(end)
    return [further, along, here, nearest, at, met | new]
