"""When a stage is to end, and how fine a grid can be fitted until then.

Without a budget nothing here depends on the clock.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

Clock = Callable[[], float]
"""Seconds since some moment; never goes back."""

PESSIMISM = 2.0
"""What a grid is taken to cost, as a multiple of what is expected: to be late is worse than to be coarse."""
_STEP = 16
"""Grids between those of the settings have multiples of this many nodes along each axis."""


@dataclass(frozen=True, kw_only=True)
class Deadline:
    """A moment by a clock."""

    clock: Clock
    at_s: float
    """Infinite where there is no budget."""

    def left_s(self) -> float:
        """Time until then; negative when it is past."""
        return self.at_s - self.clock()

    def share_gone(self, since_s: float) -> float:
        """Of the time from an earlier moment by the clock until then: 0 to 1; 0 where there is no budget."""
        given_s = self.at_s - since_s
        return min(1.0, (self.clock() - since_s) / given_s) if given_s > 0 else 1.0


@dataclass(frozen=True, kw_only=True)
class GridCost:
    """What fitting a grid took."""

    nodes: int
    """Along each axis."""
    seconds: float


def deadline_after(budget_s: float | None, clock: Clock) -> Deadline:
    """The moment `budget_s` from now, or never."""
    return Deadline(clock=clock, at_s=math.inf if budget_s is None else clock() + budget_s)


def predicted_s(costs: Sequence[GridCost], nodes: int) -> float:
    """What a finer grid will take, by what at least one coarser grid took.

    Reading the points costs the same at each grid, the rest grows with the number of nodes: a straight
    line over that number, through the coarsest and the finest grid so far, times PESSIMISM.
    """
    coarsest = min(costs, key=lambda cost: cost.nodes)
    finest = max(costs, key=lambda cost: cost.nodes)
    span = finest.nodes**3 - coarsest.nodes**3
    slope = max(0.0, finest.seconds - coarsest.seconds) / span if span else finest.seconds / finest.nodes**3
    return PESSIMISM * (finest.seconds + slope * (nodes**3 - finest.nodes**3))


def finest_grid(costs: Sequence[GridCost], coarsest: int, finest: int, left_s: float) -> int:
    """Nodes along each axis of the finest grid that is predicted to fit; `coarsest` where none does."""
    between = range(finest // _STEP * _STEP, coarsest, -_STEP)
    candidates = (finest, *between)
    return next((nodes for nodes in candidates if predicted_s(costs, nodes) <= left_s), coarsest)
