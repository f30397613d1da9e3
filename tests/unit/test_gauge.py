"""A covariance in the gauge of the whole does not depend on the gauge it came from, nor on the world."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from backend.maths.gauge import in_gauge_of_the_whole, similarity_motions

CHANCE = np.random.default_rng(0)
POSITIONS = CHANCE.normal(size=(4, 3)) + 5.0
LENGTH = 3.0


def information() -> np.ndarray:
    """Of cameras that know all but the motions of the whole."""
    jacobian = CHANCE.normal(size=(60, 24))
    motions, _ = np.linalg.qr(similarity_motions(POSITIONS))
    jacobian -= jacobian @ motions @ motions.T
    return np.asarray(jacobian.T @ jacobian)


def held(normal: np.ndarray, fixed: list[int]) -> np.ndarray:
    """The covariance with seven coordinates held, 0 there."""
    free = np.setdiff1d(np.arange(24), fixed)
    covariance = np.zeros((24, 24))
    covariance[np.ix_(free, free)] = np.linalg.inv(normal[np.ix_(free, free)])
    return covariance


def test_motions_are_the_derivatives_of_similarities() -> None:
    """Shift, turn and scale the world a little, and see how orientations and centres move."""
    small = 1e-6
    orientations = Rotation.random(4, random_state=0)
    for column in range(7):
        shift, turn, scale = np.zeros(3), np.zeros(3), 1.0
        if column < 3:
            shift[column] = small
        elif column < 6:
            turn[column - 3] = small
        else:
            scale += small
        moved = scale * Rotation.from_rotvec(turn).apply(POSITIONS) + shift
        turned = (Rotation.from_rotvec(turn) * orientations * orientations.inv()).as_rotvec()
        expected = np.concatenate([turned, moved - POSITIONS], axis=1).ravel() / small
        np.testing.assert_allclose(similarity_motions(POSITIONS)[:, column], expected, atol=1e-5)


def test_every_gauge_gives_the_same() -> None:
    normal = information()
    one = in_gauge_of_the_whole(held(normal, [0, 1, 2, 3, 4, 5, 9]), POSITIONS, LENGTH)
    other = in_gauge_of_the_whole(held(normal, [18, 19, 20, 21, 22, 23, 4]), POSITIONS, LENGTH)
    np.testing.assert_allclose(one, other, atol=1e-9 * np.abs(one).max())
    assert not np.allclose(held(normal, [0, 1, 2, 3, 4, 5, 9]), one, atol=1e-3 * np.abs(one).max())


def test_no_gauge_has_a_smaller_sum_of_variances() -> None:
    normal = information()
    units = np.tile(np.repeat([1.0, LENGTH], 3), 4)
    covariance = held(normal, [0, 1, 2, 3, 4, 5, 9])
    smallest = np.diag(in_gauge_of_the_whole(covariance, POSITIONS, LENGTH)) @ units**-2
    assert smallest < np.diag(covariance) @ units**-2
    pseudo = np.linalg.pinv(normal * np.outer(units, units), rcond=1e-10)
    np.testing.assert_allclose(smallest, np.trace(pseudo), rtol=1e-9)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e5])
@pytest.mark.parametrize("middle", [0.0, 1e6])
def test_the_world_does_not_matter(scale: float, middle: float) -> None:
    """Orientations stay as sure as they are, places scale; the digits of places far away are what is lost."""
    normal = information()
    here = in_gauge_of_the_whole(held(normal, [0, 1, 2, 3, 4, 5, 9]), POSITIONS, LENGTH)
    units = np.tile(np.repeat([1.0, scale], 3), 4)
    there = in_gauge_of_the_whole(
        here * np.outer(units, units), scale * (POSITIONS + middle), scale * LENGTH
    ) / np.outer(units, units)
    np.testing.assert_allclose(there, here, atol=1e-8 * np.abs(here).max())
