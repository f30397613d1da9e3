"""Looking along rays through a function on a grid, ray by ray, compiled for the CPU.

The same as `first_crossing` and `lowest_along` of `backend.maths.rays` with `backend.maths.grid.read`, which
are the reference and what a GPU runs.
"""

import numpy as np
from numpy.typing import NDArray

from .compiled import HALF, ONE, ZERO, Floats, compiled

Flags = NDArray[np.bool_]

CAUTION = np.float32(0.95)
"""Share of the distance that a step goes."""
TINY = np.float32(1e-9)
"""Least difference of two distances that the crossing between them is found by."""


@compiled
def read(grid: Floats, x: np.float32, y: np.float32, z: np.float32) -> np.float32:
    """Trilinear value at a place of the cube [-1, 1]^3; from outside, at its side."""
    i, u = cell(x, grid.shape[0])
    j, v = cell(y, grid.shape[1])
    k, w = cell(z, grid.shape[2])
    near = (ONE - v) * between(grid, i, j, k, w) + v * between(grid, i, j + 1, k, w)
    far = (ONE - v) * between(grid, i + 1, j, k, w) + v * between(grid, i + 1, j + 1, k, w)
    return (ONE - u) * near + u * far


@compiled
def cell(x: np.float32, nodes: int) -> tuple[int, np.float32]:
    """The node below, and how far beyond it; what is not a number is at the first."""
    scaled = min((x + ONE) * (HALF * np.float32(nodes - 1)), np.float32(nodes - 1))
    if not scaled > ZERO:
        return 0, ZERO
    low = min(int(scaled), nodes - 2)
    return low, scaled - np.float32(low)


@compiled
def between(grid: Floats, i: int, j: int, k: int, w: np.float32) -> np.float32:
    """On the edge from node k to the next."""
    return np.float32((ONE - w) * grid[i, j, k] + w * grid[i, j, k + 1])


@compiled
def first_crossings(
    rows: tuple[int, int],
    grid: Floats,
    origins: Floats,
    directions: Floats,
    start: Floats,
    limits: tuple[float, float, float, int],
    along: Floats,
    hit: Flags,
) -> None:
    """Of some of the rays, `along` and `hit` written; (reach, shortest, longest, steps) are as there."""
    reach, shortest, longest = np.float32(limits[0]), np.float32(limits[1]), np.float32(limits[2])
    for ray in range(rows[0], rows[1]):
        a, b, c = origins[ray, 0], origins[ray, 1], origins[ray, 2]
        d, e, f = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        end = start[ray] + reach
        last = at = place = start[ray]
        before = nearest = np.float32(np.inf)
        met = False
        for _ in range(limits[3]):
            here = read(grid, a + at * d, b + at * e, c + at * f)
            if here <= ZERO:
                share = before / max(before - here, TINY) if before < np.inf else ONE
                place, met = last + share * (at - last), True
                break
            if here < nearest:
                nearest, place = here, at
            if not at < end:
                break
            before, last = here, at
            at = min(at + min(max(CAUTION * here, shortest), longest), end)
        along[ray], hit[ray] = place, met


@compiled
def lowest(
    rows: tuple[int, int],
    grid: Floats,
    origins: Floats,
    directions: Floats,
    middle: Floats,
    steps: Floats,
    along: Floats,
    least: Floats,
) -> None:
    """Of some of the rays, `along` and `least` written."""
    for ray in range(rows[0], rows[1]):
        a, b, c = origins[ray, 0], origins[ray, 1], origins[ray, 2]
        d, e, f = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        place, nearest = ZERO, np.float32(np.inf)
        for step in steps:
            at = max(middle[ray] + step, ZERO)
            x, y, z = a + at * d, b + at * e, c + at * f
            if abs(x) < ONE and abs(y) < ONE and abs(z) < ONE:
                here = read(grid, x, y, z)
                if here < nearest:
                    nearest, place = here, at
        along[ray], least[ray] = place, nearest


def error_of_a_plane_ahead() -> float:
    """How far from 1.5 a ray meets the plane x = 0.25 from x = -1.25."""
    nodes = 9
    grid = np.zeros((nodes, nodes, nodes), np.float32)
    grid += np.linspace(1.25, -0.75, nodes, dtype=np.float32)[:, None, None]
    ray = np.array([[-1.25, 0.1, 0.2], [1, 0, 0]], np.float32)
    along, hit = np.zeros(1, np.float32), np.zeros(1, np.bool_)
    limits = (3.0, 0.05, 0.5, 40)
    first_crossings((0, 1), grid, ray[:1], ray[1:], np.zeros(1, np.float32), limits, along, hit)
    return abs(float(along[0]) - 1.5) if hit[0] else np.inf
