"""Exposure: photographs of known exposure give it back, in spite of highlights and of what is not shared."""

import numpy as np
import pytest

from backend.maths.exposure import disagreement, log_exposures

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
