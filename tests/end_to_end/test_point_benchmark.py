"""Points alone on noisy scans without normals: the default is ahead of screened Poisson.

The bounds are what a run of today reaches, with room for another machine's rounding; all clouds and methods
stand in docs/benchmarks.md.
"""

import json
import sys
from pathlib import Path

import pytest

from backend.point_methods import PointMethod
from backend.stages.points.point_network import NetworkConfig
from benchmarks import points
from benchmarks.points import cases, inputs_of, measured

DATA = Path(__file__).resolve().parents[2] / ".." / "shared" / "data"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not DATA.is_dir(), reason="the clouds of ../shared/data are not here"),
]


@pytest.mark.parametrize(
    ("name", "most_percent", "least_f_score", "poisson_percent"),
    [("00994122", 0.49, 0.92, 2.5), ("00011084", 0.86, 0.73, 2.3)],
    ids=["plate", "flange"],
)
def test_the_default_is_ahead_of_poisson(
    name: str, most_percent: float, least_f_score: float, poisson_percent: float
) -> None:
    """Chamfer distances in percent of the truth's diagonal; without the walk they are 0.51 and 0.97."""
    (scan,) = (case for case in cases(DATA, [name]) if case.name == name)
    ours, poisson = (
        measured(scan, method, NetworkConfig.steps).numbers for method in (PointMethod.LINEAR, "poisson")
    )
    assert ours["closed"]
    assert ours["chamfer_percent"] < most_percent
    assert ours["f_score_at_one_percent"] > least_f_score
    assert poisson["chamfer_percent"] > poisson_percent


def test_what_is_measured_is_recorded_and_not_measured_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(points, "set_up_torch", lambda _: None)  # it would last beyond this test
    words = ["--data", str(DATA), "--output", str(tmp_path), "--record", str(tmp_path / "record")]
    words += ["--clouds", "00994122", "--methods", "poisson"]
    monkeypatch.setattr(sys, "argv", ["points", *words])
    monkeypatch.setattr(points, "NOISE_PERCENT", (0.5,))
    assert points.main() == 0
    record = json.loads((tmp_path / "record" / "points.json").read_text(encoding="utf-8"))
    assert {run["case"] for run in record["runs"]} == {"00994122", "00994122, 1024, 0.5 %"}
    assert record["machine"]["cores"] > 0
    monkeypatch.setattr(points, "measured", None)  # not to be called
    assert points.main() == 0


def test_only_networks_are_measured_again_for_other_steps() -> None:
    (scan,) = (case for case in cases(DATA, ["00994122"]) if case.name == "00994122")
    assert inputs_of(scan, "linear", 1000) == inputs_of(scan, "linear", 500)
    assert inputs_of(scan, "nap", 1000) != inputs_of(scan, "nap", 500)
    assert inputs_of(scan, "nap", 1000) != inputs_of(scan, "sdro", 1000)
