"""Where walks end, against closed forms of walks along a line, and laws that hold for any picture."""

import numpy as np
import pytest
from jaxtyping import Float

from backend.maths.random_walk import WalkEnds, walk_ends

CERTAIN = 1e9
"""A walk ends here at once."""
Picture = Float[np.ndarray, "height width"]


def ends(
    values: dict[tuple[int, int], float], colours: Picture, *, inside: Picture | None = None
) -> WalkEnds:
    """Of walks over a grey picture in which some pixels are known for certain."""
    value, sureness = np.full(colours.shape, np.nan), np.zeros(colours.shape)
    for place, known in values.items():
        value[place], sureness[place] = known, CERTAIN
    on = np.ones(colours.shape, np.bool_) if inside is None else inside > 0
    return walk_ends(colours[..., None], on, value, sureness, contrast=0.05)


def test_along_a_line_between_two_ends() -> None:
    """The gambler's ruin: x / n end at the far end, which gives variance and squared way in closed form."""
    n = 20
    x = np.arange(n + 1)
    found = ends({(0, 0): 3.0, (0, n): 5.0}, np.zeros((1, n + 1)))
    assert found.mean[0] == pytest.approx(3 + 2 * x / n, abs=1e-6)
    assert found.spread[0] ** 2 == pytest.approx(4 * x * (n - x) / n**2, abs=1e-6)
    assert found.distance_px[0] ** 2 == pytest.approx(x * (n - x), abs=1e-4)


def test_a_contrast_parts_what_is_known_on_either_side() -> None:
    colours = np.zeros((12, 20))
    colours[:, 11:] = 0.5
    found = ends({(6, 0): 1.0, (2, 19): 2.0}, colours)
    assert found.mean[:, :11] == pytest.approx(1.0, abs=0.01)
    assert found.mean[:, 11:] == pytest.approx(2.0, abs=0.01)
    assert found.spread.max() < 0.1
    assert ends({(6, 0): 1.0, (2, 19): 2.0}, 0 * colours).spread[6, 10] == pytest.approx(0.5, abs=0.02)


def test_a_less_sure_pixel_ends_fewer_walks() -> None:
    """Between two edges of conductance 1 a pixel that is as sure as one edge keeps a third of its walks."""
    sureness = np.array([[CERTAIN, 1.0, CERTAIN]])
    found = walk_ends(
        np.zeros((1, 3, 1)), np.ones((1, 3), np.bool_), np.array([[0.0, 9.0, 0.0]]), sureness, contrast=1.0
    )
    assert found.mean[0, 1] == pytest.approx(9 / 3, rel=1e-3)


def test_a_diagonal_step_is_half_as_easy() -> None:
    """Two neighbours at 0 and a diagonal one at 1: half of an edge against two."""
    found = ends({(0, 0): 1.0, (0, 1): 0.0, (1, 0): 0.0}, np.zeros((2, 2)))
    assert found.mean[1, 1] == pytest.approx(0.5 / 2.5)


def test_values_may_be_shifted_and_scaled() -> None:
    rng = np.random.default_rng(0)
    colours = rng.random((9, 11))
    known = {(1, 2): 0.3, (7, 9): 0.9, (4, 0): -0.2}
    plain = ends(known, colours)
    moved = ends({place: 1e6 + 7 * value for place, value in known.items()}, colours)
    assert moved.mean == pytest.approx(1e6 + 7 * plain.mean, abs=1e-6)
    assert moved.spread == pytest.approx(7 * plain.spread, abs=1e-4)
    assert plain.mean.min() >= -0.2 - 1e-9
    assert plain.mean.max() <= 0.9 + 1e-9


def test_where_no_walk_can_end_there_is_no_number() -> None:
    inside = np.ones((5, 9))
    inside[:, 4] = 0
    found = ends({(2, 1): 1.0}, np.zeros((5, 9)), inside=inside)
    assert np.isfinite(found.mean[:, :4]).all()
    for values in (found.mean, found.spread, found.distance_px):
        assert np.isnan(values[:, 4:]).all()


@pytest.mark.parametrize("inside", [np.zeros((3, 4)), np.ones((3, 4))])
def test_nothing_is_known_or_inside(inside: Picture) -> None:
    assert np.isnan(ends({}, np.zeros((3, 4)), inside=inside).mean).all()
