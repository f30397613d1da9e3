"""What the README promises of Blender: its examples run, its commands end as it says, its buttons exist."""

import importlib
import json
import os
import re
import shlex
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

bpy = pytest.importorskip("bpy", reason="needs Blender's Python, where `import bpy` works")

pytestmark = pytest.mark.blender

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
SECTION = README[README.index("## In Blender") : README.index("## How it works")]
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```$", SECTION, flags=re.MULTILINE | re.DOTALL)
PYTHON_EXAMPLES = [text for language, text in BLOCKS if language == "python"]
COMMANDS = re.findall(r"^blender .*--command fewview (.+)$", SECTION, flags=re.MULTILINE)
FILES = re.findall(r"\]\(((?!http)[^)#]+)\)", README)
SMALL = {"resolution_x": 64, "resolution_y": 48, "samples": 1}
"""For the settings of the scene, from which examples take what they leave out."""


@pytest.fixture
def parts(addon: ModuleType, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ModuleType]:
    """The installed add-on's modules by name; this Python is taken for the backend's."""

    def part(name: str) -> ModuleType:
        return importlib.import_module(f"{addon.__name__}.{name}")

    monkeypatch.setenv("FEWVIEW_PYTHON", sys.executable)
    monkeypatch.setattr(part("environment"), "_known", {})
    monkeypatch.setattr(part("environment"), "_ready_text", lambda _: "ready to rehearse")
    return part


@pytest.fixture
def rehearsed(
    parts: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Callable[..., None]:
    """In place of the backend its rehearsal, in a folder with photographs and a scene with an object.

    Call it with how the rehearsal shall end, unless it shall end well.
    """
    command = importlib.import_module(f"{parts('jobs').__package__.rpartition('.')[0]}.backend.wire.client")

    def rehearse(end: str = "finished") -> None:
        def rehearsal(python: Path, _: str, job: str) -> tuple[str, ...]:
            output = ("--output", str(Path(job).parent / "result"))
            return command.backend_command(python, "rehearse", "--seconds", "0", "--end", end, *output)

        def check(python: Path) -> tuple[str, ...]:
            return command.backend_command(python, "rehearse", "--seconds", "0", "--end", end)

        monkeypatch.setattr(parts("operators.reconstruct"), "backend_command", rehearsal)
        monkeypatch.setattr(parts("environment"), "doctor_command", check)

    rehearse()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").mkdir()
    for name in ("a.png", "b.png", "c.png"):
        (tmp_path / "photos" / name).write_bytes(b"")
    bpy.ops.mesh.primitive_monkey_add()
    bpy.context.object.name = "Suzanne"
    for name, value in SMALL.items():
        setattr(bpy.context.scene.fewview, name, value)
    return rehearse


@pytest.fixture
def main(parts: Callable[[str], ModuleType]) -> Callable[..., int]:
    """The command: its words as in a shell, its exit code."""
    found: Callable[[list[str]], int] = parts("command_line").main
    return lambda words: found(shlex.split(words))


@pytest.mark.parametrize("example", PYTHON_EXAMPLES)
def test_an_example_runs(example: str, rehearsed: object) -> None:
    exec(compile(example, "README.md", "exec"), {"__name__": "__main__"})
    result = bpy.context.scene.fewview.result
    assert result is not None
    assert len(result.data.polygons) > 0
    assert Path(result["fewview_job"]).parent == Path("jobs").absolute()


@pytest.mark.parametrize("words", COMMANDS)
def test_a_command_runs(
    words: str, rehearsed: object, main: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 0
    made = json.loads(capsys.readouterr().out.splitlines()[-1])
    named = [made[key] for key in ("result", "transforms") if key in made] + made.get("images", [])
    assert all(Path(path).exists() for path in named)
    if "--save" in words:
        assert Path("mesh.blend").is_file()
    if "--views" in words:
        assert len(made["images"]) == 8


TOOL = Path(bpy.utils.system_resource("SCRIPTS")) / "addons_core/bl_pkg/cli/blender_ext.py"
"""What `blender --command extension` runs."""


def tool(*words: str, folder: Path) -> None:
    """Blender's tool for extensions in the folder; what it says must be no error, whatever its exit code."""
    run = subprocess.run(
        [sys.executable, TOOL, *words], capture_output=True, text=True, cwd=folder, timeout=60
    )
    assert run.returncode == 0, run.stderr
    assert "ERROR" not in run.stdout + run.stderr


def test_the_command_that_builds_the_extension_needs_no_folder_first(tmp_path: Path) -> None:
    """Nothing but what a download holds: it makes no folders of its own."""
    (command,) = re.findall(r"`blender --command extension (build[^`]*)`", SECTION)
    (tmp_path / "addon").mkdir()
    for path in (ROOT / "__init__.py", ROOT / "blender_manifest.toml", *(ROOT / "addon").glob("*.py")):
        (tmp_path / path.relative_to(ROOT)).write_bytes(path.read_bytes())
    tool(*shlex.split(command), folder=tmp_path)
    (made,) = tmp_path.glob("*.zip")
    assert f"`{made.name}`" in SECTION


def test_a_zip_as_it_is_downloaded_can_be_installed(tmp_path: Path) -> None:
    """All of the repository in one folder, as hosts of repositories give it."""
    found = zipfile.ZipFile(tmp_path / "download.zip", "w")
    with found:
        for name in (
            "__init__.py",
            "blender_manifest.toml",
            "pyproject.toml",
            "constraints.txt",
            "README.md",
        ):
            found.write(ROOT / name, f"fewview-main/{name}")
        for path in (path for part in ("addon", "backend", "tests") for path in (ROOT / part).rglob("*.py")):
            found.write(path, f"fewview-main/{path.relative_to(ROOT)}")
    tool("install-files", "--local-dir", str(tmp_path), str(tmp_path / "download.zip"), folder=tmp_path)
    assert (tmp_path / "fewview" / "addon" / "panels.py").is_file()
    assert "as a ZIP" in README


def test_there_are_examples_of_every_kind() -> None:
    assert len(PYTHON_EXAMPLES) == 3
    assert {words.split()[0] for words in COMMANDS} == {"check", "reconstruct", "render"}


def test_what_is_left_out_is_not_the_panels(rehearsed: object, parts: Callable[[str], ModuleType]) -> None:
    """The function's job is what its arguments say, whatever the scene's settings are."""
    settings = bpy.context.scene.fewview
    settings.preset, settings.seed, settings.truth = "detailed", 7, "nowhere.ply"
    settings.without_ground = settings.cut_out = True
    done = parts("api").reconstruct(["photos"], output="jobs")
    job = json.loads((done.folder / "job.json").read_text(encoding="utf-8"))
    assert (job["preset"], job["seed"], job["truth"], job["cameras"]) == ("balanced", 0, None, None)
    assert not job["without_ground"]
    assert not job["cut_out"]
    assert job["images"] == [str(Path("photos").absolute())]
    assert done.mesh == settings.result
    assert done.warnings


@pytest.mark.parametrize("asked", [False, True])
@pytest.mark.parametrize("what", ["without_ground", "cut_out"])
def test_ground_and_surroundings_are_left_out_where_that_is_asked(
    what: str, asked: bool, rehearsed: object, main: Callable[..., int]
) -> None:
    """By the function, through the command; by the operator's argument; by the scene's setting."""
    assert main("reconstruct photos --output command" + f" --{what.replace('_', '-')}" * asked) == 0
    argument = {what: True} if asked else {}
    bpy.ops.fewview.reconstruct(images="photos", output=str(Path("argument").absolute()), **argument)
    setattr(bpy.context.scene.fewview, what, asked)
    bpy.ops.fewview.reconstruct(images="photos", output=str(Path("setting").absolute()))
    for folder in ("command", "argument", "setting"):
        (written,) = Path(folder).glob("*/job.json")
        assert json.loads(written.read_text(encoding="utf-8"))[what] == asked


def test_no_images_and_missing_ones_are_said(parts: Callable[[str], ModuleType], tmp_path: Path) -> None:
    reconstruct = parts("api").reconstruct
    with pytest.raises(ValueError, match="There are no images: give files or folders"):
        reconstruct([], output=tmp_path / "jobs")
    with pytest.raises(ValueError, match=r"There is nothing at .*nowhere: check the path"):
        reconstruct([tmp_path / "nowhere"], output=tmp_path / "jobs")
    assert not (tmp_path / "jobs").exists()


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"region": ((0.0, 0.0, float("nan")), 1.0)}, "not finite"),
        ({"region": (0.0, 0.0, 0.0, 1.0)}, "a centre of three numbers and a radius"),
        ({"region": ((0.0, 0.0), 1.0)}, "region_centre"),
        ({"preset": "best"}, "best"),
        ({"preset": None}, "preset"),
        ({"seed": 2**40}, "seed"),
        ({"seed": 1.5}, "seed"),
        ({"seed": True}, "seed"),
    ],
)
def test_arguments_that_make_no_sense_are_told_before_a_folder_is_made(
    rehearsed: object, parts: Callable[[str], ModuleType], wrong: dict[str, Any], said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        parts("api").reconstruct(["photos"], output="jobs", **wrong)
    assert not Path("jobs").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("reconstruct nowhere --output jobs", "nowhere"),
        ("reconstruct photos --cameras nowhere.json --output jobs", "nowhere.json"),
        ("reconstruct photos --seed -1 --output jobs", "seed"),
        ("reconstruct photos", "--output"),
        ("reconstruct photos --output jobs --preset best", "best"),
        ("render --object Nobody --output jobs", "Nobody"),
        ("render --object Suzanne --output photos/a.png", "a.png"),
        ("render --object Suzanne --output jobs --views 1", "--views: must be from 2 to"),
        ("render --object Suzanne --output jobs --views 100000", "--views: must be from 2 to"),
        ("render --object Suzanne --output jobs --width 9000", "--width: must be from 32 to 8192"),
        ("render --object Suzanne --output jobs --height x", "--height"),
        ("render --object Suzanne --output jobs --samples 0", "--samples"),
        ("render --object Suzanne --output jobs --seed -1", "--seed"),
        ("explode", "explode"),
        ("", "required"),
    ],
)
def test_a_users_mistake_ends_with_2(
    words: str,
    said: str,
    rehearsed: object,
    main: Callable[..., int],
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(words) == 2
    output = capsys.readouterr()
    assert said in output.err
    assert "Error: Error:" not in output.err
    assert "{" not in output.out
    assert not Path("jobs").exists()


def test_every_option_is_explained(parts: Callable[[str], ModuleType]) -> None:
    (commands,) = (a for a in parts("command_line")._parser()._actions if isinstance(a.choices, dict))
    options = [(name, option) for name, parser in commands.choices.items() for option in parser._actions]
    assert [(name, option.dest) for name, option in options if not option.help] == []


def test_help_is_no_mistake(rehearsed: object, main: Callable[..., int]) -> None:
    assert main("reconstruct --help") == 0


@pytest.mark.parametrize(("end", "code"), [("finished", 0), ("failed", 2), ("crashed", 1)])
@pytest.mark.parametrize("words", ["reconstruct photos --output jobs", "check"])
def test_the_exit_code_says_whose_fault_it_is(
    words: str, end: str, code: int, rehearsed: Callable[..., None], main: Callable[..., int]
) -> None:
    rehearsed(end)
    assert main(words) == code


def test_an_earlier_jobs_fault_is_not_held_against_the_next(
    rehearsed: Callable[..., None], main: Callable[..., int]
) -> None:
    rehearsed("crashed")
    assert main("check") == 1
    assert main("render --object Suzanne --output photos/a.png") == 2


def test_a_stopped_job_ends_with_130(
    rehearsed: object,
    main: Callable[..., int],
    parts: Callable[[str], ModuleType],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    jobs = parts("jobs")
    start = jobs.start

    def start_and_stop(*positional: Any, **named: Any) -> None:
        start(*positional, **named)
        jobs.cancel()

    monkeypatch.setattr(jobs, "start", start_and_stop)
    assert main("reconstruct photos --output jobs") == 130


def test_a_fault_in_an_operator_ends_with_1(
    rehearsed: object,
    main: Callable[..., int],
    parts: Callable[[str], ModuleType],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def generate(*_: object) -> None:
        raise KeyError("a mistake of ours")

    monkeypatch.setattr(parts("view_cameras"), "generate", generate)
    assert main("render --object Suzanne --output jobs") == 1


def test_a_python_without_the_backend_ends_with_2(
    parts: Callable[[str], ModuleType], main: Callable[..., int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FEWVIEW_PYTHON", "/nowhere/python")
    assert main("check") == 2
    assert main("reconstruct . --output jobs") == 2


@pytest.mark.skipif(not bpy.app.binary_path, reason="bpy as a module is no program that can be started")
@pytest.mark.skipif("FEWVIEW_PYTHON" not in os.environ, reason="FEWVIEW_PYTHON names no backend")
def test_blender_knows_the_command(extension: str, tmp_path: Path) -> None:
    """As a shell starts it: there Ctrl-C is not Python's, and the exit code is the program's."""

    def ended(*words: str) -> subprocess.CompletedProcess[str]:
        command = [bpy.app.binary_path, "--factory-startup", "--addons", extension, "--command", "fewview"]
        return subprocess.run([*command, *words], capture_output=True, text=True, cwd=tmp_path, timeout=120)

    checked = ended("check")
    assert checked.returncode == 0, checked.stderr
    assert "torch" in json.loads(checked.stdout.splitlines()[-1])
    (tmp_path / "a.png").write_bytes(b"no picture")
    refused = ended("reconstruct", "a.png", "--output", "jobs")
    assert refused.returncode == 2, refused.stderr
    assert "Traceback" not in refused.stderr


def test_buttons_that_are_named_exist() -> None:
    """Names in italics are those of the interface, as somebody reads them there."""
    sources = (ROOT / "addon").rglob("*.py")
    shown = {
        text for path in sources for text in re.findall(r'"([^"\n]+)"', path.read_text(encoding="utf-8"))
    }
    known = {re.sub(r"^\d\. ", "", text) for text in shown} | {"Allow Online Access"}  # Blender's own
    missing = set(re.findall(r"(?<!\*)\*([A-Z][^*\n]+)\*(?!\*)", SECTION)) - known
    assert not missing


def test_files_that_are_named_exist() -> None:
    assert [name for name in FILES if not (ROOT / name).exists()] == []


@pytest.mark.slow
@pytest.mark.skipif("FEWVIEW_PYTHON" not in os.environ, reason="FEWVIEW_PYTHON names no backend")
def test_from_an_object_to_its_mesh_by_commands(
    addon: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The real backend, on views so small that only the way is tried, and the mesh is near the object."""
    from blender_scenes.scenes import SCENES, build_scene

    monkeypatch.chdir(tmp_path)
    bpy.ops.object.light_add(type="SUN", rotation=(0.9, 0.0, 0.3))
    (subject,) = build_scene(SCENES["monkey"]("monkey", 0)).subjects
    main = importlib.import_module(f"{addon.__name__}.command_line").main
    layout = "--layout arc --views 4 --width 320 --height 240 --samples 4"
    assert main(["render", "--object", subject.name, *layout.split(), "--output", "jobs"]) == 0
    made = json.loads(capsys.readouterr().out.splitlines()[-1])
    known = ["--cameras", made["transforms"], "--preset", "fast"]
    assert main(["reconstruct", *made["images"], *known, "--output", "jobs", "--save", "mesh.blend"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["triangles"] > 1000
    bpy.ops.fewview.measure_error(truth=subject.name)
    median_percent = bpy.context.scene.fewview.result["fewview_error_percent"][0]
    assert median_percent < 2.0
    assert Path("mesh.blend").is_file()
    assert main(["reconstruct", str(tmp_path / "jobs" / "views-001" / "truth.ply"), "--output", "jobs"]) == 2
