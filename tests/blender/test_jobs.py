"""Jobs from Blender's side: what they say is followed, and whatever they do, Blender lives."""

import importlib
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from ticks import assert_ticks_are_quick, tick_until

bpy = pytest.importorskip("bpy", reason="needs Blender's Python, where `import bpy` works")

pytestmark = pytest.mark.blender

HELLO = {"type": "hello", "protocol": 1, "backend": "0", "python": "3", "pid": 1}
PROGRESS = {"type": "progress", "stage": "mesh", "fraction": 0.5, "text": "half", "remaining_s": None}
PROGRAM = """
import sys, time, os
for line in open({lines!r}, encoding="utf-8"):
    sys.stdout.write(line)
sys.stdout.flush()
{then}
"""


@pytest.fixture
def jobs(addon: ModuleType) -> Iterator[ModuleType]:
    found = importlib.import_module(f"{addon.__name__}.jobs")
    found.stop()
    found.forget()
    yield found
    found.stop()


def say(folder: Path, *lines: object, then: str = "") -> tuple[str, ...]:
    """The command of a program that says the lines and then does something."""
    path = folder / "lines"
    texts = [line if isinstance(line, str) else json.dumps(line) for line in lines]
    path.write_text("".join(text + "\n" for text in texts), encoding="utf-8")
    program = folder / "program.py"
    program.write_text(PROGRAM.format(lines=str(path), then=then), encoding="utf-8")
    return (sys.executable, str(program))


def finished(output: object, *files: str) -> dict[str, object]:
    return {"type": "finished", "output": str(output), "files": list(files)}


def run(jobs: ModuleType, folder: Path, command: tuple[str, ...], **options: Any) -> Any:
    """Start the command and follow it to its end."""
    started: list[object] = []

    def on_finished(message: object) -> Iterator[None]:
        started.append(message)
        yield

    options = {"on_finished": on_finished, **options}
    jobs.start("Testing", command, folder=folder, log_path=folder / "log", **options)
    end = jobs.wait()
    assert (end.failure is None) == bool(started) or "on_finished" in options
    return end


def test_what_it_says_is_known(jobs: ModuleType, tmp_path: Path) -> None:
    lines = (HELLO, {"type": "warned", "text": "dark"}, PROGRESS, finished(tmp_path))
    end = run(jobs, tmp_path, say(tmp_path, *lines))
    assert end.failure is None
    assert end.warnings == ("dark",)
    assert jobs.running() is None
    assert jobs.ended() is end


@pytest.mark.parametrize(
    ("lines", "word"),
    [
        ((HELLO, "rubbish"), "not JSON"),
        ((HELLO, {"type": "explode"}), "unknown message"),
        ((HELLO, {**PROGRESS, "fraction": "much"}), "fraction"),
        ((HELLO, '{"type": "heartbeat", "elapsed_s": NaN}'), "NaN"),
        ((HELLO, "[" * 100_000), "not JSON"),
        (({**HELLO, "protocol": 99},), "protocol 99"),
        ((PROGRESS,), "hello"),
        ((HELLO, finished("/etc")), "outside"),
        ((HELLO, finished("..")), "outside"),
        ((HELLO, finished("", "../../secret")), "outside"),
        ((HELLO, finished("", "\0")), "path"),
        ((HELLO,), "without a result"),
        ((), "without a result"),
    ],
)
def test_a_hostile_program_ends_its_job_alone(
    jobs: ModuleType, tmp_path: Path, lines: tuple[object, ...], word: str
) -> None:
    end = run(jobs, tmp_path, say(tmp_path, *lines))
    assert end.failure is not None
    assert word in end.failure.text
    assert jobs.running() is None


def test_huge_numbers_do_no_harm(jobs: ModuleType, tmp_path: Path) -> None:
    huge = [{**PROGRESS, "fraction": value} for value in (1e308, -1e308, 10**400)]
    end = run(jobs, tmp_path, say(tmp_path, HELLO, *huge[:2], finished(tmp_path)))
    assert end.failure is None
    end = run(jobs, tmp_path, say(tmp_path, HELLO, huge[2], finished(tmp_path)))
    assert end.failure is not None


