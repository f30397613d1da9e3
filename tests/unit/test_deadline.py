"""Time by a clock that is set by hand, and the grids that are predicted to fit into it."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from backend.stages.deadline import PESSIMISM, GridCost, deadline_after, finest_grid, predicted_s

SECONDS = st.floats(0.01, 100)
NODES = st.integers(16, 256)
COSTS = st.lists(st.builds(GridCost, nodes=NODES, seconds=SECONDS), min_size=1, max_size=4)


class HandClock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_time_runs_out() -> None:
    clock = HandClock()
    deadline = deadline_after(10.0, clock)
    assert (deadline.left_s(), deadline.share_gone(100.0)) == (10.0, 0.0)
    clock.now_s = 106.0
    assert (deadline.left_s(), deadline.share_gone(100.0), deadline.share_gone(102.0)) == (4.0, 0.6, 0.5)
    clock.now_s = 111.0
    assert (deadline.left_s(), deadline.share_gone(100.0)) == (-1.0, 1.0)


@pytest.mark.parametrize("since_s", [110.0, 111.0])
def test_what_begins_too_late_is_over(since_s: float) -> None:
    clock = HandClock()
    deadline = deadline_after(10.0, clock)
    clock.now_s = since_s
    assert deadline.share_gone(since_s) == 1.0


def test_without_a_budget_time_does_not_run_out() -> None:
    clock = HandClock()
    deadline = deadline_after(None, clock)
    clock.now_s = 1e9
    assert (deadline.left_s(), deadline.share_gone(100.0)) == (math.inf, 0.0)


def test_a_cost_of_points_and_nodes_is_continued() -> None:
    costs = [GridCost(nodes=nodes, seconds=2.0 + 1e-6 * nodes**3) for nodes in (48, 32, 64)]
    assert predicted_s(costs, 128) == pytest.approx(PESSIMISM * (2.0 + 1e-6 * 128**3))


def test_of_one_grid_the_cost_is_that_of_its_nodes() -> None:
    assert predicted_s([GridCost(nodes=32, seconds=1.0)], 64) == pytest.approx(8.0 * PESSIMISM)


@given(COSTS, NODES)
def test_a_finer_grid_is_never_predicted_to_be_cheaper(costs: list[GridCost], nodes: int) -> None:
    finest = max(costs, key=lambda cost: cost.nodes)
    finer = finest.nodes + nodes
    assert predicted_s(costs, finer) >= PESSIMISM * finest.seconds
    assert predicted_s(costs, finer + 1) >= predicted_s(costs, finer)


@given(COSTS, NODES, NODES, SECONDS, SECONDS)
def test_the_finest_grid_fits_and_more_time_makes_it_no_coarser(
    costs: list[GridCost], one: int, other: int, left_s: float, more_s: float
) -> None:
    coarsest, finest = sorted((one, other))
    nodes = finest_grid(costs, coarsest, finest, left_s)
    assert coarsest <= nodes <= finest
    assert nodes == coarsest or predicted_s(costs, nodes) <= left_s
    assert nodes in (coarsest, finest) or nodes % 16 == 0
    assert finest_grid(costs, coarsest, finest, left_s + more_s) >= nodes
    assert finest_grid(costs, coarsest, finest, math.inf) == finest


def test_between_two_levels_lies_a_grid_for_the_time_that_is_left() -> None:
    costs = [GridCost(nodes=nodes, seconds=1.0 + nodes**3 / 64**3) for nodes in (32, 64)]
    assert [finest_grid(costs, 64, 128, left_s) for left_s in (18.0, 17.9, 9.0, 8.7, 4.0)] == [
        128,
        112,
        96,
        80,
        64,
    ]
