"""A benchmark's results as two small files that can be kept with the code."""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from .measuring import Measurement
from .summary import Summary, aggregate
from .writing import tables


def write_record(
    folder: Path,
    about: Mapping[str, object],
    runs: Sequence[Measurement],
    *,
    code: str,
    date: str,
    shown: Callable[[Sequence[Summary]], str] = tables,
) -> None:
    """Write SUITE.json, with a line for each run, and SUITE.md: what tables in the documents are taken from.

    `about` names the suite, `code` is the fingerprint of what computed and measured, and `shown` makes the
    tables. Folders of this machine are left out.
    """
    suite = str(about["suite"])
    versions = next((run.versions for run in runs if run.versions), {})
    head = {**about, "date": date, "code": code, "versions": versions}
    facts = [f"  {json.dumps(name)}: {json.dumps(value)},\n" for name, value in head.items()]
    rows = ",\n".join(f"    {json.dumps(_recorded(run), allow_nan=False)}" for run in runs)
    folder.mkdir(parents=True, exist_ok=True)
    text = "{\n" + "".join(facts) + f'  "runs": [\n{rows}\n  ]\n}}\n'
    (folder / f"{suite}.json").write_text(text, encoding="utf-8")
    lines = [f"- {name}: {json.dumps(value)}\n" for name, value in head.items()]
    summaries = [
        replace(summary, failures=tuple(map(_without_folders, summary.failures)))
        for summary in aggregate(runs)
    ]
    title = f"# Suite {suite}\n\nEvery run's numbers are in {suite}.json.\n\n"
    (folder / f"{suite}.md").write_text(title + "".join(lines) + "\n" + shown(summaries), encoding="utf-8")


def _recorded(run: Measurement) -> dict[str, object]:
    """A run with its numbers to six digits."""
    kept: dict[str, object] = {
        "case": run.case,
        "preset": run.preset,
        "budget_s": run.budget_s,
        "device": run.device,
        "seed": run.seed,
        "numbers": {
            name: None if value is None else float(f"{value:.6g}") for name, value in run.numbers.items()
        },
    }
    return kept if run.failure is None else {**kept, "failure": _without_folders(run.failure)}


def _without_folders(text: str) -> str:
    """With the names of files alone where they stood with their folders."""
    return re.sub(r"[^\s'\"]*[/\\]", "", text)
