"""The command line from outside: every command as a process, its words, its exit code and its files.

Where a run must be slow, broken or quick on purpose, small stages stand in for the real ones.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from backend.mesh_files import read_mesh
from backend.wire import protocol
from backend.wire.client import WireProcess, backend_command, clean_environment
from backend.wire.protocol import Failed, Finished, Hello, Job, Message, decode

ROOT = Path(__file__).resolve().parents[2]
FAKE_STAGES = Path(__file__).with_name("fake_stages.py")
STAGES = ["photos", "cameras", "region", "stereo", "train", "mesh"]
CAMERA_RESULTS = {"cameras.json", "sparse.ply", "log.txt"}
CAMERA_PAGES = {"cameras.html", "cameras_report.json"}
RESULTS = CAMERA_RESULTS | {"mesh.ply", "mesh.glb", "points.ply", "report.json", "report.html"}
posix_only = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")


class Case:
    """A folder with photographs, a place for results, and commands run on them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.output = folder / "out"
        self.photos = folder / "photos"
        self.photos.mkdir()
        for index in range(3):
            Image.fromarray(np.full((4, 6, 3), 50 * index, np.uint8)).save(self.photos / f"{index}.png")

    @property
    def environment(self) -> dict[str, str]:
        return {
            **clean_environment(os.environ),
            "DONE_LOG": str(self.folder / "done"),
            "OMP_NUM_THREADS": "1",
        }

    def command(self, trouble: str = "none", where: str = "none", step_s: float = 0.0) -> list[str]:
        return [sys.executable, str(FAKE_STAGES), trouble, where, str(step_s), "reconstruct"]

    def options(self, *more: str) -> list[str]:
        return [str(self.photos), "--output", str(self.output), "--device", "cpu", *more]

    def run(self, trouble: str = "none", where: str = "none", *more: str) -> subprocess.CompletedProcess[str]:
        """A run on a terminal that is none, so with plain lines."""
        return self.finish(self.command(trouble, where) + self.options(*more))

    def finish(self, command: list[str], **options: Any) -> subprocess.CompletedProcess[str]:
        options = {"capture_output": True, "text": True, "timeout": 60, "cwd": self.folder, **options}
        return subprocess.run(command, env=self.environment, check=False, **options)

    def start(self, step_s: float, *arguments: str, **options: Any) -> subprocess.Popen[str]:
        command = self.command(step_s=step_s) + list(arguments)
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        return subprocess.Popen(command, env=self.environment, text=True, cwd=self.folder, **pipes, **options)

    def converse(self, *command: str) -> int:
        """The exit code of a run on the wire, whose caller waits for its end."""
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        with subprocess.Popen(command, env=self.environment, cwd=self.folder, **pipes) as process:
            assert process.stdout is not None
            process.stdout.read()  # while stdin is open
            return process.wait()

    def done(self) -> list[str]:
        """Stages computed since the last call."""
        path = self.folder / "done"
        lines = path.read_text().split() if path.exists() else []
        path.unlink(missing_ok=True)
        return lines

    def wait_for_stage(self, name: str) -> None:
        deadline = time.monotonic() + 30
        while time.monotonic() < deadline:
            if (self.folder / "done").exists() and name in (self.folder / "done").read_text():
                return
            time.sleep(0.01)
        raise AssertionError(f"stage {name} never began")

    def write_job(self, **changes: object) -> Path:
        job = Job(protocol=protocol.PROTOCOL_VERSION, images=("photos",), output="out", device="cpu")
        content = {**json.loads(protocol.encode_job(job)), **changes}
        (self.folder / "job.json").write_text(json.dumps(content))
        return self.folder / "job.json"

    def results(self) -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in self.output.iterdir() if path.is_file()}


@pytest.fixture
def case() -> Iterator[Case]:
    with tempfile.TemporaryDirectory() as folder:
        yield Case(Path(folder).resolve())


