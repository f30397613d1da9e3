"""What CI asks of a benchmark: every way in which it may have gone wrong is told."""

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.within_bounds import LARGEST_CHAMFER_PERCENT, LEAST_F_SCORE, complaints, main

GOOD = {"visible_chamfer_percent": 0.3, "visible_f_score_at_one_percent": 0.95, "watertight": 1.0}


def results(*, missing: tuple[str, ...] = (), failure: str | None = None, **numbers: Any) -> dict[str, Any]:
    run = {"case": "a", "preset": "fast", "seed": 0, "numbers": {**GOOD, **numbers}, "failure": failure}
    return {"missing": list(missing), "runs": [run]}


def test_a_good_run_is_within_bounds() -> None:
    assert complaints(results()) == []


@pytest.mark.parametrize(
    ("trouble", "words"),
    [
        ({"missing": ("lost",)}, "lost: its files are missing"),
        ({"failure": "too dark"}, "too dark"),
        ({"visible_chamfer_percent": LARGEST_CHAMFER_PERCENT}, "Chamfer"),
        ({"visible_chamfer_percent": None}, "Chamfer"),
        ({"visible_chamfer_percent": float("nan")}, "Chamfer"),
        ({"visible_f_score_at_one_percent": LEAST_F_SCORE}, "F@1%"),
        ({"visible_f_score_at_one_percent": None}, "F@1%"),
        ({"watertight": 0.0}, "not closed"),
    ],
)
def test_each_trouble_is_told(trouble: dict[str, Any], words: str) -> None:
    (told,) = complaints(results(**trouble))
    assert words in told


def test_nothing_run_is_no_success() -> None:
    assert complaints({"missing": [], "runs": []}) == ["nothing was run"]


def test_the_exit_code_tells(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "results.json"
    path.write_text(json.dumps(results()))
    assert main([str(path)]) == 0
    path.write_text(json.dumps(results(watertight=0.0)))
    assert main([str(path)]) == 1
    assert capsys.readouterr().out.splitlines() == [
        "1 runs, all within bounds",
        "a, fast, seed 0: the mesh is not closed",
    ]
