"""The whole command with small stages in place of the real ones: what it runs, leaves and survives."""

import errno
import json
import subprocess
import sys
import textwrap
import time
from argparse import ArgumentParser, Namespace
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from backend import machine
from backend.benchmark import measuring, suites
from backend.benchmark.measuring import measuring_fingerprint
from backend.benchmark.suites import SUITES, Case, Suite
from backend.commands import benchmark as command
from backend.commands.cancelling import EXIT_CANCELLED, CancelRequest
from backend.commands.reconstruct import EXIT_FINE, EXIT_USER_ERROR
from backend.wire.client import ROOT
from tests.unit.test_install import is_alive

# The small stages of the end-to-end tests; they must get the photographs that the case gives, and no others.
PROGRAM = """
import sys
from backend.commands import reconstruct
from tests.end_to_end import fake_stages

any_photos = fake_stages.load_photos

def load_photos(sources, masks, config, *, progress):
    assert [path.name for path in sources] == ["0.png", "2.png", "4.png"]
    return any_photos(sources, masks, config, progress=progress)

load_photos.__annotations__ = any_photos.__annotations__
fake_stages.load_photos = load_photos
fake_stages.real_resolve = reconstruct.resolve
reconstruct.resolve = fake_stages.resolve_and_replace
sys.exit(fake_stages.main(sys.argv[4:]))
"""
CASE = Case(name="toy", folder="toy", given=(0, 2, 4), held_out=(1, 3))
LOST = Case(name="lost", folder="lost", given=(0, 1, 2))
pytestmark = pytest.mark.slow


def fake_program(trouble: str = "none") -> tuple[str, ...]:
    return (sys.executable, "-c", PROGRAM, trouble, "train", "0")