def backend(*arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    options = {"capture_output": True, "text": True, "timeout": 120, "cwd": ROOT, **options}
    return subprocess.run([sys.executable, "-m", "backend", *arguments], check=False, **options)


def messages(text: str) -> list[Message]:
    """The lines of a conversation, checked for its rules."""
    heard = [decode(line) for line in text.splitlines()]
    assert isinstance(heard[0], Hello)
    assert not any(isinstance(message, Hello) for message in heard[1:])
    assert [isinstance(message, Finished | Failed) for message in heard] == [False] * (len(heard) - 1) + [
        True
    ]
    return heard


# Commands that reconstruct nothing.


def test_doctor_says_ready() -> None:
    result = backend("doctor")
    assert (result.returncode, result.stdout.splitlines()[-1]) == (0, "ready"), result.stderr
    found = json.loads(backend("doctor", "--json").stdout)
    assert found["ready"] is True
    assert {"torch", "pycolmap", "cpu"} <= {check["name"] for check in found["checks"]}


def without_packages(*arguments: str) -> subprocess.CompletedProcess[str]:
    """The command line in a Python without any installed package."""
    command = [sys.executable, "-S", "-m", "backend", *arguments]
    return subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False, input=""
    )


def test_doctor_starts_without_any_package_and_names_them() -> None:
    result = without_packages("doctor")
    assert result.returncode == 2, result.stderr
    assert "NOT torch" in result.stdout
    assert "pip install" in result.stdout.splitlines()[-1]
    assert json.loads(without_packages("doctor", "--json").stdout)["ready"] is False


def test_a_missing_package_is_a_clear_error(case: Case) -> None:
    result = without_packages("reconstruct", str(case.photos), "--output", str(case.output))
    assert result.returncode == 2
    assert "cannot be loaded" in result.stderr
    assert "doctor" in result.stderr
    assert "Traceback" not in result.stderr
    last = messages(without_packages("reconstruct", str(case.write_job())).stdout)[-1]
    assert isinstance(last, Failed)
    assert last.code == "missing_dependency"
    assert not case.output.exists()


def test_rehearse_plays_the_whole_conversation_without_any_package(case: Case) -> None:
    command = [sys.executable, "-S", "-m", "backend", "rehearse", "--output", str(case.output)]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        heard = messages(process.stdout.read())
    assert {type(message) for message in heard} == {
        kind for name, kind in protocol.MESSAGES.items() if name not in ("cancel", "failed", "checked")
    }
    assert isinstance(heard[-1], Finished)
    assert set(heard[-1].files) >= {"mesh.ply", "cameras.json", "sparse.ply", "report.json", "report.html"}
    assert all((case.output / name).exists() for name in heard[-1].files)
    assert not list(case.output.glob("*.part"))
    previews = [Path(message.path) for message in heard if isinstance(message, protocol.Preview)]
    assert [path.suffix for path in previews] == [".json", ".ply", ".ply"]
    assert len(json.loads(previews[0].read_text())["frames"]) == 3
    assert len(read_mesh(previews[-1]).faces) == 4


def rehearsal(call: str) -> subprocess.Popen[str]:
    """rehearse() with the arguments of the call, in a program of its own."""
    script = f"import sys; from backend.commands.rehearse import rehearse; sys.exit(rehearse({call}))"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen([sys.executable, "-S", "-c", script], cwd=ROOT, text=True, **pipes)


def failed_rehearsal(call: str) -> Failed:
    """How it ends."""
    with rehearsal(call) as process:
        assert process.stdout is not None
        last = messages(process.stdout.read())[-1]
    assert process.returncode == 2
    assert isinstance(last, Failed)
    return last


def test_a_rehearsal_in_a_folder_that_is_there_is_refused(case: Case) -> None:
    failed = failed_rehearsal(f"__import__('pathlib').Path({str(case.photos)!r})")
    assert failed.code == "output_unusable"


def test_a_rehearsal_can_run_out_of_memory(case: Case) -> None:
    failed = failed_rehearsal(f"__import__('pathlib').Path({str(case.output)!r}), 0.2, end='failed'")
    assert failed.code == "out_of_memory"
    assert not (case.output / "mesh.ply").exists()


@posix_only
def test_a_rehearsal_can_crash() -> None:
    with rehearsal("None, 0.2, end='crashed'") as process:
        assert process.stdout is not None
        heard = [decode(line) for line in process.stdout]
    assert process.returncode == -signal.SIGABRT
    assert not any(isinstance(message, Finished | Failed) for message in heard)


