"""What a benchmark leaves: results.json, table.md and plot.svg."""

import json
import os
import platform
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from ..held_files import written_whole
from ..machine import available_devices, usable_cores
from . import plot
from .measuring import Measurement
from .suites import with_budget
from .summary import COST_COLUMNS, Summary, aggregate, error_columns, table

_SPREAD = "Medians over the seeds, and after ± half the distance from the lowest to the highest."


def machine_facts() -> dict[str, object]:
    """What the times depend on."""
    return {
        "system": platform.platform(),
        "processor": _processor(),
        "cores": usable_cores(),
        "memory_bytes": _memory_bytes(),
        "devices": available_devices(),
    }


def write_results(output: Path, about: Mapping[str, object], runs: Sequence[Measurement]) -> None:
    """Write the three files anew; `about` is what holds for all runs, as JSON knows it."""
    summaries = aggregate(runs)
    versions = next((run.versions for run in runs if run.versions), {})
    content = {
        **about,
        "versions": versions,
        "summaries": [asdict(summary) for summary in summaries],
        "runs": [asdict(run) for run in runs],
    }
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    # In one step: all that was measured before is known from this file alone.
    with written_whole(output / "results.json") as part:
        part.write_text(text, encoding="utf-8")
    (output / "table.md").write_text(tables(summaries), encoding="utf-8")
    plot.draw(output / "plot.svg", summaries)


def tables(summaries: Sequence[Summary]) -> str:
    """Markdown: costs, the error of the visible part, that of the whole, and what failed."""
    parts = [
        _SPREAD + "\n",
        "Cost and colours:\n\n" + table(summaries, COST_COLUMNS),
        "Error of the visible part:\n\n" + table(summaries, error_columns("visible")),
        "Error of the whole surface:\n\n" + table(summaries, error_columns("whole")),
    ]
    failures = [
        f"- {s.case}, {with_budget(s.preset, s.budget_s)}: {failure}\n"
        for s in summaries
        for failure in s.failures
    ]
    if failures:
        parts.append("Failures:\n\n" + "".join(failures))
    return "\n".join(parts)


def _processor() -> str:
    """The model's name, as far as the system tells."""
    facts = Path("/proc/cpuinfo")
    lines = facts.read_text(encoding="utf-8").splitlines() if facts.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _memory_bytes() -> int | None:
    if sys.platform == "win32" or not {"SC_PAGE_SIZE", "SC_PHYS_PAGES"} <= os.sysconf_names.keys():
        return None
    return int(os.sysconf("SC_PAGE_SIZE")) * int(os.sysconf("SC_PHYS_PAGES"))
