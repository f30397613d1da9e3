"""What each part is worth: chosen cases with one part changed at a time; run by the backend's Python.

    python -m benchmarks.ablation --scenes build/benchmark/scenes --cases monkey_3 plaster_6 --output DIR

Leaves table.md and results.json, written anew after every run.
"""

import argparse
import json
import logging
import sys
from dataclasses import asdict
from pathlib import Path

from backend.benchmark.ablation import COLUMNS, PRESET, VARIANTS, measure_variants
from backend.benchmark.measuring import Measurement
from backend.benchmark.suites import CASES
from backend.benchmark.summary import aggregate, table
from backend.benchmark.writing import machine_facts
from backend.machine import choose_device, set_up_torch
from benchmarks.chosen import add_places, chosen_cases

_NAMES = {variant.name: variant for variant in VARIANTS}
logger = logging.getLogger(__name__)


def parser() -> argparse.ArgumentParser:
    """The command's words."""
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = made.add_argument
    add("--cases", nargs="+", choices=tuple(CASES), metavar="CASE", default=["monkey_3", "plaster_6"])
    add("--variants", nargs="+", choices=tuple(_NAMES), metavar="NAME", default=tuple(_NAMES))
    add("--seeds", type=int, metavar="N", default=1, help="how often to run what is random (1)")
    add_places(made)
    return made


def main() -> int:
    """The exit code."""
    words = parser()
    parsed = words.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    cases = chosen_cases(words, parsed, [CASES[name] for name in parsed.cases])
    device = choose_device(parsed.device)
    set_up_torch(device)
    variants = [_NAMES[name] for name in parsed.variants]
    parsed.output.mkdir(parents=True, exist_ok=True)
    runs: list[Measurement] = []
    for case, folder in cases:
        for run in measure_variants(case, folder, variants, num_seeds=parsed.seeds, device=device):
            runs.append(run)
            logger.info("%s, %s, seed %d: %s", run.case, run.preset, run.seed, run.failure or "done")
            _write(parsed.output, runs)
    sys.stdout.write((parsed.output / "table.md").read_text(encoding="utf-8"))
    return 0


def _write(output: Path, runs: list[Measurement]) -> None:
    content = {"preset": PRESET, "machine": machine_facts(), "runs": [asdict(run) for run in runs]}
    (output / "results.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    failures = [f"- {run.case}, {run.preset}: {run.failure}\n" for run in runs if run.failure is not None]
    text = table(aggregate(runs), COLUMNS, compared="variant") + "".join(
        ["\n", *failures] if failures else []
    )
    (output / "table.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