def test_a_long_rehearsal_takes_its_time_and_hears_a_cancel_at_once() -> None:
    with rehearsal("None, 300.0") as process:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(1.0)
        assert process.poll() is None
        asked_s = time.monotonic()
        process.stdin.write('{"type": "cancel"}\n')
        process.stdin.flush()
        process.stdout.read()
    assert time.monotonic() - asked_s < 1.0
    assert process.returncode == 130


def test_the_client_and_a_rehearsal_understand_each_other(case: Case) -> None:
    process = WireProcess(backend_command(sys.executable, "rehearse"), log_path=case.folder / "log")
    heard: list[Message] = []
    while process.is_running:
        heard += process.poll()
        if len(heard) == 10:
            process.cancel()
        time.sleep(0.005)
    process.close()
    assert isinstance(heard[-1], Failed)
    assert heard[-1].code == protocol.CANCELLED


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["reconstruct"],
        ["reconstruct", "photos"],
        ["reconstruct", "job.json", "--seed", "1"],
        ["reconstruct", "photos", "--output", "out", "--preset", "best"],
        ["reconstruct", "photos", "--output", "out", "--device", "tpu"],
        ["reconstruct", "photos", "--output", "out", "--seed", "-1"],
        ["reconstruct", "photos", "--output", "out", "--seed", "x"],
    ],
)
def test_wrong_arguments_end_with_usage(arguments: list[str], tmp_path: Path) -> None:
    result = backend(*arguments)
    assert result.returncode == 2
    assert "usage:" in result.stderr


# Runs.


def test_a_run_leaves_its_results_and_the_next_one_resumes(case: Case) -> None:
    first = case.run()
    assert first.returncode == 0, first.stderr
    assert case.done() == STAGES
    results = case.results()
    assert set(results) >= RESULTS
    assert {
        Path(line).name for line in first.stdout.splitlines() if line.startswith(str(case.output))
    } >= RESULTS
    assert "noise" not in first.stdout.splitlines()[-1]
    assert "\nWarning: 1 of 3 photographs could not be placed: 0.png (on purpose).\n" in first.stderr
    assert first.stderr.count("could not be placed") == 1
    assert "[4/7] stereo done in" in first.stderr
    assert len(read_mesh(case.output / "mesh.ply").faces) == 1
    second = case.run()
    assert "Resuming: photos, cameras, region, stereo, train, mesh are done" in second.stderr
    assert case.done() == []
    assert {**case.results(), "log.txt": b""}.keys() == results.keys()
    assert (case.output / "mesh.ply").read_bytes() == results["mesh.ply"]


def test_pictures_that_cannot_be_read_are_told(case: Case) -> None:
    (case.photos / "camera.NEF").write_bytes(b"")
    result = case.run()
    assert "camera.NEF" in result.stderr
    warnings = json.loads((case.output / "report.json").read_text())["warnings"]
    assert any("camera.NEF" in text for text in warnings)


def test_a_job_that_keeps_no_stages_leaves_results_alone(case: Case) -> None:
    job = str(case.write_job(keep_stages=False))
    assert case.converse(*case.command("internal", "mesh"), job) == 1
    kept = {path.stem for path in (case.output / ".fewview").glob("*.npz")}
    assert kept == set(STAGES) - {"mesh"}
    assert case.done() == [*STAGES]
    assert case.converse(*case.command(), job) == 0
    assert case.done() == ["mesh"]  # it went on
    assert set(case.results()) == RESULTS
    assert {path.name for path in (case.output / ".fewview").iterdir()} == {"format.json", "lock"}


def test_what_depends_on_a_change_is_redone_and_nothing_else(case: Case) -> None:
    case.run()
    mesh = (case.output / "mesh.ply").read_bytes()
    case.done()
    again = case.run("none", "none", "--seed", "7")
    assert "Resuming: photos is done" in again.stderr
    assert case.done() == STAGES[1:]
    assert (case.output / "mesh.ply").read_bytes() != mesh
    Image.fromarray(np.full((4, 6, 3), 99, np.uint8)).save(case.photos / "1.png")
    assert "Resuming" not in case.run("none", "none", "--seed", "7").stderr
    assert case.done() == STAGES
    case.run()
    assert (case.output / "mesh.ply").read_bytes() == mesh  # the seed alone decides


