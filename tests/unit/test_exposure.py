"""Exposure: photographs of known exposure give it back, in spite of highlights and of what is not shared."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from backend.maths.exposure import compared_pairs, disagreement, log_exposures

TRUE = np.array([0.3, -0.5, 0.1, 0.1])


def light(*, seed: int = 0, points: int = 500) -> tuple[np.ndarray, np.ndarray]:
    """Logarithms of light in four photographs, each of which shows two thirds of the points."""
    random = np.random.default_rng(seed)
    colour = random.normal(-1.5, 0.6, points)
    shown = random.uniform(size=(4, points)) < 0.67
    return np.where(shown, TRUE[:, None] + colour, np.nan), shown


def test_known_exposures_come_back() -> None:
    np.testing.assert_allclose(log_exposures(*light()), TRUE, atol=1e-12)


def test_highlights_in_one_photograph_do_not_matter() -> None:
    log_light, shown = light()
    log_light[2, :150] += 2.0
    log_light[0] += np.random.default_rng(1).normal(0, 0.01, 500)
    np.testing.assert_allclose(log_exposures(log_light, shown), TRUE, atol=0.02)


def test_photographs_that_share_nothing_are_not_compared() -> None:
    """Two pairs without a common point: each has its own mean."""
    log_light, shown = light()
    shown[:2, 250:] = False
    shown[2:, :250] = False
    expected = TRUE - np.repeat([TRUE[:2].mean(), TRUE[2:].mean()], 2)
    np.testing.assert_allclose(log_exposures(log_light, shown), expected, atol=1e-12)


@pytest.mark.parametrize("views", [1, 3])
def test_nothing_shared_is_no_exposure(views: int) -> None:
    nothing = np.zeros((views, 7), bool)
    np.testing.assert_array_equal(log_exposures(np.ones((views, 7)), nothing), np.zeros(views))
    assert disagreement(np.ones((views, 7)), nothing) == 0


def test_disagreement_is_the_median_difference_and_goes_with_exposure() -> None:
    log_light, shown = light()
    pairs = [abs(a - b) for i, a in enumerate(TRUE) for b in TRUE[i + 1 :]]
    assert min(pairs) <= disagreement(log_light, shown) <= max(pairs)
    assert disagreement(log_light - TRUE[:, None], shown) < 1e-12
    both = shown[:2].all(axis=0)[None] & shown[:2]
    assert disagreement(log_light[:2], both) == pytest.approx(0.8)


def pieces(pairs: list[tuple[int, int]], views: int) -> list[int]:
    """The number of each photograph's group: those that pairs join, directly or not."""
    one, other = np.array(pairs, int).reshape(-1, 2).T
    return connected_components(coo_array((np.ones(len(one)), (one, other)), (views, views)))[1].tolist()


@given(st.integers(1, 12), st.integers(1, 40), st.floats(0, 1), st.integers(0, 2**31))
def test_what_any_pairs_join_the_compared_ones_join(views: int, points: int, share: float, seed: int) -> None:
    shown = np.random.default_rng(seed).uniform(size=(views, points)) < share
    chosen = compared_pairs(shown)
    all_pairs = [(i, j) for i, j in combinations(range(views), 2) if (shown[i] & shown[j]).any()]
    assert set(chosen) <= set(all_pairs)
    assert pieces(chosen, views) == pieces(all_pairs, views)


def test_groups_that_hardly_overlap_are_joined() -> None:
    """Each photograph shares most with its own group; a single point joins the two."""
    shown = np.zeros((12, 201), bool)
    shown[:6, :100] = shown[6:, 101:] = shown[[0, 6], 100] = True
    assert (0, 6) in compared_pairs(shown)
    assert len(set(pieces(compared_pairs(shown), 12))) == 1


def ring(views: int, *, points: int = 4000) -> np.ndarray:
    """What each photograph of a ring shows: a third of the way around."""
    around, azimuth = np.arange(points) / points, np.arange(views) / views
    return np.abs((around - azimuth[:, None] + 0.5) % 1 - 0.5) < 1 / 6


@pytest.mark.parametrize("views", [10, 20, 40, 80])
def test_pairs_grow_with_the_photographs_not_with_their_square(views: int) -> None:
    assert views <= len(compared_pairs(ring(views))) <= 4 * views


def test_exposures_come_back_around_a_ring() -> None:
    """Neighbours alone are compared: small errors do not add up on the way around."""
    random = np.random.default_rng(0)
    true = random.normal(0, 0.3, 24)
    shown = ring(24)
    log_light = true[:, None] + random.normal(-1.5, 0.6, 4000) + random.normal(0, 0.05, shown.shape)
    found = log_exposures(log_light, shown)
    np.testing.assert_allclose(found, true - true.mean(), atol=0.02)
    assert disagreement(log_light - found[:, None], shown) < 0.06 < disagreement(log_light, shown)
