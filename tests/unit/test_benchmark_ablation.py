"""Variants differ from the default in one part; a run on a small scene measures each of them."""

import json
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh

from backend.benchmark import ablation, variants
from backend.benchmark.ablation import COLUMNS, errors_of, inputs_of, is_random, measure_variants
from backend.benchmark.measuring import Measurement
from backend.benchmark.one_by_one import place
from backend.benchmark.suites import CASES, SUITES, Case
from backend.benchmark.summary import aggregate, table
from backend.benchmark.variants import VARIANTS, Variant
from backend.presets import PRESETS, Settings
from backend.scene import SurfaceMesh
from backend.stages.photos import PhotosConfig
from backend.stages.report import ReportConfig, flat_settings
from backend.stages.train.surface_fit import TrainConfig
from benchmarks import ablation as command
from tests.synthetic_scene import photographed, ring_cameras, write_scene

CASE = Case(
    name="toy",
    folder="toy",
    given=tuple(range(4)),
    held_out=(5, 7),
    cameras="images/transforms.json",
    truth="truth.ply",
)
SMALL = Settings(
    photos=PhotosConfig(max_side_px=96),
    train=TrainConfig(levels=(24, 32), rounds=(3, 3), steps=(0, 3)),
    report=ReportConfig(error_samples=5000),
)
QUICK = (
    Variant(name="as it is"),
    Variant(name="without rendering", changes={"train.steps": (0, 0)}),
    Variant(name="few faces", changes={"train.steps": (0, 0), "mesh.max_faces": 500}),
    Variant(name="blind", changes={"stereo.min_correlation": 1.0}, with_masks=False),
)


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: variant.name)
def test_a_variant_changes_what_it_names(variant: Variant) -> None:
    before, after = dict(flat_settings(PRESETS[variant.preset])), dict(flat_settings(variant.settings))
    assert {name for name in before if before[name] != after[name]} == set(variant.changes)


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: variant.name)
def test_a_changed_setting_is_what_the_stage_expects(variant: Variant) -> None:
    for name, value in variant.changes.items():
        before: object = PRESETS[variant.preset]
        for part in name.split("."):
            before = getattr(before, part)
        assert type(value) is type(before) or None in (value, before)


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: variant.name)
def test_every_level_has_its_rounds_and_steps(variant: Variant) -> None:
    train = variant.settings.train
    if isinstance(train, TrainConfig):
        assert len(train.levels) == len(train.rounds) == len(train.steps)


def test_variants_have_names_of_their_own_and_begin_with_their_preset() -> None:
    assert len({variant.name for variant in VARIANTS}) == len(VARIANTS)
    first = {variant.preset: variant for variant in reversed(VARIANTS)}
    assert set(first) == {"balanced", "fast", "sparsecraft"}
    for preset, variant in first.items():
        assert set(variant.changes) == ({"train.steps"} if preset == "sparsecraft" else set())
    shorter = {v.name: v.changes["train.steps"] for v in VARIANTS if v.preset == "sparsecraft"}
    assert set(shorter.values()) == {400}


def test_variants_differ_in_more_than_their_names() -> None:
    parts = [(v.settings, v.with_masks, v.cameras_doubted) for v in VARIANTS]
    assert len(set(parts)) == len(parts)


@pytest.mark.parametrize("name", ["stereo.growth", "stero.growth_rounds", "train.linear.more"])
def test_a_setting_that_is_not_there_is_refused(name: str) -> None:
    with pytest.raises((AttributeError, TypeError)):
        _ = Variant(name="misspelt", changes={name: None}).settings


def test_only_rendering_is_random() -> None:
    drawn = {variant.name for variant in VARIANTS if is_random(variant.settings)}
    assert drawn == {v.name for v in VARIANTS if v.preset == "sparsecraft" or "100 steps" in v.name}


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
        patch.setattr(variants, "PRESETS", {"balanced": SMALL})
        patch.setattr(ablation, "set_up_torch", lambda _: None)  # it would last beyond this test
        return list(measure_variants(CASE, folder, QUICK, num_seeds=2, device="cpu", done={}))


def test_each_variant_is_run_once_or_as_often_as_there_are_seeds(runs: list[Measurement]) -> None:
    expected = [("as it is", 0), ("as it is", 1), ("without rendering", 0), ("few faces", 0)]
    assert [(run.preset, run.seed) for run in runs if run.failure is None] == expected


def test_what_finds_nothing_is_told_and_ends_nothing(runs: list[Measurement]) -> None:
    blind = [run for run in runs if run.preset == "blind"]
    assert [run.seed for run in blind] == [0, 1]
    for run in blind:
        assert run.numbers == {}
        assert run.failure is not None
        assert "agree on only" in run.failure


def test_what_a_variant_does_not_change_is_done_once(runs: list[Measurement]) -> None:
    """Two runs of it would hardly take the same time to the last digit."""
    first, again, without, few = [run.numbers for run in runs if run.failure is None]
    assert first["stereo_s"] == again["stereo_s"] == without["stereo_s"]
    assert without["train_s"] == few["train_s"]
    assert len({numbers["train_s"] for numbers in (first, again, without)}) == 3
    assert len({numbers["mesh_s"] for numbers in (first, again, without, few)}) == 4