def test_another_budget_fits_the_surface_again_and_the_same_does_not(case: Case) -> None:
    case.run()
    case.done()
    case.run("none", "none", "--budget-seconds", "5")
    assert case.done() == STAGES[4:]
    case.run("none", "none", "--budget-seconds", "5")
    assert case.done() == []


def test_a_damaged_checkpoint_is_redone(case: Case) -> None:
    case.run()
    case.done()
    path = case.output / ".fewview" / "stereo.npz"
    data = bytearray(path.read_bytes())
    data[200] ^= 255
    path.write_bytes(data)
    assert case.run().returncode == 0
    assert case.done() == ["stereo"]


@pytest.mark.parametrize(
    ("trouble", "code", "words"),
    [
        ("memory", 2, "ran out of memory"),
        ("torch_memory", 2, "ran out of memory"),
        ("disk", 2, "disk is full"),
        ("import", 2, "pycolmap"),
        ("internal", 1, "ZeroDivisionError"),
    ],
)
def test_trouble_is_told(case: Case, trouble: str, code: int, words: str) -> None:
    result = case.run(trouble, "stereo")
    assert result.returncode == code
    assert words in result.stderr
    assert ("Traceback" in result.stderr) is (code == 1)
    assert set(case.results()) == {"log.txt"}
    assert "Traceback" in (case.output / "log.txt").read_text()
    assert case.done() == STAGES[:4]


def test_what_was_done_before_trouble_is_kept(case: Case) -> None:
    assert case.run("memory", "stereo").returncode == 2
    assert case.done() == STAGES[:4]
    assert "Resuming: photos, cameras, region are done" in case.run().stderr
    assert case.done() == STAGES[3:]


def test_trouble_leaves_earlier_results_as_they_were(case: Case) -> None:
    case.run()
    before = case.results()
    assert case.run("disk", "mesh", "--seed", "3").returncode == 2
    after = case.results()
    assert {**after, "log.txt": b""} == {**before, "log.txt": b""}


def test_someone_elses_folder_is_not_touched(case: Case) -> None:
    before = {path: path.stat().st_mtime_ns for path in [case.photos, *case.photos.iterdir()]}
    result = case.finish([*case.command(), str(case.photos), "--output", str(case.photos)])
    assert result.returncode == 2
    assert "did not make" in result.stderr
    assert {path: path.stat().st_mtime_ns for path in [case.photos, *case.photos.iterdir()]} == before


def test_another_shoot_does_not_replace_a_finished_result(case: Case) -> None:
    case.run()
    before = case.results()
    for index in range(3):
        Image.fromarray(np.full((4, 6, 3), 200 + index, np.uint8)).save(case.photos / f"{index}.png")
    again = case.run()
    assert again.returncode == 2
    assert "other photographs" in again.stderr
    assert "new or empty output folder" in again.stderr
    assert {**case.results(), "log.txt": b""} == {**before, "log.txt": b""}


def test_pages_and_meshes_are_of_the_same_cameras(case: Case) -> None:
    """What the other command left and does not fit is removed where it is soon made again, else protected."""
    converse(case, until="cameras")
    converse(case)
    assert set(case.results()) == RESULTS | CAMERA_PAGES
    refused = converse(case, until="cameras", seed=5)[-1]
    assert isinstance(refused, Failed)
    assert refused.code == "output_unusable"
    assert set(case.results()) == RESULTS | CAMERA_PAGES
    assert isinstance(converse(case, seed=5)[-1], Finished)
    assert set(case.results()) == RESULTS
    assert isinstance(converse(case, until="cameras", seed=5)[-1], Finished)
    assert set(case.results()) == RESULTS | CAMERA_PAGES


