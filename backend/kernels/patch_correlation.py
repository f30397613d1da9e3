"""Warp, interpolation, window sums and correlation of patches in one pass over memory, compiled for the CPU.

The same as `backend.stages.stereo.patch_agreement.in_torch`, which is the reference and what a GPU runs.
There each step reads and writes all of its numbers, some forty times over; here a row stays in the
processor's first cache from warp to score. Rows are worked on by loops without branches, which the compiler
turns into vector instructions. Calls release Python's lock: tiles of an image can be worked on side by side.
"""

import numpy as np

from .compiled import HALF, ONE, ZERO, Doubles, Floats, Ints, compiled


@compiled
def correlate(
    tile: tuple[int, int, int, int],
    radius: int,
    patches: tuple[Floats, Floats, Floats, Floats, Floats],
    source: Floats,
    epipolar: tuple[Floats, Floats],
    floor: np.float32,
    inverse_depth: Floats,
    scores: Floats,
) -> None:
    """Correlation of a tile's patches with one source at each of the depths, -1 where it does not see them.

    tile: (top, bottom, left, right) in the reference.
    patches: image, subject, count, mean, variance of `backend.maths.correlation.PatchStatistics`,
    (height, width) each. source: (its height, its width), at least 2 pixels each way.
    epipolar: (3, 3) and (3), of `backend.maths.geometry.epipolar_map`. floor: variance of noise alone.
    inverse_depth: (planes, height, width). scores: (planes, bottom - top, right - left), written.
    """
    image, subject, count, mean, variance = patches
    a, b = epipolar
    top, bottom, left, right = tile
    height, width = image.shape
    size, inner = 2 * radius + 1, right - left
    first, last = max(left - radius, 0), min(right + radius, width)
    start, end = first - left + radius, last - left + radius
    # patches that reach beyond the image have zeros there
    products = np.zeros((size, 3, inner + 2 * radius), np.float32)
    seen = np.zeros((size, inner + 2 * radius), np.float32)
    columns = np.zeros((3, inner + 2 * radius), np.float64)
    sums = np.empty((3, inner), np.float32)
    index = np.empty(last - first, np.int32)
    x = np.empty(last - first, np.float32)
    y, to_right, down, warped = np.empty_like(x), np.empty_like(x), np.empty_like(x), np.empty_like(x)
    flat = source.ravel()
    source_height, source_width = source.shape
    for plane in range(len(inverse_depth)):
        products[:] = ZERO
        columns[:] = 0.0
        for row in range(max(top - radius, 0), bottom + radius):
            slot = row % size
            remove(products[slot], columns)
            if row < height:
                part = slice(first, last)
                warp(row, first, a, b, inverse_depth[plane, row, part], x, y)
                find(x, y, source_width, source_height, index, to_right, down, seen[slot, start:end])
                interpolate(flat, source_width, index, to_right, down, warped)
                multiply(warped, subject[row, part], image[row, part], products[slot, :, start:end])
                add(products[slot], columns)
            else:
                products[slot] = ZERO
            done = row - radius
            if done >= top:
                add_across(columns, sums)
                correlation(
                    sums,
                    count[done, left:right],
                    mean[done, left:right],
                    variance[done, left:right],
                    floor,
                    seen[done % size, radius : radius + inner],
                    scores[plane, done - top],
                )


@compiled
def warp(row: int, first: int, a: Floats, b: Floats, inverse_depth: Floats, x: Floats, y: Floats) -> None:
    """Where the source sees the pixels of a row; outside every image where that is behind it."""
    v = np.float32(row) + HALF
    x_at, y_at, z_at = a[0, 1] * v + a[0, 2], a[1, 1] * v + a[1, 2], a[2, 1] * v + a[2, 2]
    ax, ay, az, bx, by, bz = a[0, 0], a[1, 0], a[2, 0], b[0], b[1], b[2]
    start = np.float32(first) + HALF
    for u in range(len(x)):
        column = start + np.float32(np.int32(u))
        z = az * column + z_at + inverse_depth[u] * bz
        in_front = z > np.float32(1e-6)
        scale = ONE / (z if in_front else ONE)
        x[u] = (ax * column + x_at + inverse_depth[u] * bx) * scale if in_front else -ONE
        y[u] = (ay * column + y_at + inverse_depth[u] * by) * scale if in_front else -ONE


@compiled
def find(
    x: Floats, y: Floats, width: int, height: int, index: Ints, to_right: Floats, down: Floats, seen: Floats
) -> None:
    """For each place the pixel up left of it and the way from there; 1 or 0 for inside or outside.

    What lies outside is taken to the border.
    """
    right, below = np.float32(width), np.float32(height)
    last_column, last_row, stride = np.int32(width - 2), np.int32(height - 2), np.int32(width)
    for u in range(len(x)):
        seen[u] = ONE if (x[u] >= ZERO) & (x[u] < right) & (y[u] >= ZERO) & (y[u] < below) else ZERO
        column, row = x[u] - HALF, y[u] - HALF
        # what is not a number fails the first comparison: an index is never read outside the image
        column = column if column > ZERO else ZERO
        row = row if row > ZERO else ZERO
        column = column if column < right - ONE else right - ONE
        row = row if row < below - ONE else below - ONE
        i, j = min(np.int32(column), last_column), min(np.int32(row), last_row)
        to_right[u] = column - np.float32(i)
        down[u] = row - np.float32(j)
        index[u] = j * stride + i


