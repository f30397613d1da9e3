"""The steps of `backend.maths.smooth_fit.fit_smooth`, compiled for the CPU.

In torch each of the two Laplacians goes over the grid thirteen times. Here planes of the first one stay in
the cache until the second has used them, and scalar products are summed on the way. Grids are
(nodes, nodes * nodes): a plane in a row; several cores share one by its planes.
"""

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from .compiled import Floats, compiled, summing
from .side_by_side import side_by_side

Number = TypeVar("Number")

DIAGONAL = 42.0
"""The middle of the stencil of two Laplacians: 6^2 + 6."""
ONE = np.uint64(1)
_TINY = 1e-30
_LEAST_TO_SHARE = 64


@compiled
def bend(
    field: Floats, weight: Floats, smoothness: np.float32, first: int, last: int, image: Floats
) -> float:
    """Writes weight * field + smoothness * Laplacian of the Laplacian to `image`; its product with the field.

    Of the planes from `first` to before `last`.
    """
    nodes, size = field.shape
    curved = np.empty((3, size), np.float32)
    twice = np.empty(size, np.float32)
    product = 0.0
    for plane in range(max(first - 1, 0), last + 1):
        if plane < nodes:
            before, after = field[max(plane - 1, 0)], field[min(plane + 1, nodes - 1)]
            laplacian_of_plane(field[plane], before, after, nodes, curved[plane % 3])
        done = plane - 1
        if done >= first:
            before, after = curved[max(done - 1, 0) % 3], curved[min(done + 1, nodes - 1) % 3]
            laplacian_of_plane(curved[done % 3], before, after, nodes, twice)
            product += combine(field[done], weight[done], smoothness, twice, image[done])
    return product


@compiled
def laplacian_of_plane(here: Floats, before: Floats, after: Floats, nodes: int, out: Floats) -> None:
    """`backend.maths.grid.laplacian` of a plane between its neighbours; beyond a side stands the node itself.

    Differences, not six times the middle: what they lose is a share of them, not of the values.
    here, before, after, out: (nodes * nodes).
    """
    for row in range(nodes):
        start, above, below = row * nodes, max(row - 1, 0) * nodes, min(row + 1, nodes - 1) * nodes
        for column in range(1, nodes - 1):
            k = np.uint64(start + column)  # without a sign there is no look whether it counts from the end
            along = (here[k + ONE] - here[k]) - (here[k] - here[k - ONE])
            across = (here[np.uint64(above + column)] - here[k]) + (here[np.uint64(below + column)] - here[k])
            out[k] = along + across + (before[k] - here[k]) + (after[k] - here[k])
        for column in range(0, nodes, nodes - 1):
            end = start + column
            along = here[end + (1 if column == 0 else -1)] - here[end]
            across = (here[above + column] - here[end]) + (here[below + column] - here[end])
            out[end] = along + across + (before[end] - here[end]) + (after[end] - here[end])


@summing
def combine(field: Floats, weight: Floats, smoothness: np.float32, twice: Floats, image: Floats) -> float:
    """Of a plane; the product of plane and image."""
    product = np.float32(0)
    for k in range(len(field)):
        image[k] = weight[k] * field[k] + smoothness * twice[k]
        product += field[k] * image[k]
    return float(product)


@compiled
def advance(
    solution: Floats, residual: Floats, direction: Floats, image: Floats, diagonal: Floats, step: np.float32
) -> float:
    """A step along the direction; the residual's product with itself over the diagonal."""
    energy = 0.0  # a plane is summed in single precision, planes in double
    for plane in range(len(solution)):
        energy += advance_plane(
            solution[plane], residual[plane], direction[plane], image[plane], diagonal[plane], step
        )
    return energy


@summing
def advance_plane(
    solution: Floats, residual: Floats, direction: Floats, image: Floats, diagonal: Floats, step: np.float32
) -> float:
    energy = np.float32(0)
    for k in range(len(solution)):
        solution[k] += step * direction[k]
        left = residual[k] - step * image[k]
        residual[k] = left
        energy += left * left / diagonal[k]
    return float(energy)


@compiled
def turn(direction: Floats, residual: Floats, diagonal: Floats, share: np.float32) -> None:
    """The next direction: the residual over the diagonal, and a share of the last direction."""
    for plane in range(len(direction)):
        turn_plane(direction[plane], residual[plane], diagonal[plane], share)


@compiled
def turn_plane(direction: Floats, residual: Floats, diagonal: Floats, share: np.float32) -> None:
    for k in range(len(direction)):
        direction[k] = residual[k] / diagonal[k] + share * direction[k]


def conjugate_gradients(
    weight: Floats, smoothness: float, right: Floats, start: Floats, *, steps: int, threads: int
) -> Floats:
    """As `backend.maths.conjugate_gradients`, for `bend`; all of (nodes, nodes, nodes)."""
    nodes = len(weight)
    weight, right, solution = (grid.reshape(nodes, -1) for grid in (weight, right, start.copy()))
    stiffness = np.float32(smoothness)
    diagonal = weight + stiffness * np.float32(DIAGONAL)
    image = np.empty_like(solution)
    # a small grid is done before another thread has woken up
    count = threads if nodes >= _LEAST_TO_SHARE else 1
    slabs = [slice(nodes * k // count, nodes * (k + 1) // count) for k in range(count)]

    def bend_all(field: Floats) -> float:
        return sum(
            side_by_side(lambda s: bend(field, weight, stiffness, s.start, s.stop, image), slabs, count)
        )

    def each(kernel: Callable[..., Number], grids: Sequence[Floats], number: float) -> list[Number]:
        return side_by_side(lambda s: kernel(*(grid[s] for grid in grids), np.float32(number)), slabs, count)

    bend_all(solution)
    residual = right - image
    direction = residual / diagonal
    energy = float(np.dot(residual.ravel(), direction.ravel()))
    for _ in range(steps):
        step = energy / max(bend_all(direction), _TINY)
        before = energy
        energy = sum(each(advance, (solution, residual, direction, image, diagonal), step))
        each(turn, (direction, residual, diagonal), energy / max(before, _TINY))
    return solution.reshape(nodes, nodes, nodes)


def error_of_a_constant() -> float:
    """How far from 2 the smoothest field is that is asked to be 2 everywhere, at most."""
    ones = np.ones((8, 8, 8), np.float32)
    found = conjugate_gradients(ones, 0.1, 2 * ones, 0 * ones, steps=2, threads=1)
    return float(np.abs(found - 2).max())