def test_a_folder_whose_name_stdout_cannot_say_gets_its_results(case: Case) -> None:
    """A pipe on Windows takes the letters of one language; here those of ASCII alone."""
    output = case.folder / "Größe"
    command = [*case.command(), str(case.photos), "--output", str(output), "--device", "cpu"]
    environment = {**case.environment, "PYTHONIOENCODING": "ascii"}
    result = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=60, cwd=case.folder, check=False
    )
    assert result.returncode == 0, result.stderr
    assert r"Gr\xf6\xdfe" in result.stdout
    assert (output / "mesh.ply").is_file()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the names of files are text")
def test_a_photograph_whose_name_is_no_text_is_one_like_others(case: Case) -> None:
    """As a Latin-1 disk or archive leaves it; terminal, log, pages and messages name it."""
    (case.photos / "1.png").rename(case.photos / os.fsdecode(b"f\xfcr.png"))
    masks = case.folder / "masks"
    masks.mkdir()
    Image.new("L", (6, 4), 255).save(masks / "2.png")
    result = case.run("none", "none", "--masks", str(masks))
    assert result.returncode == 0, result.stderr
    assert set(case.results()) == RESULTS
    assert r"f\udcfcr.png" in result.stderr
    for name in ("log.txt", "report.html", "cameras.json"):
        assert rb"f\udcfcr.png" in case.results()[name], name
    heard = converse(case, masks="masks", seed=5)
    assert isinstance(heard[-1], Finished)
    assert any(r"f\udcfcr.png" in str(message) for message in heard)


def test_a_missing_truth_is_told_before_the_work(case: Case) -> None:
    result = case.run("none", "none", "--truth", str(case.folder / "none.ply"))
    assert result.returncode == 2
    assert "none.ply" in result.stderr
    assert case.done() == []
    assert not case.output.exists()


@pytest.mark.skipif(sys.platform == "darwin", reason="a Mac has it")
def test_a_device_that_is_not_there_is_told(case: Case) -> None:
    result = case.finish([*case.command(), str(case.photos), "--output", str(case.output), "--device", "mps"])
    assert result.returncode == 2
    assert "mps" in result.stderr
    assert not case.output.exists()


# Ends that come from outside.


@posix_only
def test_a_killed_run_resumes(case: Case) -> None:
    process = case.start(0.02, *case.options())
    case.wait_for_stage("stereo")
    process.kill()
    process.communicate()
    assert case.done() == STAGES[:4]
    assert not RESULTS & {path.name for path in case.output.glob("*.*")} - {"log.txt"}
    result = case.run()
    assert result.returncode == 0
    assert "Resuming: photos, cameras, region are done" in result.stderr
    assert case.done() == STAGES[3:]


@posix_only
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_stops_at_the_next_step_and_says_how_to_resume(case: Case, number: int) -> None:
    process = case.start(0.05, *case.options())
    case.wait_for_stage("region")
    process.send_signal(number)
    _, stderr = process.communicate(timeout=10)
    assert process.returncode == 130
    assert "run the same command again to resume" in stderr
    assert "Traceback" not in stderr
    assert "Resuming: photos, cameras are done" in case.run().stderr


@posix_only
def test_the_second_ctrl_c_ends_at_once(case: Case) -> None:
    command = case.command("hang", "cameras") + case.options()
    pipe = subprocess.PIPE
    with subprocess.Popen(command, env=case.environment, stdout=pipe, stderr=pipe, text=True) as process:
        case.wait_for_stage("cameras")
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        time.sleep(0.5)
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        assert process.wait(5) == 130
    assert "Resuming: photos is done" in case.run().stderr


# The wire.


def test_a_job_file_gives_a_conversation(case: Case) -> None:
    job = case.write_job()
    job.write_text(job.read_text(), encoding="utf-8-sig")  # as editors on Windows save it
    with case.start(0.0, str(job)) as process:
        assert process.stdout is not None
        heard = messages(process.stdout.read())
    assert process.returncode == 0
    last = heard[-1]
    assert isinstance(last, Finished)
    assert Path(last.output) == case.output
    assert set(last.files) >= RESULTS
    names = [message.name for message in heard if isinstance(message, protocol.Stage)]
    assert names[:6] == STAGES
    assert any(isinstance(message, protocol.Warned) for message in heard)
    previews = [message.path for message in heard if isinstance(message, protocol.Preview)]
    assert previews
    assert all(Path(path).is_file() for path in previews)


