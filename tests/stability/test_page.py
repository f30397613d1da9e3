"""docs/stability.md tells of every sweep, and of no other."""

import re

from tests.stability.measure import BEGIN, END, PAGE, SECTIONS, with_table


def test_the_page_has_every_sweep_once() -> None:
    """The numbers differ with the computer; the largest error that a test allows does not."""
    measured = PAGE.read_text(encoding="utf-8").split(BEGIN)[1].split(END)[0]
    rows = [re.split(r"(?<!\\)\|", line)[1:-1] for line in measured.splitlines()[2:]]
    told = [(row[0].strip(), float(row[4])) for row in rows if not row[0].startswith(" **")]
    sweeps = [sweep for section in SECTIONS.values() for sweep in section]
    assert told == [(sweep.what.replace("|", "\\|"), sweep.tolerance) for sweep in sweeps]


def test_a_table_replaces_the_one_before() -> None:
    page = f"above\n{BEGIN}old\n{END}below\n"
    assert with_table(page, "new\n") == f"above\n{BEGIN}new\n{END}below\n"
