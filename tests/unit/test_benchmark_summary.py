"""Laws of the Pareto front, of medians and of the table; the plot is an SVG of known parts."""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from backend.benchmark.measuring import Measurement
from backend.benchmark.plot import budget_curve, colour_difference_percent, draw, points_of
from backend.benchmark.record import write_record
from backend.benchmark.summary import COST_COLUMNS, Column, aggregate, error_columns, pareto_front, table
from backend.benchmark.writing import tables

# Small whole numbers, so that ties and doubles come up.
POINTS = st.lists(st.tuples(st.integers(0, 6).map(float), st.integers(0, 6).map(float)), max_size=12)
SVG = "{http://www.w3.org/2000/svg}"


def run(case: str, preset: str, seed: int, numbers: Mapping[str, float | None]) -> Measurement:
    return Measurement(case=case, preset=preset, seed=seed, numbers=numbers, versions={"FewView": "1"})


def failed(case: str, preset: str, why: str) -> Measurement:
    return Measurement(case=case, preset=preset, seed=0, numbers={}, versions={}, failure=why)


def runs_of(cases: list[str], presets: list[str]) -> list[Measurement]:
    numbers = {"after_cameras_s": 5.0, "visible_chamfer_percent": 0.3, "held_out_psnr_db": 25.0}
    return [run(case, preset, seed, numbers) for case in cases for preset in presets for seed in range(3)]


@given(POINTS)
def test_nothing_dominates_the_front_and_the_front_dominates_all_else(
    points: list[tuple[float, float]],
) -> None:
    front = pareto_front(points)

    def beaten_by(index: int, others: list[int]) -> bool:
        x, y = points[index]
        return any(
            points[o][0] <= x and points[o][1] <= y and (points[o][0] < x or points[o][1] < y) for o in others
        )

    everybody = list(range(len(points)))
    assert not any(beaten_by(index, everybody) for index in front)
    assert all(beaten_by(index, list(front)) for index in set(everybody) - set(front))


@given(POINTS)
def test_along_the_front_error_falls_as_time_grows(points: list[tuple[float, float]]) -> None:
    line = [points[index] for index in pareto_front(points)]
    assert line == sorted(line)
    assert [y for _, y in line] == sorted((y for _, y in line), reverse=True)


def test_numbers_are_medians_with_their_ends() -> None:
    values = [3.0, 1.0, 10.0]
    runs = [run("a", "fast", seed, {"total_s": value, "x": None}) for seed, value in enumerate(values)]
    (summary,) = aggregate(runs)
    assert summary.num_runs == 3
    assert (summary.lowest["total_s"], summary.median["total_s"], summary.highest["total_s"]) == (1, 3, 10)
    assert "x" not in summary.median


def test_a_failure_is_no_number_and_is_told() -> None:
    runs = [
        run("a", "fast", 0, {"total_s": 2.0}),
        failed("a", "fast", "too dark"),
        failed("b", "fast", "gone"),
    ]
    first, second = aggregate(runs)
    assert (first.num_runs, first.median["total_s"], first.failures) == (1, 2.0, ("too dark",))
    assert (second.num_runs, second.median, second.failures) == (0, {}, ("gone",))
    text = tables((first, second))
    assert "- a, fast: too dark" in text
    assert "| b | fast | failed |" in text


def test_the_table_has_each_case_and_preset_once() -> None:
    cases, presets = ["a", "b", "c"], ["fast", "balanced"]
    for columns in (COST_COLUMNS, error_columns("visible"), error_columns("whole")):
        lines = table(aggregate(runs_of(cases, presets)), columns).splitlines()
        starts = [tuple(cell.strip() for cell in line.split("|")[1:3]) for line in lines[2:]]
        assert starts == [(case, preset) for case in cases for preset in presets]
        assert {line.count("|") for line in lines} == {len(columns) + 3}


def test_the_whole_surface_s_table_ends_with_what_support_foretells() -> None:
    (summary,) = aggregate([run("a", "fast", 0, {"support_auc": 0.8754})])
    head, _, row = table((summary,), error_columns("whole")).splitlines()
    assert head.endswith("| support AUC | closed |")
    assert row.endswith("| 0.875 | - |")
    assert "AUC" not in table((summary,), error_columns("visible"))


@pytest.mark.parametrize(("runs_closed", "said"), [((1, 1, 1), "yes"), ((0, 0), "no"), ((1, 0, 1), "no")])
def test_a_surface_is_called_closed_where_all_runs_closed_it(runs_closed: tuple[int, ...], said: str) -> None:
    runs = [run("a", "fast", seed, {"watertight": float(is_)}) for seed, is_ in enumerate(runs_closed)]
    assert table(aggregate(runs), error_columns("whole")).splitlines()[-1].endswith(f"| {said} |")


def test_several_devices_have_rows_and_a_column_of_their_own() -> None:
    runs = runs_of(["a"], ["fast"])
    assert "device" not in table(aggregate(runs), COST_COLUMNS)
    runs = [replace(r, device=device) for device in ("cpu", "cuda") for r in runs]
    lines = table(aggregate(runs), COST_COLUMNS).splitlines()
    assert lines[0].startswith("| case | preset | device |")
    assert [line.split("|")[3].strip() for line in lines[2:]] == ["cpu", "cuda"]
    assert {line.count("|") for line in lines} == {len(COST_COLUMNS) + 4}


def test_the_plot_tells_devices_apart(tmp_path: Path) -> None:
    runs = [replace(r, device=device) for device in ("cpu", "cuda") for r in runs_of(["a"], ["fast"])]
    draw(tmp_path / "plot.svg", aggregate(runs))
    root = ElementTree.parse(tmp_path / "plot.svg").getroot()
    words = ["".join(text.itertext()) for text in root.iter(f"{SVG}text")]
    assert [words.count(f"a, fast on {device}") for device in ("cpu", "cuda")] == [1, 1]