def counted_stages(heard: list[Message]) -> list[tuple[str, int, int]]:
    return [(m.name, m.index, m.count) for m in heard if isinstance(m, protocol.Stage)]


def converse(case: Case, step_s: float = 0.0, **changes: object) -> list[Message]:
    """A whole run on the wire."""
    with case.start(step_s, str(case.write_job(**changes))) as process:
        assert process.stdout is not None
        return messages(process.stdout.read())


def test_a_run_may_end_with_the_cameras_and_a_later_one_goes_on(case: Case) -> None:
    heard = converse(case, until="cameras")
    assert isinstance(heard[-1], Finished)
    assert set(heard[-1].files) == CAMERA_RESULTS | CAMERA_PAGES
    assert counted_stages(heard) == [("photos", 1, 3), ("cameras", 2, 3), ("region", 3, 3)]
    assert set(case.results()) == CAMERA_RESULTS | CAMERA_PAGES
    assert b"element vertex 2\n" in (case.output / "sparse.ply").read_bytes()
    told = json.loads((case.output / "cameras.json").read_text())
    assert [frame["file_path"] for frame in told["frames"]] == ["1.png", "2.png"]
    assert told["fewview"]["unplaced"] == [{"name": "0.png", "why": "on purpose"}]
    assert case.done() == STAGES[:3]
    again = converse(case)
    assert isinstance(again[-1], Finished)
    assert counted_stages(again)[-1] == ("report", 7, 7)
    assert case.done() == STAGES[3:]
    assert converse(case, until="cameras")[-1] == heard[-1]
    assert case.done() == []
    assert set(case.results()) == RESULTS | CAMERA_PAGES, "what the whole run left stays"


def test_cameras_alone_on_a_terminal(case: Case) -> None:
    """The same stages as those of a whole run, which goes on from there."""
    command = [*case.command()[:-1], "cameras", str(case.photos), "--output", str(case.output)]
    result = case.finish(command)
    assert result.returncode == 0, result.stderr
    assert "2 of 3 photographs have a camera" in result.stdout
    assert "0.png could not be placed: on purpose." in result.stdout
    assert "[2/3] cameras done" in result.stderr
    assert set(case.results()) == CAMERA_RESULTS | CAMERA_PAGES
    numbers = json.loads((case.output / "cameras_report.json").read_text())
    assert [photo["why_unplaced"] for photo in numbers["photos"]] == [None, None, "on purpose"]
    assert case.done() == STAGES[:3]
    assert case.run().returncode == 0
    assert case.done() == STAGES[3:]


def test_a_given_region_is_used_and_what_hangs_on_it_is_redone(case: Case) -> None:
    converse(case)
    case.done()
    converse(case, region_centre=[1, -2.5, 3.0], region_radius=0.5)
    assert case.done() == STAGES[2:]
    region = json.loads((case.output / "cameras.json").read_text())["fewview"]["region"]
    assert region["centre_world"] == pytest.approx([1, -2.5, 3])
    assert region["radius_world"] == pytest.approx(0.5)
    converse(case, region_centre=[1, -2.5, 3.0], region_radius=0.6)
    assert case.done() == STAGES[2:]


def test_a_region_on_the_command_line(case: Case) -> None:
    result = case.run("none", "none", "--region", "0", "-1", "0", "1e12")
    assert result.returncode == 2
    assert "too large" in result.stderr
    assert not case.output.exists()
    assert case.run("none", "none", "--region", "0", "-1", "0", "2.5").returncode == 0
    region = json.loads((case.output / "report.json").read_text())["region"]
    assert region["centre_world"] == pytest.approx([0, -1, 0])
    assert region["radius_world"] == pytest.approx(2.5)


def test_previews_are_cameras_then_points_then_whole_meshes(case: Case) -> None:
    """Long enough after each other: fitting takes 1.2 s."""
    converse(case, until="cameras")
    heard = converse(case, step_s=0.12)
    names = [m.name if isinstance(m, protocol.Stage) else m for m in heard]
    cameras, points, mesh = (m for m in heard if isinstance(m, protocol.Preview))
    assert names.index(cameras) < names.index("stereo")
    assert len(json.loads(Path(cameras.path).read_text())["frames"]) > 1
    assert names.index("stereo") < names.index(points) < names.index("train") < names.index(mesh)
    assert b"element face" not in Path(points.path).read_bytes()
    assert len(read_mesh(Path(mesh.path)).faces) > 100


