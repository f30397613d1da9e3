"""Variants differ from the default in one part; a run on a small scene measures each of them."""

import json
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from backend.benchmark import ablation
from backend.benchmark.ablation import COLUMNS, PRESET, VARIANTS, Variant, is_random, measure_variants
from backend.benchmark.measuring import Measurement
from backend.benchmark.one_by_one import place
from backend.benchmark.suites import CASES, SUITES, Case
from backend.benchmark.summary import aggregate, table
from backend.presets import PRESETS, Settings
from backend.stages.photos import PhotosConfig
from backend.stages.report import ReportConfig, flat_settings
from backend.stages.train import TrainConfig
from benchmarks import ablation as command
from tests.synthetic_scene import photographed, ring_cameras, write_scene

DEFAULT = PRESETS[PRESET]
CASE = Case(
    name="toy", folder="toy", given=tuple(range(4)), cameras="images/transforms.json", truth="truth.ply"
)
SMALL = Settings(
    photos=PhotosConfig(max_side_px=96),
    train=TrainConfig(levels=(24, 32), rounds=(3, 3), steps=(0, 3)),
    report=ReportConfig(error_samples=5000),
)
QUICK = (
    Variant(name="as it is"),
    Variant(name="without rendering", setting="train.steps", value=(0, 0)),
    Variant(name="blind", setting="stereo.min_correlation", value=1.0),
)


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: variant.name)
def test_a_variant_changes_one_part(variant: Variant) -> None:
    before, after = dict(flat_settings(DEFAULT)), dict(flat_settings(variant.of(DEFAULT)))
    changed = [name for name in before if before[name] != after[name]]
    changed += [] if variant.with_masks else ["masks"]
    assert len(changed) == (0 if variant.name == "as it is" else 1)
    assert changed in ([], ["masks"], [variant.setting])


@pytest.mark.parametrize("variant", [v for v in VARIANTS if v.setting], ids=lambda variant: variant.name)
def test_a_changed_setting_is_what_the_stage_expects(variant: Variant) -> None:
    assert variant.setting is not None
    before: object = DEFAULT
    for name in variant.setting.split("."):
        before = getattr(before, name)
    assert type(variant.value) is type(before)
    if isinstance(before, tuple):
        assert isinstance(variant.value, tuple)
        assert len(variant.value) == len(before)


def test_variants_have_names_of_their_own_and_begin_with_the_default() -> None:
    assert len({variant.name for variant in VARIANTS}) == len(VARIANTS)
    assert VARIANTS[0].of(DEFAULT) == DEFAULT
    assert VARIANTS[0].with_masks


@pytest.mark.parametrize("name", ["stereo.growth", "stero.growth_rounds", "train.linear"])
def test_a_setting_that_is_not_there_is_refused(name: str) -> None:
    variant = Variant(name="misspelt", setting=f"{name}.more" if name == "train.linear" else name)
    with pytest.raises((AttributeError, TypeError)):
        variant.of(DEFAULT)


def test_only_rendering_is_random() -> None:
    drawn = {variant.name for variant in VARIANTS if is_random(variant.of(DEFAULT))}
    assert drawn == {"with 100 steps of rendering"}


def test_every_case_of_every_suite_is_known_by_its_name() -> None:
    assert all(CASES[case.name] == case for suite in SUITES.values() for case in suite.cases)


@cache
def toy(folder: Path) -> Path:
    write_scene(photographed(ring_cameras(8, 96)), folder)
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Measurement]:
    """All quick variants, with two seeds."""
    folder = toy(tmp_path_factory.mktemp("toy") / "scene")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ablation, "PRESETS", {PRESET: SMALL})
        device = torch.device("cpu")
        return list(measure_variants(CASE, folder, QUICK, num_seeds=2, device=device))


def test_each_variant_is_run_once_or_as_often_as_there_are_seeds(runs: list[Measurement]) -> None:
    expected = [("as it is", 0), ("as it is", 1), ("without rendering", 0)]
    assert [(run.preset, run.seed) for run in runs if run.failure is None] == expected


def test_what_finds_nothing_is_told_and_ends_nothing(runs: list[Measurement]) -> None:
    blind = [run for run in runs if run.preset == "blind"]
    assert [run.seed for run in blind] == [0, 1]
    for run in blind:
        assert run.numbers == {}
        assert run.failure is not None
        assert "agree on only" in run.failure


def test_stereo_is_done_once_for_what_does_not_change_it(runs: list[Measurement]) -> None:
    done = [run.numbers["stereo_s"] for run in runs if run.failure is None]
    assert done[0] is not None
    assert done[1:] == [None] * (len(done) - 1)


def test_what_is_changed_reaches_the_surface(runs: list[Measurement]) -> None:
    first = {
        run.preset: run.numbers["whole_chamfer_percent"] for run in runs if run.seed == 0 and run.numbers
    }
    assert len(set(first.values())) == len(first) == 2


def test_errors_are_those_of_a_surface_near_the_truth(runs: list[Measurement]) -> None:
    visible = runs[0].numbers["visible_chamfer_percent"]
    assert visible is not None
    assert 0.1 < visible < 2.0


def test_the_table_has_a_row_for_each_variant(runs: list[Measurement]) -> None:
    lines = table(aggregate(runs), COLUMNS, compared="variant").splitlines()
    assert lines[0].startswith("| case | variant | visible Chamfer % |")
    assert [line.split("|")[2].strip() for line in lines[2:]] == [variant.name for variant in QUICK]
    assert " ± " in lines[2]
    assert " ± " not in lines[3]
    assert lines[4].split("|")[3].strip() == "failed"


def test_without_masks_the_photographs_and_the_region_stay(tmp_path: Path) -> None:
    placed = place(CASE, toy(tmp_path / "scene"), (0, 2), SMALL)
    bare = placed.without_masks()
    assert all(view.mask is not None for view in placed.views)
    assert all(view.mask is None for view in bare.views)
    assert bare.region is placed.region
    for before, after in zip(placed.views, bare.views, strict=True):
        np.testing.assert_array_equal(before.image_srgb, after.image_srgb)


def test_the_command_leaves_what_was_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, runs: list[Measurement]
) -> None:
    toy(tmp_path / "toy")
    monkeypatch.setattr(command, "CASES", {"toy": CASE})
    monkeypatch.setattr(command, "set_up_torch", lambda _: None)  # it would last beyond this test
    monkeypatch.setattr(command, "measure_variants", lambda *_, **__: iter(runs))
    words = ["--cases", "toy", "--photos", str(tmp_path), "--output", str(tmp_path / "out")]
    monkeypatch.setattr(sys, "argv", ["ablation", *words])
    assert command.main() == 0
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert [run["preset"] for run in results["runs"]] == [run.preset for run in runs]
    text = (tmp_path / "out" / "table.md").read_text()
    assert text.startswith(table(aggregate(runs), COLUMNS, compared="variant"))
    assert "- toy, blind: The photographs agree on only" in text


def test_the_command_refuses_cases_whose_files_are_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        sys, "argv", ["ablation", "--scenes", str(tmp_path), "--output", str(tmp_path / "out")]
    )
    with pytest.raises(SystemExit, match="2"):
        command.main()
    assert "files are missing of monkey_3, plaster_6" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
