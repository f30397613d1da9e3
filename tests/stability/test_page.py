"""docs/stability.md tells of every sweep, and of no other, and of errors as they are."""

import math
import re

import pytest

from tests.stability.measure import BEGIN, END, PAGE, SECTIONS, with_table
from tests.stability.sweep import Sweep, by_case

SWEEPS = [sweep for section in SECTIONS.values() for sweep in section]
TAKE_SECONDS = {
    "slopes of planes on maps from 0.3 to 30, in shares of a slope of 1e-4",
    "share of faces without area, six shapes on eight grids",
    "share of faces without area where a box has a fifth of its faces, eight grids",
    "gradient by distance, annealed slope and sharpness in the middles, in logits",
}
"""Held against the page only by whoever makes its table."""


def told() -> dict[str, tuple[float, float, float]]:
    """By what each sweep computes: the usual error, ours, and what the test allows."""
    measured = PAGE.read_text(encoding="utf-8").split(BEGIN)[1].split(END)[0]
    rows = [re.split(r"(?<!\\)\|", line)[1:-1] for line in measured.splitlines()[2:]]
    numbers = {
        row[0].strip().replace("\\|", "|"): [
            math.inf if cell.strip() == "not finite" else float(cell) for cell in row[2:]
        ]
        for row in rows
        if not row[0].startswith(" **")
    }
    return {what: (usual, ours, tolerance) for what, (usual, ours, tolerance) in numbers.items()}


def test_the_page_has_every_sweep_once() -> None:
    tolerances = [(what, tolerance) for what, (_, _, tolerance) in told().items()]
    assert tolerances == [(sweep.what, sweep.tolerance) for sweep in SWEEPS]


def test_every_sweep_that_takes_seconds_is_one() -> None:
    assert {sweep.what for sweep in SWEEPS} >= TAKE_SECONDS


@pytest.mark.parametrize(
    "sweep", [sweep for sweep in SWEEPS if sweep.what not in TAKE_SECONDS], ids=lambda sweep: sweep.what
)
def test_the_page_tells_errors_as_they_are(sweep: Sweep) -> None:
    """Up to a factor of four: processors differ in their last digits, and in the order of sums."""
    usual, ours, _ = told()[sweep.what]
    for there, here in ((usual, sweep.usual()), (ours, sweep.ours())):
        found = max(by_case(here).values())
        if there in (0, math.inf):
            assert found == there
        else:
            assert there / 4 < found < there * 4


def test_a_table_replaces_the_one_before() -> None:
    page = f"above\n{BEGIN}old\n{END}below\n"
    assert with_table(page, "new\n") == f"above\n{BEGIN}new\n{END}below\n"
