"""The same again: in which folder a job goes on, which cameras it takes, and what can be brought back."""

import importlib
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

bpy = pytest.importorskip("bpy", reason="needs Blender's Python, where `import bpy` works")

pytestmark = pytest.mark.blender

Part = Callable[[str], ModuleType]


@pytest.fixture
def asked(part: Part, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Path]:
    """Paths of the jobs that the backend was asked for, each of which it answers with a failure."""
    paths: list[Path] = []
    monkeypatch.setenv("FEWVIEW_PYTHON", sys.executable)
    monkeypatch.setattr(part("environment"), "_known", {})
    for name in ("operators.reconstruct", "operators.cameras"):
        backend_command = part(name).backend_command

        def rehearse(python: Path, _verb: str, job: str, original: Any = backend_command) -> Any:
            paths.append(Path(job))
            return original(python, "rehearse", "--seconds", "0", "--end", "failed")

        monkeypatch.setattr(part(name), "backend_command", rehearse)
    bpy.context.scene.fewview.output = str(tmp_path / "jobs")
    return paths


def photographs(folder: Path, *names: str) -> list[Path]:
    """Files that look like photographs, on the list of the panel."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")
        image = bpy.context.scene.fewview.images.add()
        image.name, image.path = Path(name).name, str(folder / name)
    return [folder / name for name in names]


def press(operator: Any) -> None:
    with pytest.raises(RuntimeError, match="rehearsal of a computer"):
        operator()


def estimated(part: Part, folder: Path, images: list[Path], *, unplaced: int = 0) -> Path:
    """The folder of a job that has found cameras."""
    module = importlib.import_module(
        f"{part('jobs').__package__.rpartition('.')[0]}.backend.wire.photographs"
    )
    rehearsed = importlib.import_module(
        module.__name__.replace("wire.photographs", "commands.rehearsed_files")
    )
    (folder / "result").mkdir(parents=True)
    rehearsed.write_cameras(folder / "result/cameras.json")
    content = json.loads((folder / "result/cameras.json").read_text())
    names = module.names_of(images)
    content["frames"] = [{**content["frames"][0], "file_path": name} for name in names[unplaced:]]
    content["fewview"]["unplaced"] = [{"name": name, "why": "It is dark"} for name in names[:unplaced]]
    (folder / "result/cameras.json").write_text(json.dumps(content))
    jobs = part("job_folder")
    jobs.write_job(
        folder,
        jobs.Job(protocol=1, images=tuple(map(str, images)), output="result", until="cameras"),
    )
    return folder


# Going on.


@pytest.mark.parametrize("operator", ["reconstruct", "estimate_cameras"])
def test_a_job_that_failed_goes_on_in_its_folder(asked: list[Path], tmp_path: Path, operator: str) -> None:
    settings = bpy.context.scene.fewview
    photographs(tmp_path, "a.png", "b.png", "c.png")
    again = getattr(bpy.ops.fewview, operator)
    press(again)
    press(again)
    assert [path.parent.name for path in asked] == ["reconstruct-001"] * 2
    settings.seed = 5
    press(again)
    settings.images[2].use = False
    press(again)
    assert [path.parent.name for path in asked[2:]] == ["reconstruct-002", "reconstruct-003"]
    settings.seed = 0
    settings.images[2].use = True
    press(again)
    assert asked[-1] == asked[0]
    result = "mesh.ply" if operator == "reconstruct" else "cameras.json"
    (asked[0].parent / "result").mkdir()
    (asked[0].parent / "result" / result).write_bytes(b"")
    press(again)
    assert asked[-1].parent.name == "reconstruct-004"  # what is finished is not done over


def test_finished_stages_are_not_kept_by_blender(asked: list[Path], tmp_path: Path) -> None:
    photographs(tmp_path, "a.png", "b.png")
    for operator in (bpy.ops.fewview.reconstruct, bpy.ops.fewview.estimate_cameras):
        press(operator)
        assert json.loads(asked[-1].read_text())["keep_stages"] is False


def test_a_damaged_job_is_left_alone(asked: list[Path], tmp_path: Path) -> None:
    photographs(tmp_path, "a.png", "b.png")
    press(bpy.ops.fewview.reconstruct)
    asked[0].write_text("{")
    press(bpy.ops.fewview.reconstruct)
    assert asked[1].parent.name == "reconstruct-002"
    assert asked[0].read_text() == "{"


# Which cameras.


def cameras_of_job(path: Path) -> str | None:
    return json.loads(path.read_text())["cameras"]


def test_equal_names_in_two_folders_keep_their_cameras(asked: list[Path], part: Part, tmp_path: Path) -> None:
    images = photographs(tmp_path, "left/1.png", "right/1.png", "right/2.png")
    folder = estimated(part, tmp_path / "jobs" / "reconstruct-001", images)
    bpy.context.scene.fewview.cameras_job = str(folder)
    press(bpy.ops.fewview.reconstruct)
    bpy.context.scene.fewview.images[1].use = False  # now one is called so
    press(bpy.ops.fewview.reconstruct)
    assert [cameras_of_job(path) for path in asked] == [str(folder / "result" / "cameras.json")] * 2


def test_other_photographs_of_the_same_names_get_cameras_of_their_own(
    asked: list[Path], part: Part, tmp_path: Path
) -> None:
    images = photographs(tmp_path / "monday", "1.png", "2.png")
    folder = estimated(part, tmp_path / "jobs" / "reconstruct-001", images)
    settings = bpy.context.scene.fewview
    settings.cameras_job = str(folder)
    settings.images.clear()
    photographs(tmp_path / "tuesday", "1.png", "2.png")
    press(bpy.ops.fewview.reconstruct)
    assert cameras_of_job(asked[0]) is None


def test_cameras_without_their_job_are_found_again(asked: list[Path], part: Part, tmp_path: Path) -> None:
    images = photographs(tmp_path, "1.png", "2.png")
    folder = estimated(part, tmp_path / "jobs" / "reconstruct-001", images)
    bpy.context.scene.fewview.cameras_job = str(folder)
    (folder / "job.json").unlink()
    press(bpy.ops.fewview.reconstruct)
    assert cameras_of_job(asked[0]) is None


def test_the_camera_of_each_of_two_equal_names(part: Part, tmp_path: Path) -> None:
    images = photographs(tmp_path, "left/1.png", "right/1.png", "dark/1.png", "right/2.png")
    folder = estimated(
        part, tmp_path / "jobs" / "reconstruct-001", [images[2], *images[:2], images[3]], unplaced=1
    )
    bpy.ops.fewview.import_cameras(folder=str(folder))
    settings, scene = bpy.context.scene.fewview, bpy.context.scene
    assert [image.problem for image in settings.images] == ["", "", "It is dark", ""]
    for index, name in ((0, "left/1.png"), (1, "right/1.png"), (3, "2.png")):
        settings.active_image = index
        assert bpy.ops.fewview.show_photograph() == {"FINISHED"}
        assert scene.camera["fewview_photo"] == name
    assert bpy.ops.fewview.show_photograph(photograph="right/1.png") == {"FINISHED"}
    assert scene.camera["fewview_photo"] == "right/1.png"
    with pytest.raises(RuntimeError, match="Several photographs are called"):
        bpy.ops.fewview.show_photograph(photograph="1.png")
    settings.active_image = 2
    with pytest.raises(RuntimeError, match=r"1\.png has no camera"):
        bpy.ops.fewview.show_photograph()


# What the command line made.


def rehearsed(part: Part, folder: Path, *, left_out: tuple[str, ...] = ()) -> Path:
    """The output folder of a command."""
    package = part("jobs").__package__.rpartition(".")[0]
    files = importlib.import_module(f"{package}.backend.commands.rehearsed_files").RESULTS
    folder.mkdir(parents=True)
    for name, write in files.items():
        if name not in left_out:
            write(folder / name)
    return folder


def test_what_the_command_line_made_comes_in(part: Part, tmp_path: Path) -> None:
    folder = rehearsed(part, tmp_path / "RESULT")
    assert bpy.ops.fewview.import_result(folder=str(folder)) == {"FINISHED"}
    result = bpy.context.scene.fewview.result
    roots = [made for made in bpy.context.scene.objects if made.get("fewview_role") == "root"]
    assert len([made for made in bpy.context.scene.objects if made.type == "CAMERA"]) == 3
    assert result.parent == roots[0]
    frames = part("frames")
    placed = frames.world_from_result(result, folder)
    assert abs(placed - part("camera_objects").world_from_solved(roots[0])).max() < 1e-6
    assert part("job_folder").can_be_rendered(folder)
    assert part("result_numbers").result_lines(folder)
    assert bpy.ops.fewview.import_result(folder=str(folder), cameras=False) == {"FINISHED"}


def test_points_that_the_command_line_fitted_come_in(part: Part, tmp_path: Path) -> None:
    folder = rehearsed(part, tmp_path / "fit", left_out=("cameras.json", "sparse.ply", "report.html"))
    assert bpy.ops.fewview.import_result(folder=str(folder)) == {"FINISHED"}
    assert not [made for made in bpy.context.scene.objects if made.type == "CAMERA"]


def test_past_jobs_are_of_every_kind(part: Part, tmp_path: Path) -> None:
    folders = part("job_folder")
    made = [rehearsed(part, tmp_path / "RESULT"), rehearsed(part, tmp_path / "points-001" / "result").parent]
    (made[1] / "cloud.ply").touch()
    made.append(rehearsed(part, tmp_path / "reconstruct-001" / "result").parent)
    images = ("a.png", "b.png")
    folders.write_job(made[2], folders.Job(protocol=1, images=images, output="result", preset="fast"))
    rehearsed(part, tmp_path / "somebody", left_out=("report.json",))
    for age, folder in enumerate(made):
        os.utime(folders.results_in(folder) / "mesh.ply", (2e9 - age, 2e9 - age))
    found = list(folders.past_jobs(tmp_path))
    assert [job.folder for job in found] == made
    assert [job.words for job in found] == [
        "RESULT: from the command line",
        "points-001: points",
        "reconstruct-001: fast, 2 images",
    ]
    assert [job.of_points for job in found] == [False, True, False]
    # The inner folder of a job is the job.
    assert folders.read_job(made[2] / "result").folder == made[2]


def test_past_jobs_are_read_as_they_are_asked_for(
    part: Part, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The panel shows few of them, and is drawn ten times a second while a job runs."""
    folders = part("job_folder")
    for number in range(4):
        rehearsed(part, tmp_path / f"RESULT-{number}")
        (tmp_path / f"{number}.jpg").touch()
    looked_at: list[Path] = []
    read_job = folders.read_job
    monkeypatch.setattr(folders, "read_job", lambda folder: looked_at.append(folder) or read_job(folder))
    assert next(folders.past_jobs(tmp_path)).folder == looked_at[0]
    assert len(looked_at) == 1
    assert len(list(folders.past_jobs(tmp_path))) == 4


@pytest.mark.parametrize("earlier_job", [True, False])
def test_a_job_given_estimated_cameras_lies_with_its_own(
    part: Part, tmp_path: Path, earlier_job: bool
) -> None:
    """Those of an earlier job of Blender place it; those of the command line get a place of their own."""
    folders = part("job_folder")
    source = rehearsed(part, tmp_path / ("reconstruct-001/result" if earlier_job else "RESULT"))
    if earlier_job:
        folders.write_job(source.parent, folders.Job(protocol=1, images=(), output="result"))
        bpy.ops.fewview.import_cameras(folder=str(source.parent))
    later = rehearsed(part, tmp_path / "reconstruct-002" / "result").parent
    cameras = str(source / "cameras.json")
    folders.write_job(later, folders.Job(protocol=1, images=(), output="result", cameras=cameras))
    bpy.ops.fewview.import_result(folder=str(later))
    roots = [made for made in bpy.context.scene.objects if made.get("fewview_role") == "root"]
    assert [root["fewview_job"] for root in roots] == [str(source.parent if earlier_job else later)]
    result = bpy.context.scene.fewview.result
    expected = part("camera_objects").world_from_solved(roots[0])
    assert abs(part("frames").world_from_result(result, later) - expected).max() < 1e-6