def test_a_preview_outside_is_not_shown(jobs: ModuleType, tmp_path: Path) -> None:
    shown: list[Path] = []

    def show(path: Path) -> Iterator[None]:
        shown.append(path)
        yield

    inside = tmp_path / "preview.ply"
    paths = ["/etc/passwd", str(inside)]
    previews = [{"type": "preview", "path": path} for path in paths]
    program = say(tmp_path, HELLO, *previews[:1], then="time.sleep(0.3)")
    with (tmp_path / "program.py").open("a") as file:
        file.write(f"print({json.dumps(json.dumps(previews[1]))}, flush=True)\ntime.sleep(0.3)\n")
        file.write(f"print({json.dumps(json.dumps(finished(tmp_path)))}, flush=True)\n")
    end = run(jobs, tmp_path, program, on_preview=show)
    assert shown == [inside.resolve()]
    assert any("preview" in text for text in end.warnings)


def test_a_crash_has_a_name_and_its_log(jobs: ModuleType, tmp_path: Path) -> None:
    then = "sys.stderr.write('the last words'); sys.stderr.flush(); os.abort()"
    end = run(jobs, tmp_path, say(tmp_path, HELLO, then=then))
    assert end.failure.code == "crashed"
    assert "the last words" in end.failure.text
    if sys.platform != "win32":
        assert "SIGABRT" in end.failure.text


@pytest.mark.parametrize(
    "error", [ValueError("odd"), OSError("gone"), RuntimeError("removed"), MemoryError()]
)
def test_a_result_that_cannot_be_used_is_a_failure(
    jobs: ModuleType, tmp_path: Path, error: Exception
) -> None:
    def on_finished(_: object) -> Iterator[None]:
        yield
        raise error

    ends: list[str] = []
    end = run(
        jobs,
        tmp_path,
        say(tmp_path, HELLO, finished(tmp_path)),
        on_finished=on_finished,
        on_end=lambda: ends.append("cleaned"),
    )
    assert end.failure.code == "result_refused"
    assert ends == ["cleaned"]


@pytest.mark.parametrize("error", [KeyError("Scene"), ReferenceError("removed"), AssertionError("never")])
def test_a_fault_ends_the_job_and_not_the_timer(jobs: ModuleType, tmp_path: Path, error: Exception) -> None:
    def on_finished(_: object) -> Iterator[None]:
        yield
        raise error

    command = say(tmp_path, HELLO, finished(tmp_path))
    options = {"folder": tmp_path, "log_path": tmp_path / "log", "on_finished": on_finished}
    jobs.start("Testing", command, **options, remedy="Look under the bed.")
    tick_until(jobs, lambda: jobs.running() is None)
    failure = jobs.ended().failure
    assert failure.code == "internal"
    assert type(error).__name__ in failure.text
    assert failure.remedy == f"Look under the bed. The log says more: {tmp_path / 'log'}"
    assert "in on_finished" in (tmp_path / "log").read_text(encoding="utf-8")  # the trace
    jobs.start("Testing", command, **options)  # nothing is "still running"


@pytest.mark.parametrize("preview", [True, False])
def test_a_fault_beside_the_result_does_not_lose_it(jobs: ModuleType, tmp_path: Path, preview: bool) -> None:
    def fails(*_: object) -> Iterator[None]:
        raise KeyError("gone")

    shown = {"type": "preview", "path": str(tmp_path / "preview.ply")}
    then = f"time.sleep(0.3); print({json.dumps(json.dumps(finished(tmp_path)))}, flush=True)"
    end = run(
        jobs,
        tmp_path,
        say(tmp_path, HELLO, shown, then=then),
        **{"on_preview" if preview else "on_end": fails},
    )
    assert end.failure is None
    assert [text for text in end.warnings if "KeyError" in text]
    assert "gone" in (tmp_path / "log").read_text(encoding="utf-8")


def test_a_fault_while_the_program_speaks(
    jobs: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jobs, "_take_in", lambda *_: {}["missing"])
    end = run(jobs, tmp_path, say(tmp_path, HELLO, then="sys.stdin.readline()"))
    assert end.failure.code == "internal"
    assert jobs.running() is None


def test_one_at_a_time(jobs: ModuleType, tmp_path: Path) -> None:
    command = say(tmp_path, HELLO, then="time.sleep(60)")
    options = {"folder": tmp_path, "log_path": tmp_path / "log", "on_finished": lambda _: iter(())}
    jobs.start("Testing", command, **options)
    with pytest.raises(jobs.JobError, match="still running"):
        jobs.start("Testing", command, **options)
    jobs.stop()
    jobs.start("Testing", command, **options)


