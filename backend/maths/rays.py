"""Searching rays for the surface of a distance field."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..kernels import ray_crossing
from ..kernels.compiled import floats
from ..kernels.side_by_side import bands_side_by_side
from .grid import read
from .repeated import State, repeated

_TRACED_IN_ONE_GO, _SEARCHED_IN_ONE_GO = 4096, 512
"""Rays of a thread, where compiled."""
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
    """o + t d for every ray at each of its own t, in lengths of d; in the frame of the origins."""
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
    distance: DistanceFunction | Float[Tensor, "nodes nodes nodes"],
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

    Directions are unit vectors; all lengths are in the unit of the origins, as the distance is.

    Far from the surface a fitted field may grow faster than the distance, and whole steps would leap over it.

    A ray that never meets the surface gets the place where it came nearest, so that the silhouette
    can be moved towards or away from it. Rays end `reach` after their start.

    A grid is trilinear on the cube [-1, 1]^3 and goes on as it is at its sides. On the CPU and in single
    precision it is compiled (`kernels/ray_crossing.py`); what it is as a function of `grid.read` is the
    reference, and what a GPU runs.
    """
    if isinstance(distance, Tensor):
        grid = distance
        if grid.device.type == "cpu" and grid.dtype == torch.float32:
            return _compiled_crossing(grid, origins, directions, start, (reach, shortest, longest, steps))
        distance = partial(read, grid)
    nowhere, unmet = torch.full_like(start, torch.inf), torch.zeros_like(start, dtype=torch.bool)
    step = partial(_traced, distance, origins, directions, start + reach, (shortest, longest))
    at, met = repeated(step, (start, unmet, start, start, nowhere, nowhere), steps)[:2]
    return Crossing(along=at, hit=met)


def lowest_along(
    grid: Float[Tensor, "nodes nodes nodes"],
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    middle: Float[Tensor, "rays"],
    steps: Float[Tensor, "steps"],
) -> tuple[Float[Tensor, "rays"], Float[Tensor, "rays"]]:
    """Where along each ray, `middle + steps` from its origin, the grid's function is lowest; and how low.

    Inside the cube alone: infinite for rays that miss it. Nothing behind an origin is looked at. Compiled on
    the CPU in single precision, as `first_crossing` is.
    """
    if grid.device.type == "cpu" and grid.dtype == torch.float32:
        along, least = np.empty(len(middle), np.float32), np.empty(len(middle), np.float32)
        given = (floats(grid), floats(origins), floats(directions), floats(middle), floats(steps))

        def look(rows: tuple[int, int]) -> None:
            ray_crossing.lowest(rows, *given, along, least)

        bands_side_by_side(look, len(middle), torch.get_num_threads(), band=_SEARCHED_IN_ONE_GO)
        return torch.from_numpy(along), torch.from_numpy(least)
    return lowest_in_torch(grid, origins, directions, middle, steps)


def lowest_in_torch(
    grid: Float[Tensor, "nodes nodes nodes"],
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    middle: Float[Tensor, "rays"],
    steps: Float[Tensor, "steps"],
) -> tuple[Float[Tensor, "rays"], Float[Tensor, "rays"]]:
    """`lowest_along` on any device; the reference for what is compiled."""
    along = (middle[:, None] + steps).clamp(min=0)
    points = points_along(origins, directions, along)
    values = read(grid, points.reshape(-1, 3)).reshape(along.shape)
    values = torch.where(points.abs().amax(dim=-1) < 1, values, torch.inf)
    least, index = values.min(dim=1)
    return torch.where(least.isinf(), 0.0, along.gather(1, index[:, None])[:, 0]), least


def _compiled_crossing(
    grid: Float[Tensor, "nodes nodes nodes"],
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    start: Float[Tensor, "rays"],
    limits: tuple[float, float, float, int],
) -> Crossing:
    along, hit = np.empty(len(start), np.float32), np.empty(len(start), np.bool_)
    field, rays = floats(grid), (floats(origins), floats(directions), floats(start))

    def trace(rows: tuple[int, int]) -> None:
        ray_crossing.first_crossings(rows, field, *rays, limits, along, hit)

    bands_side_by_side(trace, len(along), torch.get_num_threads(), band=_TRACED_IN_ONE_GO)
    return Crossing(along=torch.from_numpy(along), hit=torch.from_numpy(hit))


def _traced(
    distance: DistanceFunction,
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    end: Float[Tensor, "rays"],
    lengths: tuple[float, float],
    state: State,
) -> State:
    """Rays after one step. Of each, in lengths along it and values of the field:

    where it met the surface, or was nearest to it; whether it met it; where it looks next; where it looked
    before, and the field there; the least of that so far.
    """
    at, met, along, last, before, nearest = state
    here = distance(origins + along[:, None] * directions)
    closer = (here < nearest) & ~met
    new = (here <= 0) & ~met
    share = torch.where(before.isfinite(), before / (before - here).clamp(min=float(ray_crossing.TINY)), 1.0)
    at = torch.where(closer, along, at)
    return (
        torch.where(new, last + share * (along - last), at),
        met | new,
        (along + (float(ray_crossing.CAUTION) * here).clamp(*lengths)).minimum(end),
        along,
        here,
        torch.where(closer, here, nearest),
    )
