"""From a scene written as text over rendered views to the mesh on top of the original, as users start it."""

import importlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType

import pytest

bpy = pytest.importorskip("bpy", reason="needs Blender's Python, where `import bpy` works")

pytestmark = [
    pytest.mark.blender,
    pytest.mark.slow,
    pytest.mark.skipif(
        "FEWVIEW_PYTHON" not in os.environ, reason="FEWVIEW_PYTHON names no Python with the backend"
    ),
]


def test_the_mesh_lies_on_the_original(
    extension: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from blender_scenes.reconstruct_scene import main

    words = "--scene monkey --views 6 --layout arc --samples 16 --preset fast"
    saved = tmp_path / "scene.blend"
    assert main([*words.split(), "--output", str(tmp_path), "--save", str(saved)]) == 0
    summary = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert summary["median_percent"] < 0.5
    assert summary["triangles"] > 10_000
    assert saved.is_file()
    result = bpy.context.scene.fewview.result
    assert result.name == summary["mesh"]
    assert "support" in result.data.attributes
    assert len([made for made in bpy.context.scene.objects if made.type == "CAMERA"]) >= 6


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three rendered views with their cameras."""
    from blender_scenes.render_views import main

    folder = tmp_path_factory.mktemp("views")
    words = "--scene monkey --views 3 --arc-deg 40 --samples 4 --width 400 --height 300 --output"
    assert main([*words.split(), str(folder)]) == 0
    return folder


def test_a_real_job_is_followed_and_cancelled(addon: ModuleType, views: Path, tmp_path: Path) -> None:
    """The timer is quick, previews come, a cancel is answered at once and ends the job in time."""
    jobs = importlib.import_module(f"{addon.__name__}.jobs")
    start_real_job(addon, views, tmp_path)
    deadline = time.monotonic() + 120
    while jobs.running() is not None and not any(made.get("fewview_role") == "preview" for made in objects()):
        assert time.monotonic() < deadline
        jobs._tick()
        time.sleep(0.02)
    assert jobs.running() is not None
    started = time.monotonic()
    jobs.cancel()
    assert jobs.running().cancelling
    assert time.monotonic() - started < 1.0
    while jobs.running() is not None:
        jobs._tick()
        time.sleep(0.02)
    assert time.monotonic() - started < 10.0
    assert jobs.ended().cancelled
    assert not any(made.get("fewview_role") == "preview" for made in objects())
    assert (
        jobs.longest_tick_s < 0.1
    )  # of 20 ms; this machine may be busy, docs/addon.md has what was measured


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="reads /proc")
def test_the_backend_ends_when_blender_dies(views: Path, tmp_path: Path, extension: str) -> None:
    """Killed amid a job, without a chance to clean up; within two seconds nothing of it is left."""
    script = tmp_path / "blender.py"
    names = {"here": str(Path(__file__)), "extension": extension, "views": str(views), "path": sys.path}
    script.write_text(ORPHAN.format(**names))
    blender = (bpy.app.binary_path, "--background", "--python") if bpy.app.binary_path else (sys.executable,)
    with subprocess.Popen([*blender, str(script)], cwd=tmp_path, stdout=subprocess.DEVNULL) as process:
        pid_file = tmp_path / "pid"
        deadline = time.monotonic() + 120
        while not pid_file.exists():
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.05)
        backend = int(pid_file.read_text())
        assert is_alive(backend)
        process.kill()
        process.wait()
    started = time.monotonic()
    while is_alive(backend):
        assert time.monotonic() - started < 2.0
        time.sleep(0.02)


ORPHAN = """
import importlib.util, sys, time, pathlib
sys.path += [folder for folder in {path!r} if folder not in sys.path]
spec = importlib.util.spec_from_file_location("whole_way", {here!r})
import bpy
bpy.ops.preferences.addon_enable(module={extension!r})
tests = importlib.util.module_from_spec(spec)
sys.modules["whole_way"] = tests
spec.loader.exec_module(tests)
addon = importlib.import_module({extension!r} + ".addon")
jobs = importlib.import_module({extension!r} + ".addon.jobs")
tests.start_real_job(addon, pathlib.Path({views!r}), pathlib.Path("."))
while jobs.running().stage != "stereo":
    jobs._tick()
    time.sleep(0.02)
part = pathlib.Path("pid.part")
part.write_text(str(jobs.running().process._process.pid))
part.rename("pid")
time.sleep(60)
"""


def start_real_job(addon: ModuleType, views: Path, output: Path) -> None:
    """As the operator does in a window: the caller follows it."""
    wire = importlib.import_module(f"{addon.__package__.rpartition('.')[0]}.backend.wire.protocol")
    reconstruct = importlib.import_module(f"{addon.__name__}.operators.reconstruct")
    folders = importlib.import_module(f"{addon.__name__}.job_folder")
    job = wire.Job(
        protocol=wire.PROTOCOL_VERSION,
        images=(str(views / "images"),),
        output="result",
        cameras=str(views / "transforms.json"),
    )
    folder = folders.new_folder(output.absolute(), "reconstruct")
    python = Path(os.environ["FEWVIEW_PYTHON"])
    reconstruct.start(python, folder, job, scene_name=bpy.context.scene.name)


def objects() -> list[bpy.types.Object]:
    return list(bpy.context.scene.objects)


def is_alive(pid: int) -> bool:
    """Whether there is such a process that has not ended; one that nobody waits for has."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