def test_a_program_that_is_not_there(jobs: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(jobs.JobError, match="cannot be started"):
        jobs.start(
            "Testing",
            (str(tmp_path / "none"),),
            folder=tmp_path,
            log_path=tmp_path / "log",
            on_finished=lambda _: iter(()),
        )
    assert jobs.running() is None


def test_the_timer_is_quick_and_comes_to_the_end(jobs: ModuleType, tmp_path: Path) -> None:
    command = say(tmp_path, HELLO, *[PROGRESS] * 2000, finished(tmp_path))

    def on_finished(_: object) -> Iterator[None]:
        for _step in range(20):
            time.sleep(0.004)
            yield

    def run_a_job() -> None:
        jobs.start("Testing", command, folder=tmp_path, log_path=tmp_path / "log", on_finished=on_finished)
        tick_until(jobs, lambda: jobs.ended() is not None)
        assert jobs.ended().failure is None

    assert_ticks_are_quick(jobs, run_a_job)


def test_a_flood_of_progress_holds_nobody_up(jobs: ModuleType, tmp_path: Path) -> None:
    command = say(tmp_path, HELLO, *[PROGRESS] * 100_000, finished(tmp_path))
    jobs.start("Testing", command, folder=tmp_path, log_path=tmp_path / "log", on_finished=lambda _: iter(()))
    tick_until(jobs, lambda: jobs.ended() is not None)
    assert jobs.ended().failure is None


def test_cancel_is_answered_at_once(jobs: ModuleType, tmp_path: Path) -> None:
    stage = {"type": "stage", "name": "mesh", "index": 1, "count": 1}
    failed = {"type": "failed", "code": "cancelled", "text": "Stopped.", "remedy": ""}
    then = f"sys.stdin.readline(); print({json.dumps(json.dumps(failed))}, flush=True)"
    command = say(tmp_path, HELLO, stage, then=then)
    jobs.start("Testing", command, folder=tmp_path, log_path=tmp_path / "log", on_finished=lambda _: iter(()))
    tick_until(jobs, lambda: jobs.running().stage == "mesh")
    started = time.monotonic()
    jobs.cancel()
    assert jobs.running().cancelling
    tick_until(jobs, lambda: jobs.ended() is not None)
    assert time.monotonic() - started < 1.0
    assert jobs.ended().cancelled


def test_a_program_that_has_to_be_stopped_by_force_was_stopped(
    addon: ModuleType, jobs: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a long call of a library, where no cancel is heard."""
    client = importlib.import_module(f"{addon.__name__.rpartition('.')[0]}.backend.wire.client")
    for name, seconds in (("INTERRUPT_AFTER_S", 0.1), ("TERMINATE_AFTER_S", 0.2), ("KILL_AFTER_S", 0.3)):
        monkeypatch.setattr(client, name, seconds)
    stage = {"type": "stage", "name": "cameras", "index": 1, "count": 1}
    command = say(tmp_path, HELLO, stage, then="time.sleep(60)")
    jobs.start("Testing", command, folder=tmp_path, log_path=tmp_path / "log", on_finished=lambda _: iter(()))
    tick_until(jobs, lambda: jobs.running().stage == "cameras")
    jobs.cancel()
    tick_until(jobs, lambda: jobs.ended() is not None)
    assert jobs.ended().cancelled
    assert "force" in jobs.ended().failure.text


def test_another_file_keeps_the_job_off_the_scene(jobs: ModuleType, tmp_path: Path) -> None:
    touched: list[str] = []

    def on_finished(_: object) -> Iterator[None]:
        touched.append("scene")
        yield

    command = say(
        tmp_path, HELLO, then=f"sys.stdin.readline(); print({json.dumps(json.dumps(finished(tmp_path)))})"
    )
    options = {"folder": tmp_path, "log_path": tmp_path / "log", "on_finished": on_finished}
    jobs.start("Testing", command, **options, remedy="It lies in the drawer.")
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    assert jobs.running() is not None
    jobs.cancel()  # here it makes the program finish
    tick_until(jobs, lambda: jobs.ended() is not None)
    assert jobs.ended().failure is None
    assert touched == []
    assert jobs.ended().warnings == ("Another file was opened meanwhile. It lies in the drawer.",)


def test_switching_the_add_on_off_ends_the_job(addon: ModuleType, jobs: ModuleType, tmp_path: Path) -> None:
    then = f"open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); sys.stdin.readline()"
    jobs.start(
        "Testing",
        say(tmp_path, HELLO, then=then),
        folder=tmp_path,
        log_path=tmp_path / "log",
        on_finished=lambda _: iter(()),
    )
    process = jobs.running().process
    addon.unregister()
    try:
        assert jobs.running() is None
        assert process._process.poll() is not None
        assert not bpy.app.timers.is_registered(jobs._tick)
    finally:
        addon.register()