@pytest.fixture
def photos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of photo sets with five pictures whose alpha cuts out the middle, and cameras for them."""
    images = tmp_path / "photos" / "toy" / "images"
    images.mkdir(parents=True)
    pixels = np.zeros((24, 32, 4), np.uint8)
    pixels[6:18, 8:24] = 255
    pose = np.diag([1.0, -1.0, -1.0, 1.0]).tolist()
    frames = []
    for index in range(5):
        pixels[12, 16, 0] = index  # else they were copies
        Image.fromarray(pixels).save(images / f"{index}.png")
        frames.append({"file_path": f"images/{index}.png", "transform_matrix": pose})
    cameras = {"w": 32, "h": 24, "fl_x": 30.0, "fl_y": 30.0, "cx": 16.0, "cy": 12.0, "frames": frames}
    (images.parent / "transforms.json").write_text(json.dumps(cameras))
    toy = {"toy": Suite(name="toy", cases=(LOST, CASE))}
    monkeypatch.setattr(command, "SUITES", {**suites.SUITES, **toy})
    monkeypatch.setattr(command, "watch_signals", lambda *_: None)  # pytest's own Ctrl-C stays as it is
    monkeypatch.setenv("DONE_LOG", str(tmp_path / "done"))
    return tmp_path / "photos"


def parsed(photos: Path, output: Path, *more: str) -> Namespace:
    parser = ArgumentParser()
    command.add_benchmark(parser)
    words = ["toy", "--photos", str(photos), "--output", str(output), "--device", "cpu", *more]
    return parser.parse_args(words)


def test_everything_is_run_measured_and_written(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "out"
    words = parsed(photos, output, "--seeds", "2", "--presets", "fast")
    assert command.benchmark(words, program=fake_program()) == EXIT_FINE
    assert {path.name for path in output.iterdir()} == {"results.json", "table.md", "plot.svg", "runs"}
    results = json.loads((output / "results.json").read_text())
    assert results["missing"] == ["lost"]
    assert results["seeds"] == [0, 1]
    assert results["versions"]["torch"]
    assert results["machine"]["cores"] >= 1
    assert [(run["case"], run["preset"], run["seed"]) for run in results["runs"]] == [
        ("toy", "fast", 0),
        ("toy", "fast", 1),
    ]
    numbers = results["runs"][0]["numbers"]
    stages = ("photos_s", "cameras_s", "region_s", "stereo_s", "train_s", "mesh_s")
    assert numbers["total_s"] == pytest.approx(sum(numbers[name] for name in stages))
    assert numbers["after_cameras_s"] == pytest.approx(sum(numbers[name] for name in stages[2:]))
    assert numbers["wall_s"] > numbers["total_s"]
    assert numbers["peak_memory_bytes"] > 1e7
    assert 0.0 <= numbers["held_out_covered_share"] <= 1.0
    assert numbers["visible_chamfer_percent"] is None
    assert numbers["watertight"] in (0.0, 1.0)
    assert {run["device"] for run in results["runs"]} == {"cpu"}
    assert "| toy | fast |" in (output / "table.md").read_text()
    said = capsys.readouterr()
    assert "lost" in said.err
    assert said.out.strip() == str(output / "table.md")


def test_each_preset_is_run_with_each_budget_too(photos: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    words = parsed(photos, output, "--seeds", "1", "--presets", "fast", "--budgets", "10", "2.5")
    assert command.benchmark(words, program=fake_program()) == EXIT_FINE
    results = json.loads((output / "results.json").read_text())
    assert results["budgets_s"] == [2.5, 10.0]
    assert [(run["preset"], run["budget_s"]) for run in results["runs"]] == [
        ("fast", None),
        ("fast", 10.0),
        ("fast", 2.5),
    ]
    reports = [json.loads(path.read_text()) for path in sorted((output / "runs").glob("*/report.json"))]
    assert {report["settings"]["train.budget_s"] for report in reports} == {None, 10.0, 2.5}
    rows = (output / "table.md").read_text()
    assert all(f"| toy | {shown} |" in rows for shown in ("fast", "fast@10s", "fast@2.5s"))


def test_what_earlier_calls_asked_for_is_told_with_their_runs(photos: Path, tmp_path: Path) -> None:
    output, record = tmp_path / "out", tmp_path / "record"
    for words in (("--presets", "fast"), ("--presets", "balanced", "--only-budgets", "--budgets", "10")):
        asked = parsed(photos, output, "--seeds", "1", "--record", str(record), *words)
        assert command.benchmark(asked, program=fake_program()) == EXIT_FINE
    for path in (output / "results.json", record / "toy.json"):
        results = json.loads(path.read_text())
        assert sorted(results["presets"]) == ["balanced", "fast"]
        assert (results["budgets_s"], results["seeds"]) == ([10.0], [0])


def test_cases_can_be_chosen_and_those_of_before_stay(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    other = replace(CASE, name="other")
    monkeypatch.setattr(command, "SUITES", {**command.SUITES, "toy": Suite(name="toy", cases=(CASE, other))})
    output = tmp_path / "out"
    for name, expected in (("other", ["other"]), ("toy", ["toy", "other"])):
        words = parsed(photos, output, "--seeds", "1", "--presets", "fast", "--cases", name)
        assert command.benchmark(words, program=fake_program()) == EXIT_FINE
        results = json.loads((output / "results.json").read_text())
        assert [run["case"] for run in results["runs"]] == expected
    assert (
        command.benchmark(parsed(photos, output, "--cases", "toi"), program=fake_program()) == EXIT_USER_ERROR
    )
    assert "no case toi" in capsys.readouterr().err


def test_what_has_no_end_is_run_with_budgets_only(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "out"
    chosen = ("--seeds", "1", "--presets", "neus", "--only-budgets")
    assert command.benchmark(parsed(photos, output, *chosen), program=fake_program()) == EXIT_USER_ERROR
    assert "no budgets" in capsys.readouterr().err
    words = parsed(photos, output, *chosen, "--budgets", "10")
    assert command.benchmark(words, program=fake_program()) == EXIT_FINE
    runs = json.loads((output / "results.json").read_text())["runs"]
    assert [(run["preset"], run["budget_s"]) for run in runs] == [("neus", 10.0)]


@pytest.mark.parametrize("word", ["0", "-1", "nan", "inf", "long"])
def test_a_budget_is_a_positive_number(word: str, photos: Path, tmp_path: Path) -> None:
    with pytest.raises(SystemExit):
        parsed(photos, tmp_path / "out", "--budgets", "10", word)


def test_a_run_that_fails_is_told_and_the_next_goes_on(photos: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    words = parsed(photos, output, "--seeds", "1")
    assert command.benchmark(words, program=fake_program("memory")) == EXIT_FINE
    runs = json.loads((output / "results.json").read_text())["runs"]
    assert [run["preset"] for run in runs] == ["fast", "balanced"]
    assert all(run["numbers"] == {} and "memory" in run["failure"] for run in runs)


def test_held_out_views_without_cameras_are_told_and_the_rest_is_kept(photos: Path, tmp_path: Path) -> None:
    path = photos / "toy" / "transforms.json"
    cameras = json.loads(path.read_text())
    path.write_text(json.dumps({**cameras, "frames": cameras["frames"][::2]}))
    output = tmp_path / "out"
    words = parsed(photos, output, "--seeds", "1", "--presets", "fast")
    assert command.benchmark(words, program=fake_program()) == EXIT_FINE
    (run,) = json.loads((output / "results.json").read_text())["runs"]
    assert run["numbers"]["total_s"] > 0
    assert "held_out_psnr_db" not in run["numbers"]
    assert "camera" in run["failure"]


def test_a_folder_with_something_in_it_is_not_touched(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "out"
    output.mkdir()
    (output / "mine.txt").write_text("mine")
    assert command.benchmark(parsed(photos, output), program=fake_program()) == EXIT_USER_ERROR
    assert [path.name for path in output.iterdir()] == ["mine.txt"]
    assert "neither an empty folder" in capsys.readouterr().err


def test_what_another_suite_gave_is_not_replaced(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "out"
    words = parsed(photos, output, "--seeds", "1", "--presets", "fast")
    assert command.benchmark(words, program=fake_program()) == EXIT_FINE
    measured = (output / "results.json").read_bytes()
    monkeypatch.setattr(command, "SUITES", {**command.SUITES, "quick": Suite(name="quick", cases=(CASE,))})
    words.suite = "quick"
    assert command.benchmark(words, program=fake_program()) == EXIT_USER_ERROR
    assert "numbers of the suite toy" in capsys.readouterr().err
    assert (output / "results.json").read_bytes() == measured


@pytest.mark.parametrize("place", ["output", "record"])
def test_a_place_that_cannot_be_written_is_told_before_the_work(
    place: str, photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = parsed(photos, tmp_path / "out", "--seeds", "1", "--presets", "fast")
    (tmp_path / "file").write_text("mine")
    setattr(words, place, tmp_path / "file" / "within")
    assert command.benchmark(words, program=fake_program()) == EXIT_USER_ERROR
    assert "within cannot be written" in capsys.readouterr().err
    assert not (tmp_path / "done").exists()


def test_a_benchmark_that_was_killed_in_its_first_run_goes_on(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(_trial: object, output: Path, **_: object) -> None:
        output.mkdir(parents=True)
        raise SystemExit

    words = parsed(photos, tmp_path / "out", "--seeds", "1", "--presets", "fast")
    with monkeypatch.context() as patch:
        patch.setattr(measuring, "measure", killed)
        with pytest.raises(SystemExit):
            command.benchmark(words, program=fake_program())
    assert command.benchmark(words, program=fake_program()) == EXIT_FINE


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_a_polite_kill_ends_the_run_as_ctrl_c_does(tmp_path: Path) -> None:
    """The libraries that measuring loads take that signal for themselves."""
    folder = tmp_path / SUITES["photos"].cases[0].folder
    for name in ("image", "mask"):
        (folder / name).mkdir(parents=True)
        for index in range(3):
            Image.new("L", (8, 6)).save(folder / name / f"{index}.png")
    (folder / "transforms.json").write_text('{"frames": []}')
    words = ["--photos", tmp_path, "--seeds", "1", "--presets", "fast", "--output", tmp_path / "out"]
    program = [sys.executable, "-m", "backend", "benchmark", "photos", *words]
    with subprocess.Popen(program, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        while process.poll() is None and not (tmp_path / "out" / "results.json").exists():
            time.sleep(0.05)
        time.sleep(0.5)
        process.terminate()
        assert process.stderr is not None
        assert "Stopped; what was measured" in process.stderr.read()
    assert process.returncode == EXIT_CANCELLED


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_a_benchmark_that_is_killed_leaves_no_run_behind(photos: Path, tmp_path: Path) -> None:
    number = tmp_path / "number"
    told = f"import os, pathlib; pathlib.Path({str(number)!r}).write_text(str(os.getpid()))"
    program = (sys.executable, "-c", f"{told}\n{PROGRAM}", "hang", "train", "0")
    code = f"""
        from pathlib import Path
        from backend.benchmark.measuring import Trial, measure
        from backend.commands.cancelling import CancelRequest
        from tests.unit.test_benchmark_run import CASE

        folder, out = Path({str(photos / "toy")!r}), Path({str(tmp_path / "out")!r})
        trial = Trial(case=CASE, folder=folder, preset="fast", seed=0, device="cpu")
        measure(trial, out, inputs="", program={program!r}, request=CancelRequest())
    """
    with subprocess.Popen([sys.executable, "-c", textwrap.dedent(code)], cwd=ROOT) as benchmark:
        deadline = time.monotonic() + 60
        done = tmp_path / "done"
        while not (done.exists() and "train" in done.read_text()):
            assert benchmark.poll() is None
            assert time.monotonic() < deadline, "the run never began"
            time.sleep(0.05)
        benchmark.kill()
    run = int(number.read_text())
    deadline = time.monotonic() + 10  # the promise is 2 s; the machine of the tests may be busy
    while is_alive(run):
        assert time.monotonic() < deadline, "the run outlives its benchmark"
        time.sleep(0.05)


def test_a_failed_write_loses_no_numbers(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a full disk: what was measured is still there."""
    output = tmp_path / "out"
    words = parsed(photos, output, "--seeds", "1", "--presets", "fast")
    assert command.benchmark(words, program=fake_program()) == EXIT_FINE
    measured, write = (output / "results.json").read_bytes(), Path.write_text

    def full(path: Path, text: str, **options: str) -> int:
        write(path, text[:10], **options)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    assert command.benchmark(words, program=fake_program()) == EXIT_USER_ERROR
    assert (output / "results.json").read_bytes() == measured


