"""What is measured alone is measured in a process whose threads wait as those of a run do."""

import os
from pathlib import Path
from typing import Any

import pytest

from backend import waiting
from backend.benchmark import measuring
from backend.benchmark.measuring import Trial, measure
from backend.benchmark.suites import Case
from backend.commands.cancelling import CancelRequest
from benchmarks.chosen import alone


def environment_there() -> tuple[int, dict[str, str]]:
    """Of the process that it is called in."""
    return os.getpid(), {name: os.environ[name] for name in waiting.POLICIES if name in os.environ}


@pytest.mark.slow
@pytest.mark.parametrize("chosen", [{}, {"OMP_WAIT_POLICY": "ACTIVE"}])
def test_another_process_waits_as_the_user_said_or_as_is_best_now(
    chosen: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in waiting.POLICIES:
        monkeypatch.delenv(name, raising=False)
    for name, value in chosen.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(waiting, "_chosen", {})
    monkeypatch.setattr(waiting, "_others_running", lambda: 0)
    there, policy = alone(environment_there)
    assert there != os.getpid()
    assert policy == (chosen or {"GOMP_SPINCOUNT": "10000"})


def test_a_run_of_the_benchmark_looks_for_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "0.png").touch()
    monkeypatch.setattr(waiting, "_chosen", {"GOMP_SPINCOUNT": "10000"})
    monkeypatch.setenv("GOMP_SPINCOUNT", "10000")
    got: list[dict[str, str]] = []

    def fails(_command: Any, *, environment: dict[str, str], **_: Any) -> int:
        got.append(environment)
        return 1

    monkeypatch.setattr(measuring, "run_child", fails)
    case = Case(name="toy", folder="toy", given=(0,))
    trial = Trial(case=case, folder=tmp_path, preset="fast", seed=0, device="cpu")
    assert measure(trial, tmp_path / "out", inputs="", program=(), request=CancelRequest()).failure
    assert "GOMP_SPINCOUNT" not in got[0]
    assert got[0]["PATH"] == os.environ["PATH"]