@pytest.mark.parametrize(
    "change",
    [
        {"protocol": 99},
        {"preset": "best"},
        {"surprise": 1},
        {"images": "photos"},
        {"until": "mesh"},
        {"region_centre": [0, 0, 0]},
        {"region_centre": [0, 0, 0], "region_radius": -1.0},
        {"output": "out\0put"},
        {"images": ["photos\0"]},
        pytest.param(
            {"cameras": "\ud800"},
            marks=pytest.mark.skipif(sys.platform == "win32", reason="its files may be called so"),
        ),
    ],
)
def test_a_wrong_job_is_refused(case: Case, change: dict[str, object]) -> None:
    result = case.finish([*case.command(), str(case.write_job(**change))], input="")
    last = messages(result.stdout)[-1]
    assert result.returncode == 2
    assert isinstance(last, Failed)
    assert last.code == "settings_invalid"


def test_trouble_on_the_wire_is_the_last_word(case: Case) -> None:
    command = [*case.command("internal", "region"), str(case.write_job())]
    with subprocess.Popen(
        command, env=case.environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        last = messages(process.stdout.read())[-1]
    assert process.returncode == 1
    assert isinstance(last, Failed)
    assert last.code == "internal"


def test_a_cancel_line_stops_the_run_and_keeps_a_checkpoint(case: Case) -> None:
    process = case.start(0.05, str(case.write_job()))
    case.wait_for_stage("region")
    stdout, _ = process.communicate('not json\n{"type": "other"}\n{"type": "cancel"}\n', timeout=10)
    last = messages(stdout)[-1]
    assert isinstance(last, Failed)
    assert (last.code, process.returncode) == (protocol.CANCELLED, 130)
    assert "Resuming: photos, cameras are done" in case.run().stderr


def test_lines_that_are_no_cancel_do_not_stop_the_run(case: Case) -> None:
    process = case.start(0.0, str(case.write_job()))
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write('cancel\n{"type": "cancel", "now": true}\n')
    process.stdin.flush()
    assert isinstance(messages(process.stdout.read())[-1], Finished)
    process.communicate()


@pytest.mark.parametrize("trouble", ["none", "hang"])
def test_the_callers_death_ends_the_run_within_two_seconds(case: Case, trouble: str) -> None:
    """Asked up to three times: beside other work a machine may be busy for longer."""
    assert any(seconds_after_the_callers_death(case, trouble) < 2.0 for _ in range(3))
    assert "Resuming: photos is done" in case.run().stderr


def seconds_after_the_callers_death(case: Case, trouble: str) -> float:
    """How long the run goes on."""
    command = [*case.command(trouble, "cameras", 0.05), str(case.write_job())]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    case.done()  # what an earlier run noted is not waited for
    with subprocess.Popen(command, env=case.environment, **pipes) as process:
        try:
            case.wait_for_stage("cameras")
            time.sleep(0.4)
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdout.close()
            process.stdin.close()
            began = time.monotonic()
            assert process.wait(30.0) == 130
            return time.monotonic() - began
        finally:
            process.kill()


@pytest.mark.slow
def test_a_silent_stage_shows_signs_of_life(case: Case) -> None:
    """Counted from the last word before the silence: the start takes as long as its imports."""
    command = [*case.command("hang", "photos"), str(case.write_job())]
    spoken_s: list[float] = []
    with subprocess.Popen(
        command, env=case.environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        heard = None
        for line in process.stdout:
            spoken_s.append(time.monotonic())
            heard = decode(line)
            if isinstance(heard, protocol.Heartbeat):
                break
        process.kill()
    assert isinstance(heard, protocol.Heartbeat)
    assert protocol.HEARTBEAT_S - 0.5 < spoken_s[-1] - spoken_s[-2] < 2 * protocol.HEARTBEAT_S