def test_a_record_has_every_run_and_no_folder_of_this_machine(tmp_path: Path) -> None:
    wrong = failed("b", "fast", "could not read '/home/me/photos/1.png': gone, see C:\\me\\log.txt")
    runs = [*runs_of(["a"], ["fast"]), wrong]
    runs[0] = replace(runs[0], device="cpu", numbers={"stereo_s": 1.23456789, "x": None})
    about = {"suite": "toy", "machine": {"cores": 2}, "seeds": [0, 1, 2], "missing": ("lost",)}
    write_record(tmp_path / "new" / "results", about, runs, code="c0de", date="2026-01-02")
    assert {path.name for path in (tmp_path / "new" / "results").iterdir()} == {"toy.json", "toy.md"}
    text = (tmp_path / "new" / "results" / "toy.json").read_text()
    written = json.loads(text)
    assert written["machine"] == {"cores": 2}
    assert (written["code"], written["date"], written["seeds"]) == ("c0de", "2026-01-02", [0, 1, 2])
    assert written["versions"] == {"FewView": "1"}
    assert len(written["runs"]) == len(runs)
    assert written["runs"][0] == {
        "case": "a",
        "preset": "fast",
        "budget_s": None,
        "device": "cpu",
        "seed": 0,
        "numbers": {"stereo_s": 1.23457, "x": None},
    }
    assert written["runs"][-1]["failure"] == "could not read '1.png': gone, see log.txt"
    assert text.count("\n") == len(runs) + len(about) + 3 + 4  # a line for each run and each fact
    table_text = (tmp_path / "new" / "results" / "toy.md").read_text()
    assert "| a | fast |" in table_text
    assert "1.png" in table_text
    assert "home" not in text + table_text


def test_a_cell_shows_the_median_and_half_the_range_in_its_unit() -> None:
    runs = [run("a", "fast", seed, {"bytes": value}) for seed, value in enumerate((1e9, 2e9, 5e9))]
    column = Column(heading="GB", number="bytes", digits=1, scale=1e-9)
    assert table(aggregate(runs), [column]).splitlines()[-1] == "| a | fast | 2.0 ± 2.0 |"
    assert table(aggregate(runs[:1]), [column]).splitlines()[-1] == "| a | fast | 1.0 |"
    assert (
        table(aggregate([run("a", "fast", 0, {"b": 1.0})]), [column]).splitlines()[-1] == "| a | fast | - |"
    )


@pytest.mark.parametrize(("psnr_db", "percent"), [(0.0, 100.0), (20.0, 10.0), (40.0, 1.0)])
def test_colour_difference_in_closed_form(psnr_db: float, percent: float) -> None:
    assert colour_difference_percent(psnr_db) == pytest.approx(percent)


def test_the_plot_names_what_it_shows_and_repeats_to_the_byte(tmp_path: Path) -> None:
    summaries = aggregate(runs_of(["a", "b"], ["fast", "balanced"]))
    for name in ("one.svg", "two.svg"):
        draw(tmp_path / name, summaries)
    assert (tmp_path / "one.svg").read_bytes() == (tmp_path / "two.svg").read_bytes()
    root = ElementTree.parse(tmp_path / "one.svg").getroot()
    assert root.tag == f"{SVG}svg"
    words = ["".join(text.itertext()) for text in root.iter(f"{SVG}text")]
    assert [words.count(f"{case}, {preset}") for case in "ab" for preset in ("fast", "balanced")] == [1] * 4


def with_budgets(case: str, budgets_s: list[float]) -> list[Measurement]:
    """The more time the smaller the error; the longest budget needs but half of its time."""
    return [
        replace(
            run(
                case,
                "fast",
                0,
                {"after_cameras_s": min(budget_s, 20.0), "visible_chamfer_percent": 1 / budget_s},
            ),
            budget_s=budget_s,
        )
        for budget_s in budgets_s
    ]


def test_budgets_have_rows_of_their_own() -> None:
    text = table(aggregate([*runs_of(["a"], ["fast"]), *with_budgets("a", [10.0, 2.5])]), COST_COLUMNS)
    assert [line.split("|")[2].strip() for line in text.splitlines()[2:]] == ["fast", "fast@10s", "fast@2.5s"]


def test_a_budget_s_curve_is_in_order_of_time_and_without_the_run_that_had_none() -> None:
    summaries = aggregate([*runs_of(["a"], ["fast"]), *with_budgets("a", [40.0, 10.0, 2.5])])
    curve = budget_curve(points_of(summaries, "visible_chamfer_percent"))
    assert curve == ((2.5, 0.4), (10.0, 0.1), (20.0, 0.025))


def test_the_plot_names_the_curve_once(tmp_path: Path) -> None:
    draw(tmp_path / "plot.svg", aggregate([*runs_of(["a"], ["fast"]), *with_budgets("a", [10.0, 2.5])]))
    root = ElementTree.parse(tmp_path / "plot.svg").getroot()
    words = ["".join(text.itertext()) for text in root.iter(f"{SVG}text")]
    assert [words.count(name) for name in ("a, fast", "a, fast, budgets")] == [1, 1]


def test_runs_without_error_or_view_leave_an_empty_plot(tmp_path: Path) -> None:
    draw(tmp_path / "plot.svg", aggregate([failed("a", "fast", "too dark")]))
    assert ElementTree.parse(tmp_path / "plot.svg").getroot().tag == f"{SVG}svg"