def test_surroundings_that_are_true_are_no_error(tmp_path: Path) -> None:
    """As in the other benchmarks: what is measured is the subject alone."""
    ball = trimesh.creation.icosphere(3)
    floor = trimesh.creation.box((6.0, 6.0, 0.2)).subdivide().subdivide().subdivide()
    floor.apply_translation((0.0, 0.0, -1.6))
    ball.export(tmp_path / "truth.ply")
    floor.export(tmp_path / "floor.ply")
    joined = trimesh.util.concatenate((ball, floor))
    count = len(joined.vertices)
    mesh = SurfaceMesh(
        vertices=np.asarray(joined.vertices),
        faces=np.asarray(joined.faces, np.int64),
        normals=np.asarray(joined.vertex_normals, np.float32),
        colours_srgb=np.zeros((count, 3), np.uint8),
        support=np.ones(count, np.float32),
    )
    case = replace(CASE, held_out=(), surroundings="floor.ply")
    numbers = errors_of(case, tmp_path, mesh, (), seed=0, num_samples=5000)
    assert numbers["whole_chamfer_percent"] == pytest.approx(0.8, abs=0.4)  # of 5000 samples beside 5000
    alone = errors_of(replace(case, surroundings=None), tmp_path, mesh, (), seed=0, num_samples=5000)
    assert alone["whole_chamfer_percent"] > 5


def test_a_run_tells_what_it_cost(runs: list[Measurement]) -> None:
    for run in runs:
        if run.failure is None:
            assert run.device == "cpu"
            assert min(run.numbers[f"{stage}_processor_s"] for stage in ("stereo", "train", "mesh")) > 0
            assert run.numbers["peak_memory_bytes"] > 1e8
            assert 10 < run.numbers["held_out_psnr_db"] < 60


def test_what_was_done_before_is_not_done_again(
    runs: list[Measurement], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(variants, "PRESETS", {"balanced": SMALL})
    done = {(run.preset, run.seed): run for run in runs}

    def never(*_: object) -> tuple[Measurement, ablation.Known]:
        raise AssertionError

    folder = Path("nowhere")
    again = measure_variants(CASE, folder, QUICK, num_seeds=2, device="cpu", done=done, alone=never)
    assert list(again) == runs


def test_inputs_change_with_the_variant_and_the_case_s_files(tmp_path: Path) -> None:
    folder = toy(tmp_path / "scene")
    first = inputs_of(CASE, folder, VARIANTS[0], "cpu", {})
    assert inputs_of(CASE, folder, VARIANTS[0], "cpu", {}) == first
    others = {inputs_of(CASE, folder, variant, "cpu", {}) for variant in VARIANTS[1:]}
    assert len(others | {first}) == len(VARIANTS)
    (folder / "truth.ply").write_bytes((folder / "truth.ply").read_bytes() + b" ")
    assert inputs_of(CASE, folder, VARIANTS[0], "cpu", {}) != first


def test_what_is_changed_reaches_the_surface(runs: list[Measurement]) -> None:
    first = {
        run.preset: run.numbers["whole_chamfer_percent"] for run in runs if run.seed == 0 and run.numbers
    }
    assert len(set(first.values())) == len(first) == 3


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
    assert lines[5].split("|")[3].strip() == "failed"


def test_without_masks_the_photographs_and_the_region_stay(tmp_path: Path) -> None:
    placed = place(CASE, toy(tmp_path / "scene"), (0, 2), SMALL)
    bare = placed.without_masks()
    assert all(view.mask is not None for view in placed.views)
    assert all(view.mask is None for view in bare.views)
    assert bare.region is placed.region
    assert placed.with_doubted_cameras().views == placed.views
    assert placed.with_doubted_cameras().solved.estimated
    for before, after in zip(placed.views, bare.views, strict=True):
        np.testing.assert_array_equal(before.image_srgb, after.image_srgb)


def test_the_command_leaves_what_was_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, runs: list[Measurement]
) -> None:
    toy(tmp_path / "toy")
    asked: list[dict[tuple[str, int], Measurement]] = []

    def measured(*_: object, done: dict[tuple[str, int], Measurement], **__: object) -> list[Measurement]:
        asked.append(done)
        return runs

    monkeypatch.setattr(command, "CASES", {"toy": CASE})
    monkeypatch.setattr(command, "_NAMES", {variant.name: variant for variant in QUICK})
    monkeypatch.setattr(command, "measure_variants", measured)
    words = ["--cases", "toy", "--photos", str(tmp_path), "--output", str(tmp_path / "out")]
    names = [variant.name for variant in QUICK]
    monkeypatch.setattr(sys, "argv", ["ablation", *words, "--variants", *names])
    assert command.main() == 0
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert [run["preset"] for run in results["runs"]] == [run.preset for run in runs]
    assert not (tmp_path / "record").exists()
    monkeypatch.setattr(sys, "argv", [*sys.argv, "--record", str(tmp_path / "record")])
    assert command.main() == 0  # what failed is tried again
    assert asked[0] == {}
    record = json.loads((tmp_path / "record" / "ablation.json").read_text())
    assert [run["preset"] for run in record["runs"]] == [run.preset for run in runs]
    assert "| toy | few faces |" in (tmp_path / "record" / "ablation.md").read_text()
    assert set(asked[1]) == {(run.preset, run.seed) for run in runs if run.failure is None}
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
