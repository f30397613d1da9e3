"""How time and memory grow with views, pixels and the grid; run by the backend's Python.

    python -m benchmarks.scaling --scenes build/benchmark/rendered --output DIR

Each run has a process of its own, because a process knows only one peak of its memory. Leaves table.md and
results.json, written anew after every sweep.
"""

import argparse
import json
import logging
import sys
from dataclasses import asdict
from pathlib import Path

from backend.benchmark.scaling import SWEEPS, Cost, exponents, least, measure, table, verdict
from backend.benchmark.suites import CASES, Case
from benchmarks.chosen import add_places, alone, chosen_cases

logger = logging.getLogger(__name__)


def parser() -> argparse.ArgumentParser:
    """The command's words."""
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = made.add_argument
    add("--case", choices=tuple(CASES), metavar="CASE", default="monkey_12")
    add("--sweeps", nargs="+", choices=tuple(SWEEPS), default=tuple(SWEEPS))
    add("--repeats", type=int, metavar="N", default=1, help="the least of N runs counts (1)")
    add_places(made)
    return made


def main() -> int:
    """The exit code."""
    words = parser()
    parsed = words.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    ((case, folder),) = chosen_cases(words, parsed, [CASES[parsed.case]])
    parsed.output.mkdir(parents=True, exist_ok=True)
    done: dict[str, list[Cost]] = {}
    for sweep in parsed.sweeps:
        done[sweep] = []
        for setup in SWEEPS[sweep]:
            if sweep == "views" and setup.num_views > len(case.given):
                continue
            costs = [alone(measure, case, folder, setup, parsed.device) for _ in range(parsed.repeats)]
            done[sweep].append(least(costs))
            logger.info("%s: %s", sweep, done[sweep][-1].sizes[sweep])
        _write(parsed.output, case, done)
    sys.stdout.write((parsed.output / "table.md").read_text(encoding="utf-8"))
    return 0


def _write(output: Path, case: Case, done: dict[str, list[Cost]]) -> None:
    from backend.benchmark.writing import machine_facts  # here: a measured process need not hold matplotlib

    content = {
        "case": case.name,
        "machine": machine_facts(),
        "sweeps": {sweep: [asdict(cost) for cost in costs] for sweep, costs in done.items()},
        "exponents": {sweep: exponents(sweep, costs) for sweep, costs in done.items()},
    }
    (output / "results.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    parts = []
    for sweep, costs in done.items():
        parts.append(table(sweep, costs))
        if len(costs) > 1:
            parts.append(verdict(sweep, costs))
    (output / "table.md").write_text("\n".join(parts), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