@compiled
def interpolate(
    flat: Floats, width: int, index: Ints, to_right: Floats, down: Floats, values: Floats
) -> None:
    """Between the four pixels around each place."""
    beside, under = np.uint64(1), np.uint64(width)
    for u in range(len(index)):
        k = np.uint64(index[u])  # without a sign there is no look whether it counts from the end
        upper = flat[k] + to_right[u] * (flat[k + beside] - flat[k])
        lower = flat[k + under] + to_right[u] * (flat[k + under + beside] - flat[k + under])
        values[u] = upper + down[u] * (lower - upper)


@compiled
def multiply(warped: Floats, subject: Floats, image: Floats, products: Floats) -> None:
    """What is summed over patches: the source's values, their squares, their products with the reference."""
    for u in range(len(warped)):
        weighted = warped[u] * subject[u]
        products[0, u] = weighted
        products[1, u] = weighted * warped[u]
        products[2, u] = weighted * image[u]


@compiled
def add(products: Floats, columns: Doubles) -> None:
    """A row joins the sums over columns; in double precision, adding and removing loses nothing."""
    for channel in range(3):
        for u in range(columns.shape[1]):
            columns[channel, u] += np.float64(products[channel, u])


@compiled
def remove(products: Floats, columns: Doubles) -> None:
    """A row leaves the sums over columns."""
    for channel in range(3):
        for u in range(columns.shape[1]):
            columns[channel, u] -= np.float64(products[channel, u])


@compiled
def add_across(columns: Doubles, sums: Floats) -> None:
    """Sums over patches from those over columns."""
    if columns.shape[1] - sums.shape[1] == 6:  # a number that the compiler knows is four times as fast
        add_neighbours(columns, 7, sums)
    else:
        add_neighbours(columns, columns.shape[1] - sums.shape[1] + 1, sums)


@compiled
def add_neighbours(columns: Doubles, size: int, sums: Floats) -> None:
    for channel in range(3):
        for u in range(sums.shape[1]):
            total = 0.0
            for k in range(size):
                total += columns[channel, u + k]
            sums[channel, u] = np.float32(total)


@compiled
def correlation(
    sums: Floats,
    count: Floats,
    mean: Floats,
    variance: Floats,
    floor: np.float32,
    seen: Floats,
    scores: Floats,
) -> None:
    """`backend.maths.correlation.correlation` from the sums of a row's patches."""
    for u in range(len(scores)):
        share = ONE / count[u]
        middle = sums[0, u] * share
        spread = max(sums[1, u] * share - middle * middle, ZERO)
        together = sums[2, u] * share - middle * mean[u]
        value = together / np.sqrt((variance[u] + floor) * (spread + floor))
        scores[u] = value if seen[u] > ZERO else -ONE


@compiled
def soft_maximum(per_source: Floats, temperature: np.float32) -> None:
    """Mean weighted by e^(score / temperature) over the first axis of (sources, planes, rows, columns).

    Left in the place of the first source.
    """
    sources, planes, rows, columns = per_source.shape
    highest = np.empty(columns, np.float32)
    total, weight = np.empty_like(highest), np.empty_like(highest)
    for plane in range(planes):
        for row in range(rows):
            for u in range(columns):
                highest[u] = -ONE
                total[u] = weight[u] = ZERO
            for s in range(sources):
                for u in range(columns):
                    highest[u] = max(highest[u], per_source[s, plane, row, u])
            for s in range(sources):
                for u in range(columns):
                    score = per_source[s, plane, row, u]
                    share = exponential((score - highest[u]) / temperature)
                    total[u] += share * score
                    weight[u] += share
            for u in range(columns):
                per_source[0, plane, row, u] = total[u] / weight[u]


@compiled
def exponential(x: np.float32) -> np.float32:
    """e^x for x from -14 to 0, to 2e-5 of itself: (e^(x / 64))^64, as vector instructions.

    The library's is called number by number, which took longer than all else here.
    """
    x = max(x, np.float32(-20)) / np.float32(64)
    third = HALF + x * (np.float32(1 / 6) + x * (np.float32(1 / 24) + x * np.float32(1 / 120)))
    e = ONE + x * (ONE + x * third)
    e *= e
    e *= e
    e *= e
    e *= e
    e *= e
    return e * e


def error_of_an_image_with_itself() -> float:
    """How far the score of a patch compared with itself is from variance / (variance + floor), at most."""
    columns, rows = np.meshgrid(np.arange(16), np.arange(12))
    image = np.sin(columns * 1.3 + rows * rows * 0.7).astype(np.float32)
    middle = np.lib.stride_tricks.sliding_window_view(image, (7, 7))
    count, mean, variance = np.full((3, *image.shape), 49, np.float32)
    mean[3:-3, 3:-3], variance[3:-3, 3:-3] = middle.mean(axis=(2, 3)), middle.var(axis=(2, 3))
    patches = (image, np.ones_like(image), count, mean, variance)
    nowhere_else = (np.eye(3, dtype=np.float32), np.zeros(3, np.float32))
    depth, floor = np.ones((1, *image.shape), np.float32), np.float32(0.1)
    scores = np.empty((1, 1, 6, 10), np.float32)
    correlate((3, 9, 3, 13), 3, patches, image, nowhere_else, floor, depth, scores[0])
    soft_maximum(scores, ONE)
    expected = variance[3:-3, 3:-3] / (variance[3:-3, 3:-3] + floor)
    return float(np.abs(scores[0, 0] - expected).max())
