"""How support foretells error, in closed forms and pair by pair."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from backend.maths.calibration import calibration, chance_of_less
from backend.maths.metrics import TrueSurface, surface_error
from backend.scene import SurfaceMesh

# Few different values, so that ties come up.
VALUES = st.lists(st.integers(0, 4).map(lambda value: value / 4), max_size=12)


def strips(
    ends: list[tuple[float, float]], heights: list[float], support: list[float], *, halvings: int = 0
) -> SurfaceMesh:
    """Rectangles of width 1 from end to end along x, each at a height; the first in 2^halvings pieces."""
    (start, stop), *others = ends
    cuts = np.linspace(start, stop, 2**halvings + 1)
    pieces = [*pairwise(cuts), *others]
    repeated = [2**halvings] + [1] * len(others)
    corners = np.array(
        [
            [[a, 0, z], [b, 0, z], [b, 1, z], [a, 1, z]]
            for (a, b), z in zip(pieces, np.repeat(heights, repeated), strict=True)
        ]
    )
    halves = np.array([[0, 1, 2], [0, 2, 3]])
    return SurfaceMesh(
        vertices=corners.reshape(-1, 3).astype(np.float64),
        faces=np.concatenate([halves + 4 * index for index in range(len(pieces))]),
        normals=np.tile(np.float32([0, 0, 1]), (4 * len(pieces), 1)),
        colours_srgb=np.zeros((4 * len(pieces), 3), np.uint8),
        support=np.repeat(np.repeat(np.float32(support), repeated), 4),
    )


def flat_truth(length: float) -> TrueSurface:
    vertices = np.array([[0.0, 0, 0], [length, 0, 0], [length, 1, 0], [0, 1, 0]])
    return TrueSurface(vertices=vertices, faces=np.array([[0, 1, 2], [0, 2, 3]]))


@given(VALUES, VALUES)
def test_the_chance_is_the_share_of_pairs(values: list[float], others: list[float]) -> None:
    """Pair by pair, ties counting half; and of the two ways round one is the other's complement."""
    found = chance_of_less(np.array(values), np.array(others))
    if not (values and others):
        assert found is None
        return
    pairs = [1.0 if a < b else 0.5 if a == b else 0.0 for a in values for b in others]
    assert found == pytest.approx(np.mean(pairs), abs=1e-12)
    assert chance_of_less(np.array(others), np.array(values)) == pytest.approx(1 - found, abs=1e-12)


@pytest.mark.parametrize(
    ("support", "auc"),
    [
        ([0.1, 0.2, 0.8, 0.9], 1.0),
        ([0.9, 0.8, 0.2, 0.1], 0.0),
        ([0.4, 0.4, 0.4, 0.4], 0.5),
        ([0.1, 0.5, 0.5, 0.9], 0.875),
    ],
)
def test_order_reversed_order_and_none(support: list[float], auc: float) -> None:
    """Two wrong samples, then two right ones, the first of them just so."""
    found = calibration(np.array(support), np.array([5.0, 1.001, 1.0, 0.0]))
    assert found.auc == auc


@pytest.mark.parametrize("error_percent", [0.5, 2.0])
def test_where_all_is_right_or_all_is_wrong_there_is_nothing_to_tell_apart(error_percent: float) -> None:
    found = calibration(np.array([0.2, 0.9]), np.full(2, error_percent))
    assert found.auc is None
    assert [step.share_within_one_percent for step in found.steps if step.share_of_mesh] == [
        float(error_percent <= 1)
    ] * 2


def test_steps_hold_what_their_ends_say() -> None:
    """A sample on an end counts above it, but 1 in the last step."""
    support = np.float32([0.0, 0.19, 0.2, 0.3, 0.39, 0.8, 1.0, 1.0])
    error = np.array([9.0, 7.0, 3.0, 2.0, 0.4, 0.6, 0.1, 5.0])
    steps = calibration(support, error).steps
    assert [(step.lowest_support, step.highest_support) for step in steps] == [
        pytest.approx((index / 5, (index + 1) / 5)) for index in range(5)
    ]
    assert [step.share_of_mesh for step in steps] == [0.25, 0.375, 0.0, 0.0, 0.375]
    assert [step.median_error_percent for step in steps] == [8.0, 2.0, None, None, 0.6]
    assert [step.share_within_one_percent for step in steps] == [
        0.0,
        pytest.approx(1 / 3),
        None,
        None,
        pytest.approx(2 / 3),
    ]


@pytest.mark.parametrize("halvings", [0, 5])
def test_the_area_counts_and_not_how_many_faces_it_has(halvings: int) -> None:
    """Of ten area units that are right, nine have more support than the two that are wrong, so AUC 0.9."""
    mesh = strips(
        [(10, 12), (0, 9), (9, 10)], heights=[0.5, 0, 0], support=[0.5, 0.9, 0.3], halvings=halvings
    )
    truth = flat_truth(12.0)
    found = surface_error(mesh, truth, cameras=None, seed=0, num_samples=50_000).support
    assert found.auc == pytest.approx(0.9, abs=0.01)
    shares = [step.share_of_mesh for step in found.steps]
    np.testing.assert_allclose(shares, [0, 1 / 12, 2 / 12, 0, 9 / 12], atol=0.01)
    assert [step.share_within_one_percent for step in found.steps] == [None, 1.0, 0.0, None, 1.0]
    assert found.steps[2].median_error_percent == pytest.approx(100 * 0.5 / truth.diagonal, rel=0.01)


def test_equal_support_is_equal_at_every_sample() -> None:
    """Ties of all pairs give one half exactly, whatever the corners' weights are rounded to."""
    mesh = strips([(0, 3), (3, 6)], heights=[0, 0.7], support=[0.3, 0.3])
    assert surface_error(mesh, flat_truth(6.0), cameras=None, seed=0, num_samples=3_000).support.auc == 0.5


def test_support_runs_evenly_between_the_corners() -> None:
    """Support x on a unit square that rises from the truth: wrong where the support is more than 0.4.

    The truth's samples are apart, which adds a little to small errors.
    """
    diagonal = np.sqrt(2.0)
    square = strips([(0, 1)], heights=[0], support=[0])
    x = square.vertices[:, 0]
    rising = square.vertices + np.outer(x, [0, 0, 0.01 * diagonal / 0.4])
    mesh = SurfaceMesh(
        vertices=rising,
        faces=square.faces,
        normals=square.normals,
        colours_srgb=square.colours_srgb,
        support=x.astype(np.float32),
    )
    found = surface_error(mesh, flat_truth(1.0), cameras=None, seed=0, num_samples=50_000).support
    assert found.auc == pytest.approx(0.0, abs=0.01)
    np.testing.assert_allclose([step.share_of_mesh for step in found.steps], 0.2, atol=0.005)
    np.testing.assert_allclose(
        [step.share_within_one_percent for step in found.steps], [1, 1, 0, 0, 0], atol=0.06
    )
    medians = [step.median_error_percent for step in found.steps]
    np.testing.assert_allclose(medians, np.array([0.1, 0.3, 0.5, 0.7, 0.9]) / 0.4, atol=0.08)