def test_a_benchmark_goes_on_where_it_was(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is known is not measured again, whatever is asked for, until something it depends on changes."""
    output = tmp_path / "out"
    first = parsed(photos, output, "--seeds", "1", "--presets", "fast")
    assert command.benchmark(first, program=fake_program()) == EXIT_FINE
    (fast,) = json.loads((output / "results.json").read_text())["runs"]
    second = parsed(photos, output, "--seeds", "1", "--presets", "balanced")
    assert command.benchmark(second, program=fake_program()) == EXIT_FINE
    runs = json.loads((output / "results.json").read_text())["runs"]
    assert [run["preset"] for run in runs] == ["balanced", "fast"]
    assert runs[1] == fast
    assert not (tmp_path / "record").exists()
    third = parsed(photos, output, "--seeds", "1", "--presets", "fast", "--record", str(tmp_path / "record"))
    assert command.benchmark(third, program=("none",)) == EXIT_FINE
    record = json.loads((tmp_path / "record" / "toy.json").read_text())
    assert record["code"] == measuring_fingerprint()
    assert [run["preset"] for run in record["runs"]] == ["fast", "balanced"]
    assert str(tmp_path) not in (tmp_path / "record" / "toy.json").read_text()
    assert "Kept from before" in capsys.readouterr().err
    Image.new("RGBA", (32, 24)).save(photos / "toy" / "images" / "0.png")
    assert command.benchmark(first, program=fake_program()) == EXIT_FINE
    (again,) = json.loads((output / "results.json").read_text())["runs"]
    assert again["inputs"] != fast["inputs"]


def test_what_another_device_gave_stays(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "out"
    words = parsed(photos, output, "--seeds", "1", "--presets", "fast")
    assert command.benchmark(words, program=fake_program()) == EXIT_FINE
    monkeypatch.setattr(machine, "choose_device", lambda _kind: torch.device("meta"))
    assert command.benchmark(words, program=fake_program()) == EXIT_FINE
    runs = json.loads((output / "results.json").read_text())["runs"]
    assert [(run["device"], bool(run["numbers"])) for run in runs] == [("meta", False), ("cpu", True)]


def test_a_stop_ends_the_run_and_says_so(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop_at_once(request: CancelRequest, _on_first: object) -> None:
        request.ask()

    monkeypatch.setattr(command, "watch_signals", stop_at_once)
    assert command.benchmark(parsed(photos, tmp_path / "out"), program=fake_program()) == EXIT_CANCELLED
    assert "Stopped" in capsys.readouterr().err
    assert not (tmp_path / "done").exists()


def test_nothing_to_measure_is_told_with_a_remedy(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    nowhere = parsed(tmp_path / "nowhere", tmp_path / "out")
    assert command.benchmark(nowhere, program=fake_program()) == EXIT_USER_ERROR
    assert not (tmp_path / "out").exists()
    assert "make benchmark" in capsys.readouterr().err
