"""Exponents of known power laws, what each sweep changes, and one small run."""

import json
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from backend.benchmark import scaling
from backend.benchmark.scaling import (
    LARGEST_LINEAR,
    SWEEPS,
    Cost,
    Setup,
    exponent,
    exponents,
    least,
    measure,
    table,
    verdict,
)
from backend.benchmark.suites import Case
from backend.presets import PRESETS, Settings
from backend.stages.photos import PhotosConfig
from backend.stages.report import flat_settings
from backend.stages.train.surface_fit import TrainConfig
from benchmarks import scaling as command
from tests.synthetic_scene import photographed, ring_cameras, write_scene

CHANGED = {
    "views": {"stereo.num_sources"},
    "pixels": {"photos.max_side_px"},
    "nodes": {"train.levels"},
}
SIZES = [3, 6, 12]


def costs_of(power: float, numbers: tuple[str, ...] = ("stereo_s",)) -> list[Cost]:
    """What would grow with that power of the number of views; all that is not named is not known."""
    unknown = dict.fromkeys(
        (
            "stereo_s",
            "train_s",
            "finest_grid_s",
            "mesh_s",
            "peak_memory_bytes",
            "work_memory_bytes",
        )
    )
    return [
        Cost(
            sizes={"views": size, "pixels": 480_000, "nodes": 128**3},
            numbers={**unknown, **{name: 0.5 * size**power for name in numbers}},
        )
        for size in SIZES
    ]


@given(
    st.floats(-3, 3),
    st.floats(1e-3, 1e3),
    st.lists(st.integers(1, 10**7), min_size=2, max_size=6, unique=True),
)
def test_a_power_law_gives_its_exponent(power: float, factor: float, sizes: list[int]) -> None:
    values = [factor * size**power for size in sizes]
    assert exponent(sizes, values) == pytest.approx(power, rel=1e-6, abs=1e-6)


def test_the_line_is_the_one_of_least_squares() -> None:
    """Residuals of the logarithms (0, 1, 0) over (0, 1, 2) are symmetric: the line is level."""
    assert exponent([1, 2, 4], [3.0, 30.0, 3.0]) == pytest.approx(0.0, abs=1e-12)
    assert exponent([1, 2, 4], [1.0, 1.0, 4.0]) == pytest.approx(1.0)


@pytest.mark.parametrize("sweep", SWEEPS)
def test_a_sweep_changes_what_it_is_named_after(sweep: str) -> None:
    setups = SWEEPS[sweep]
    default = dict(flat_settings(PRESETS["balanced"]))
    for setup in setups:
        mine = dict(flat_settings(setup.settings))
        assert {name for name in mine if mine[name] != default[name]} <= CHANGED[sweep]
    assert len({(setup.num_views, setup.settings) for setup in setups}) == len(setups) >= 3
    if sweep != "views":
        assert len({setup.num_views for setup in setups}) == 1


def test_the_grid_is_fitted_without_rendering_and_only_its_finest_level_changes() -> None:
    default = PRESETS["balanced"].train
    for setup in SWEEPS["nodes"]:
        train = setup.settings.train
        assert train.levels[:-1] == default.levels[:-1]
        assert not any(train.steps)
        assert len(train.levels) == len(train.steps) == len(train.rounds)


def test_the_table_ends_each_row_with_the_exponent() -> None:
    lines = table("views", costs_of(1.5, ("stereo_s", "work_memory_bytes"))).splitlines()
    assert lines[0] == "| views | 3 | 6 | 12 | exponent |"
    assert lines[2] == "| stereo s | 2.60 | 7.35 | 20.78 | 1.50 |"
    assert [line.split("|")[1].strip() for line in lines[2:]] == ["stereo s", "of it for the work GB"]
    assert lines[3] == "| of it for the work GB | 0.00 | 0.00 | 0.00 | 1.50 |"


def test_numbers_that_one_run_lacks_have_no_exponent() -> None:
    costs = costs_of(1.0)
    lacking = Cost(sizes=costs[0].sizes, numbers={**costs[0].numbers, "stereo_s": None})
    assert exponents("views", [lacking, *costs[1:]]) == {}
    assert table("views", [lacking, *costs[1:]]).splitlines()[2] == "| stereo s | - | 3.00 | 6.00 | - |"


def test_one_size_has_no_exponent() -> None:
    assert exponents("pixels", costs_of(1.0)) == {}


def test_what_is_worse_than_linear_is_named() -> None:
    assert verdict("views", costs_of(LARGEST_LINEAR - 0.01)) == "Worse than linear in views: nothing.\n"
    steep = costs_of(1.3, ("stereo_s", "mesh_s"))
    assert verdict("views", steep) == "Worse than linear in views: stereo s (1.30), mesh s (1.30).\n"


def test_of_several_runs_the_least_of_each_number_counts() -> None:
    runs = [
        Cost(sizes={"views": 3}, numbers={"stereo_s": stereo_s, "mesh_s": mesh_s})
        for stereo_s, mesh_s in ((2.0, 0.5), (1.0, 0.7))
    ]
    assert least(runs).numbers == {"stereo_s": 1.0, "mesh_s": 0.5}


def toy_scene(photos: Path) -> Case:
    write_scene(photographed(ring_cameras(6, 96)), photos / "toy")
    return Case(name="toy", folder="toy", given=tuple(range(6)), cameras="images/transforms.json")


def small(num_views: int) -> Setup:
    train = TrainConfig(levels=(24, 32), rounds=(3, 3), steps=(0, 2), detail=0)
    settings = Settings(photos=PhotosConfig(max_side_px=80), train=train)
    return Setup(num_views=num_views, settings=settings)


def test_a_run_tells_its_sizes_and_what_each_stage_took(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scaling, "set_up_torch", lambda _: None)  # it would last beyond this test
    case = toy_scene(tmp_path)
    cost = measure(case, tmp_path / "toy", small(4), "cpu")
    assert cost.sizes == {"views": 4, "pixels": 80 * 60, "nodes": 32**3}
    numbers = {name: value for name, value in cost.numbers.items() if value is not None}
    assert min(numbers[name] for name in ("stereo_s", "mesh_s")) > 0
    assert 0 < numbers["finest_grid_s"] < numbers["train_s"]
    assert 0 <= numbers["work_memory_bytes"] < numbers["peak_memory_bytes"]


@pytest.mark.slow
def test_the_command_measures_in_another_process_and_leaves_its_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "CASES", {"toy": toy_scene(tmp_path)})
    monkeypatch.setattr(command, "SWEEPS", {"views": (small(4), small(7))})
    output = tmp_path / "out"
    words = ["--case", "toy", "--photos", str(tmp_path), "--output", str(output), "--device", "cpu"]
    monkeypatch.setattr(sys, "argv", ["scaling", *words])
    assert command.main() == 0
    results = json.loads((output / "results.json").read_text())
    (cost,) = results["sweeps"]["views"]  # the case has no seven views
    assert cost["sizes"]["views"] == 4
    text = (output / "table.md").read_text()
    assert text.startswith("| views | 4 | exponent |")
    assert "linear" not in text  # one size says nothing of growth
    assert capsys.readouterr().out == text


def test_the_command_refuses_a_case_whose_files_are_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        sys, "argv", ["scaling", "--scenes", str(tmp_path), "--output", str(tmp_path / "out")]
    )
    with pytest.raises(SystemExit, match="2"):
        command.main()
    assert "files are missing of monkey_12" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
