"""Planes fitted around every pixel in one pass over memory, compiled for the CPU.

The same as `backend.maths.inverse_depth.in_torch`, which is the reference and what a GPU runs.
"""

import numpy as np

from .compiled import ONE, ZERO, Floats, compiled

PRIOR = np.float32(1e-2)


@compiled
def fit_planes(
    rows: tuple[int, int], weight: Floats, beyond: Floats, usual: np.float32, radius: int, planes: Floats
) -> None:
    """Planes of some rows, (3, height, width), written.

    weight, beyond: (height + 2 radius, width + 2 radius), the weights and the weighted values less `usual`,
    with zeros around them.
    """
    width = planes.shape[2]
    columns = np.empty((5, width + 2 * radius), np.float32)
    sums = np.empty((9, width), np.float32)
    for row in range(rows[0], rows[1]):
        add_rows(weight[row : row + 2 * radius + 1], beyond[row : row + 2 * radius + 1], columns)
        add_columns(columns, radius, sums)
        solve(sums, usual, planes[:, row])


@compiled
def add_rows(weight: Floats, beyond: Floats, columns: Floats) -> None:
    """Moments of each column: w, v w, v^2 w of the weights, and of the values the first two."""
    columns[:] = ZERO
    radius = len(weight) // 2
    for k in range(len(weight)):
        v = np.float32(k - radius)
        for x in range(columns.shape[1]):
            w, value = weight[k, x], beyond[k, x]
            columns[0, x] += w
            columns[1, x] += v * w
            columns[2, x] += v * v * w
            columns[3, x] += value
            columns[4, x] += v * value


@compiled
def add_columns(columns: Floats, radius: int, sums: Floats) -> None:
    """Moments of each window: w, u w, v w, u^2 w, u v w, v^2 w, and of the values the first three."""
    sums[:] = ZERO
    for k in range(2 * radius + 1):
        u = np.float32(k - radius)
        for x in range(sums.shape[1]):
            w, vw, vvw, value, v_value = (
                columns[0, x + k],
                columns[1, x + k],
                columns[2, x + k],
                columns[3, x + k],
                columns[4, x + k],
            )
            sums[0, x] += w
            sums[1, x] += u * w
            sums[2, x] += vw
            sums[3, x] += u * u * w
            sums[4, x] += u * vw
            sums[5, x] += vvw
            sums[6, x] += value
            sums[7, x] += u * value
            sums[8, x] += v_value


@compiled
def solve(sums: Floats, usual: np.float32, planes: Floats) -> None:
    """Value and slopes of a row, (3, width), from its windows' moments."""
    for x in range(sums.shape[1]):
        share = ONE / max(sums[0, x], np.float32(1e-9))
        u, v, w = sums[1, x] * share, sums[2, x] * share, sums[6, x] * share
        uu = sums[3, x] * share - u * u + PRIOR
        uv = sums[4, x] * share - u * v
        vv = sums[5, x] * share - v * v + PRIOR
        uw, vw = sums[7, x] * share - u * w, sums[8, x] * share - v * w
        over = ONE / (uu * vv - uv * uv)
        slope_u, slope_v = (vv * uw - uv * vw) * over, (uu * vw - uv * uw) * over
        planes[0, x] = usual + w - slope_u * u - slope_v * v
        planes[1, x] = slope_u
        planes[2, x] = slope_v


def error_of_a_plane() -> float:
    """How far from a slope of 1, less what the prior takes, the plane through such values is, at most."""
    radius, height, width = 3, 8, 16
    weight = np.zeros((height + 2 * radius, width + 2 * radius), np.float32)
    weight[radius:-radius, radius:-radius] = ONE
    values = (weight * np.arange(width + 2 * radius)).astype(np.float32)
    planes = np.empty((3, height, width), np.float32)
    fit_planes((0, height), weight, values, ZERO, radius, planes)
    variance = radius * (radius + 1) / 3
    expected = variance / (variance + float(PRIOR))
    return float(np.abs(planes[1, radius:-radius, radius:-radius] - expected).max())
