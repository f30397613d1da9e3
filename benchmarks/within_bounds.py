"""Whether a benchmark ran to its end and found surfaces, not how good they are: for CI.

    python -m benchmarks.within_bounds build/benchmark/quick/results.json

The bounds are far from what is measured (visible Chamfer 0.21 to 0.32 %, F@1% 0.95 to 0.98; see
docs/benchmarks.md), so that neither chance nor another processor crosses them, and still mean something: a
classical pipeline has 0.43 % and 0.90 on the textured scene with three views, and no surface at all on the
one without texture.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

LARGEST_CHAMFER_PERCENT = 0.4
LEAST_F_SCORE = 0.9


def complaints(results: dict[str, Any]) -> list[str]:
    """What is missing or out of bounds in results.json of cases with a truth; empty where all is well."""
    found = [f"{name}: its files are missing" for name in results["missing"]]
    if not results["runs"]:
        found.append("nothing was run")
    for run in results["runs"]:
        name, numbers = f"{run['case']}, {run['preset']}, seed {run['seed']}", run["numbers"]
        if run["failure"] is not None:
            found.append(f"{name}: {run['failure']}")
            continue
        chamfer, f_score = numbers["visible_chamfer_percent"], numbers["visible_f_score_at_one_percent"]
        if not (chamfer is not None and chamfer < LARGEST_CHAMFER_PERCENT):
            found.append(f"{name}: visible Chamfer is {chamfer} %, not below {LARGEST_CHAMFER_PERCENT}")
        if not (f_score is not None and f_score > LEAST_F_SCORE):
            found.append(f"{name}: visible F@1% is {f_score}, not above {LEAST_F_SCORE}")
        if not numbers["watertight"]:
            found.append(f"{name}: the mesh is not closed")
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit code: 0 where all is well."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("results", type=Path, metavar="results.json")
    results = json.loads(words.parse_args(arguments).results.read_text(encoding="utf-8"))
    found = complaints(results)
    sys.stdout.write("\n".join(found or [f"{len(results['runs'])} runs, all within bounds"]) + "\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
