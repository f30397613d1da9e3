"""Searching rays for the surface of a distance field."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

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
    along = start.clone()
    before_along, before = along, torch.full_like(along, torch.inf)
    nearest, nearest_along = torch.full_like(along, torch.inf), along.clone()
    crossing, hit = along.clone(), torch.zeros_like(along, dtype=torch.bool)
    for _ in range(steps):
        here = distance(origins + along[:, None] * directions)
        closer = (here < nearest) & ~hit
        nearest, nearest_along = torch.where(closer, here, nearest), torch.where(closer, along, nearest_along)
        new = (here <= 0) & ~hit
        share = torch.where(before.isfinite(), before / (before - here).clamp(min=1e-9), 1.0)
        crossing = torch.where(new, before_along + share * (along - before_along), crossing)
        hit = hit | new
        before_along, before = along, here
        along = (along + (0.95 * here).clamp(shortest, longest)).minimum(start + reach)
    return Crossing(along=torch.where(hit, crossing, nearest_along), hit=hit)
