"""What each part is worth: chosen cases with one part changed at a time; run by the backend's Python.

    python -m benchmarks.ablation --scenes build/benchmark/rendered --cases monkey_3 plaster_6 --output DIR

Each run has a process of its own, because a process knows only one peak of its memory. Leaves table.md and
results.json, written anew after every run; called again with the same folder it goes on, and measures again
only what depends on something that has changed.
"""

import argparse
import json
import logging
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path

from backend.benchmark.ablation import COLUMNS, inputs_of, measure_variants
from backend.benchmark.measuring import Measurement, measuring_fingerprint, runs_written
from backend.benchmark.record import write_record
from backend.benchmark.suites import CASES
from backend.benchmark.summary import Summary, aggregate, table
from backend.benchmark.variants import VARIANTS
from backend.benchmark.writing import machine_facts
from benchmarks.chosen import add_places, alone, chosen_cases

_NAMES = {variant.name: variant for variant in VARIANTS}
logger = logging.getLogger(__name__)


def parser() -> argparse.ArgumentParser:
    """The command's words."""
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = made.add_argument
    add("--cases", nargs="+", choices=tuple(CASES), metavar="CASE", default=["monkey_3", "plaster_6"])
    add("--variants", nargs="+", choices=tuple(_NAMES), metavar="NAME", default=tuple(_NAMES))
    add("--seeds", type=int, metavar="N", default=1, help="how often to run what is random (1)")
    add("--record", metavar="DIR", type=Path, help="where to leave ablation.json and ablation.md")
    add_places(made)
    return made


def main() -> int:
    """The exit code."""
    words = parser()
    parsed = words.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    cases = chosen_cases(words, parsed, [CASES[name] for name in parsed.cases])
    variants = [_NAMES[name] for name in parsed.variants]
    parsed.output.mkdir(parents=True, exist_ok=True)
    machine = machine_facts()
    before = runs_written(parsed.output)
    runs: list[Measurement] = []
    for case, folder in cases:
        inputs = {v.name: inputs_of(case, folder, v, parsed.device, machine) for v in variants}
        done = {
            (run.preset, run.seed): run
            for run in before
            if run.case == case.name and run.failure is None and run.inputs == inputs.get(run.preset)
        }
        measured = measure_variants(
            case, folder, variants, num_seeds=parsed.seeds, device=parsed.device, done=done, alone=alone
        )
        for run in measured:
            runs.append(replace(run, inputs=inputs[run.preset]))
            logger.info("%s, %s, seed %d: %s", run.case, run.preset, run.seed, run.failure or "done")
            rest = [run for run in before if (run.case, run.preset, run.seed) not in _places(runs)]
            _write(parsed.output, machine, runs, rest)
    if parsed.record is not None:
        about = {"suite": "ablation", "seeds": list(range(parsed.seeds)), "machine": machine}
        today = datetime.now(UTC).date().isoformat()
        write_record(parsed.record, about, runs, code=measuring_fingerprint(), date=today, shown=_tables)
    sys.stdout.write((parsed.output / "table.md").read_text(encoding="utf-8"))
    return 0


def _places(runs: list[Measurement]) -> set[tuple[str, str, int]]:
    return {(run.case, run.preset, run.seed) for run in runs}


def _write(
    output: Path, machine: Mapping[str, object], runs: list[Measurement], rest: list[Measurement]
) -> None:
    """Results keep the rest of an earlier call, which may still be needed; the table shows what is known."""
    content = {
        "machine": machine,
        "code": measuring_fingerprint(),
        "runs": [asdict(run) for run in (*runs, *rest)],
    }
    (output / "results.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    (output / "table.md").write_text(_tables(aggregate(runs)), encoding="utf-8")


def _tables(summaries: Sequence[Summary]) -> str:
    failures = [f"- {s.case}, {s.preset}: {failure}\n" for s in summaries for failure in s.failures]
    return table(summaries, COLUMNS, compared="variant") + "".join(["\n", *failures] if failures else [])


if __name__ == "__main__":
    sys.exit(main())
