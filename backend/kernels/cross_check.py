"""Two depth maps held against each other in one pass, compiled for the CPU.

The same as `backend.stages.stereo.cross_check.in_torch`, which is the reference and what a GPU runs.
"""

import numpy as np
from numpy.typing import NDArray

from .compiled import HALF, ONE, ZERO, Floats, compiled
from .patch_correlation import find, interpolate, warp

Flags = NDArray[np.bool_]


@compiled
def cross_check(
    rows: tuple[int, int],
    inverse_depth: Floats,
    there: tuple[Floats, Floats],
    back: tuple[Floats, Floats],
    other_inverse_depth: Floats,
    other_score: Floats,
    least_score: np.float32,
    limits: tuple[np.float32, np.float32],
    agrees: Flags,
    denies: Flags,
) -> None:
    """Of some rows of a map, (height, width) as `agrees` and `denies`, which are written.

    there, back: (3, 3) and (3), `backend.maths.geometry.epipolar_map` to the other view and from it. The
    other's map is (its height, its width), at least 2 pixels each way. limits: pixels, share of the depth.
    """
    width = inverse_depth.shape[1]
    other_height, other_width = other_inverse_depth.shape
    flat_depth, flat_score = other_inverse_depth.ravel(), other_score.ravel()
    index = np.empty(width, np.int32)
    x = np.empty(width, np.float32)
    y, to_right, down, seen = np.empty_like(x), np.empty_like(x), np.empty_like(x), np.empty_like(x)
    found, score = np.empty_like(x), np.empty_like(x)
    for row in range(rows[0], rows[1]):
        warp(row, 0, there[0], there[1], inverse_depth[row], x, y)
        find(x, y, other_width, other_height, index, to_right, down, seen)
        interpolate(flat_depth, other_width, index, to_right, down, found)
        interpolate(flat_score, other_width, index, to_right, down, score)
        hold(row, inverse_depth[row], back, x, y, found, limits, agrees[row])
        for u in range(width):
            told = (seen[u] > ZERO) & (score[u] > least_score)
            denies[row, u] = told & (not agrees[row, u])
            agrees[row, u] = told & agrees[row, u]


@compiled
def hold(
    row: int,
    inverse_depth: Floats,
    back: tuple[Floats, Floats],
    x: Floats,
    y: Floats,
    found: Floats,
    limits: tuple[np.float32, np.float32],
    agrees: Flags,
) -> None:
    """Whether what the other view has found at (x, y) is seen from here at the pixel and depth asked for."""
    a, b = back
    v = np.float32(row) + HALF
    largest_squared, largest_share = limits[0] * limits[0], limits[1]
    for u in range(len(x)):
        away = max(found[u], np.float32(1e-6))
        at_x = a[0, 0] * x[u] + a[0, 1] * y[u] + a[0, 2] + away * b[0]
        at_y = a[1, 0] * x[u] + a[1, 1] * y[u] + a[1, 2] + away * b[1]
        at_z = a[2, 0] * x[u] + a[2, 1] * y[u] + a[2, 2] + away * b[2]
        scale = ONE / (at_z if at_z > ZERO else ONE)
        right = at_x * scale - (np.float32(np.int32(u)) + HALF)
        below = at_y * scale - v
        share = abs(at_z / away * max(inverse_depth[u], np.float32(1e-6)) - ONE)
        agrees[u] = (right * right + below * below < largest_squared) & (share < largest_share)


def error_of_a_map_with_itself() -> float:
    """The share of a map's pixels that do not agree with themselves."""
    depth = np.linspace(0.5, 1.5, 12 * 16, dtype=np.float32).reshape(12, 16)
    stays = (np.eye(3, dtype=np.float32), np.zeros(3, np.float32))
    agrees, denies = np.empty(depth.shape, np.bool_), np.empty(depth.shape, np.bool_)
    limits = (ONE, np.float32(0.01))
    cross_check((0, 12), depth, stays, stays, depth, np.ones_like(depth), ZERO, limits, agrees, denies)
    return float(1 - (agrees & ~denies).mean())
