import numpy as np
import pytest
from jaxtyping import Float64

from backend.maths.plane_fit import plane_of_most, plane_under_most

TOLERANCE = 0.01
NORMAL = np.array([2.0, -1.0, 2.0]) / 3


def on_plane(count: int, *, noise: float = 0.0) -> Float64[np.ndarray, "points 3"]:
    """A unit from the origin along the normal."""
    random = np.random.default_rng(3)
    points = random.normal(size=(count, 3))
    points += (1 - points @ NORMAL)[:, None] * NORMAL
    return np.asarray(points + noise * random.normal(size=(count, 1)) * NORMAL)


def test_exact_points_give_their_plane() -> None:
    plane = plane_of_most(on_plane(30), TOLERANCE)
    assert plane is not None
    assert plane.within.all()
    np.testing.assert_allclose(abs(plane.normal @ NORMAL), 1, atol=1e-12)
    np.testing.assert_allclose(plane.middle @ NORMAL, 1, atol=1e-12)
    np.testing.assert_allclose(abs(plane.distance(np.zeros(3))), 1, atol=1e-12)


@pytest.mark.parametrize("wrong", [10, 60])
def test_what_lies_elsewhere_has_no_part_in_it(wrong: int) -> None:
    """Even two fifths of all, and even if a plane holds those as well."""
    elsewhere = np.random.default_rng(1).normal(size=(wrong, 3)) * [1, 1, 0] + [0, 0, 3]
    plane = plane_of_most(np.concatenate([elsewhere, on_plane(90, noise=0.3 * TOLERANCE)]), TOLERANCE)
    assert plane is not None
    assert plane.within[wrong:].mean() > 0.98
    assert plane.within[:wrong].mean() < 0.1
    assert abs(plane.normal @ NORMAL) > 1 - 2e-7, "as least squares, not as three points"


def test_of_points_on_a_line_there_is_no_plane() -> None:
    assert plane_of_most(np.linspace(0, 1, 40)[:, None] * [[1.0, 2.0, 3.0]], TOLERANCE) is None


def test_the_plane_under_most_has_all_eyes_above_and_points_up() -> None:
    """Even if more points lie on another one, which has the rest below it."""
    lid = on_plane(120, noise=0.3 * TOLERANCE) + 0.5 * NORMAL
    points = np.concatenate([lid, on_plane(40, noise=0.3 * TOLERANCE)])
    for side in (1.0, -1.0):
        plane = plane_under_most(side * points, side * 3 * NORMAL[None], TOLERANCE, 0.2)
        assert plane is not None
        assert side * plane.normal @ NORMAL > 1 - 1e-5
        assert plane.within.sum() == 40
        assert plane.distance(side * lid) == pytest.approx(0.5, abs=2 * TOLERANCE)


def test_few_points_below_are_allowed() -> None:
    below = on_plane(10) - 0.5 * NORMAL
    points = np.concatenate([below, on_plane(40)])
    assert plane_under_most(points, 3 * NORMAL[None], TOLERANCE, 0.3) is not None
    few = plane_under_most(points, 3 * NORMAL[None], TOLERANCE, 0.2)
    assert few is None or few.within.sum() <= 10


def test_no_plane_is_under_eyes_on_both_sides_of_it() -> None:
    eyes = np.array([3 * NORMAL, -NORMAL])
    assert plane_under_most(on_plane(40), eyes, TOLERANCE, 0.2) is None


def test_the_same_points_have_the_same_plane() -> None:
    points = np.concatenate([on_plane(40, noise=TOLERANCE), np.random.default_rng(5).normal(size=(30, 3))])
    one, other = plane_of_most(points, TOLERANCE), plane_of_most(points, TOLERANCE)
    assert one is not None
    assert other is not None
    np.testing.assert_array_equal(one.normal, other.normal)
