"""The one job that runs: how it is started, followed, cancelled, and how the last one ended.

A job is a program that speaks the wire: the backend, or a second Blender that renders. In a window an app
timer follows it and never takes long; in background mode, where timers do not run, `follow` waits. This
state is Python's alone: no .blend holds it, and loading a file or undoing does not touch it.
"""

import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import bpy

from ..backend.errors import ErrorCode
from ..backend.wire.client import WireProcess
from ..backend.wire.protocol import (
    CANCELLED,
    CRASHED,
    Checked,
    Failed,
    Finished,
    Message,
    Preview,
    Progress,
    Stage,
    Warned,
)
from .job_folder import FolderError, inside
from .progress import total_share

TICK_S = 0.1
"""Time between two looks at a running job."""
_BUDGET_S = 0.008
"""Of one look; what is left waits for the next. Single steps of an import may take longer."""
_MESSAGES_PER_TICK = 1000
_REFUSED = "result_refused"
"""Code of a failure on this side: what came back could not be used."""
_EXPECTED = (FolderError, ValueError, OSError, RuntimeError, MemoryError)
"""What work on the scene raises with a sentence for the user; anything else is a fault of the program."""

Steps = Iterator[None]
"""Work on the scene in steps that are short enough for a timer."""


class JobError(RuntimeError):
    """A job that cannot be started, in a sentence for the user."""


@dataclass(kw_only=True)
class RunningJob:
    """What is known of the job that runs."""

    title: str
    process: WireProcess
    folder: Path
    """Every file that the job names lies in here."""
    log_path: Path
    on_finished: Callable[[Finished], Steps]
    on_preview: Callable[[Path], Steps] | None
    on_end: Callable[[], None] | None
    about_scene: bool
    """Whether what comes back belongs to the file that is open."""
    remedy: str
    """How the user gets at its result where that cannot be shown, in a sentence."""
    started_s: float = field(default_factory=time.monotonic)
    stage: str = ""
    stages_before: list[str] = field(default_factory=list)
    stage_index: int = 0
    stage_count: int = 0
    fraction: float = 0.0
    """Of the stage."""
    text: str = ""
    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    """What the user should know where all is well."""
    checks: list[Checked] = field(default_factory=list)
    cancelling: bool = False
    heard_s: float = field(default_factory=time.monotonic)
    """When the program last said anything."""
    pending: Steps | None = None
    finished: bool = False

    @property
    def share(self) -> float:
        """Of the whole job, 0 to 1."""
        if not self.stage_count:
            return 0.0
        return total_share(self.stages_before, self.stage, self.stage_count - self.stage_index, self.fraction)

    @property
    def silent_s(self) -> float:
        """For how long it has said nothing."""
        return time.monotonic() - self.heard_s

    @property
    def elapsed_s(self) -> float:
        """Since it was started."""
        return time.monotonic() - self.started_s


@dataclass(frozen=True, kw_only=True)
class EndedJob:
    """How a job ended."""

    title: str
    failure: Failed | None
    warnings: tuple[str, ...]
    checks: tuple[Checked, ...]
    log_path: Path
    seconds: float
    notes: tuple[str, ...] = ()

    @property
    def cancelled(self) -> bool:
        """Whether it ended because the user asked for it."""
        return self.failure is not None and self.failure.code == CANCELLED


_running: RunningJob | None = None
_ended: EndedJob | None = None
longest_tick_s = 0.0
"""The longest that the timer has kept Blender from its user, for the tests."""


def running() -> RunningJob | None:
    """The job that runs now."""
    return _running


def ended() -> EndedJob | None:
    """The job that ended last; None after `forget`."""
    return _ended


def forget() -> None:
    """Show no more how the last job ended."""
    global _ended
    _ended = None


def start(
    title: str,
    command: Sequence[str],
    *,
    folder: Path,
    log_path: Path,
    on_finished: Callable[[Finished], Steps],
    on_preview: Callable[[Path], Steps] | None = None,
    on_end: Callable[[], None] | None = None,
    about_scene: bool = True,
    remedy: str = "Start it again.",
    environment: Mapping[str, str] | None = None,
    noisy_start: bool = False,
) -> None:
    """Start a job; `follow` must be called next.

    `on_finished` and `on_preview` work on the scene in short steps, `on_end` cleans up however the job
    ended, `remedy` says where its result is if it cannot be shown. Raises JobError where a job runs
    already or this one cannot be started.
    """
    global _running, _ended, longest_tick_s
    if _running is not None:
        raise JobError(f"{_running.title} is still running; wait for it or cancel it")
    try:
        process = WireProcess(command, log_path=log_path, environment=environment, noisy_start=noisy_start)
    except OSError as error:
        raise JobError(f"{command[0]} cannot be started ({error.strerror or error})") from error
    _ended = None
    longest_tick_s = 0.0
    _running = RunningJob(
        title=title,
        process=process,
        folder=folder,
        log_path=log_path,
        on_finished=on_finished,
        on_preview=on_preview,
        on_end=on_end,
        about_scene=about_scene,
        remedy=remedy,
    )


def warn(texts: Iterable[str]) -> None:
    """Add to what the user is told of the running job, each sentence once."""
    if _running is not None:
        _running.warnings += [text for text in texts if text not in _running.warnings]


def follow(operator: bpy.types.Operator) -> set[str]:
    """What the operator that started the job returns; without a window it waits for the job's end."""
    if not bpy.app.background:
        bpy.app.timers.register(_tick, first_interval=TICK_S, persistent=True)
        return {"FINISHED"}
    end = wait()
    for text in end.warnings:
        operator.report({"WARNING"}, text)
    for text in end.notes:
        operator.report({"INFO"}, text)
    if end.failure is None:
        return {"FINISHED"}
    operator.report({"ERROR"}, f"{end.failure.text} {end.failure.remedy}".strip())
    return {"CANCELLED"}


def wait() -> EndedJob:
    """Follow the running job to its end, with its progress on stderr; Ctrl-C cancels it."""
    assert _running is not None
    before = signal.signal(signal.SIGINT, lambda *_: cancel())
    shown = ""
    try:
        while _running is not None:
            line = f"{_running.stage} {_running.text}".strip()
            if line and line != shown:
                sys.stderr.write(f"FewView: {line}\n")
                shown = line
            _advance(None)
            time.sleep(0.02)
    finally:
        # None: somebody outside of Python, such as Blender's command line, had set one.
        signal.signal(signal.SIGINT, signal.SIG_DFL if before is None else before)
    assert _ended is not None
    return _ended


def cancel() -> None:
    """Ask the running job to stop."""
    if _running is not None:
        _running.cancelling = True
        _running.process.cancel()


def stop() -> None:
    """End the running job at once: the add-on is switched off."""
    job = _running
    close()
    if job is not None:
        _clean_up(job)
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)


def close() -> None:
    """End the running job's program and touch nothing of Blender, which may be quitting."""
    global _running
    if _running is not None:
        _running.process.close()
        _running = None


def detach(reason: str) -> None:
    """Let the running job go on without touching the scene: its results stay in its folder."""
    job = _running
    if job is not None and job.about_scene:
        job.warnings.append(f"{reason} {job.remedy}")
        job.on_preview, job.on_finished, job.on_end = None, lambda _: iter(()), None
        job.pending = None if job.pending is None else iter(())


def log_path() -> Path | None:
    """Log of the running job, or of the one that ended last."""
    job = _running or _ended
    return None if job is None else job.log_path


def redraw() -> None:
    """Have the panels drawn again, and not the scene beside them: that may cost the job its time."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            for region in area.regions:
                if (area.type, region.type) in {("VIEW_3D", "UI"), ("PREFERENCES", "WINDOW")}:
                    region.tag_redraw()


def _tick() -> float | None:
    """The timer's callback: a short look at the job, and again after TICK_S while it runs."""
    global longest_tick_s
    started = time.perf_counter()
    changed = _advance(started + _BUDGET_S)
    if changed:
        redraw()
    longest_tick_s = max(longest_tick_s, time.perf_counter() - started)
    if _running is None:
        return None
    return 0.0 if _running.pending is not None else TICK_S


def _advance(deadline: float | None) -> bool:
    """Take in what the job said and go on with its steps; whether anything happened."""
    job = _running
    if job is None:
        return False
    try:
        return _go_on(job, deadline)
    except Exception as error:  # noqa: BLE001 - the border to Blender: a timer that raises never comes back
        _end(job, _failed_here(job, error))
        return True


def _go_on(job: RunningJob, deadline: float | None) -> bool:
    """As `_advance`; raises what the last steps raise."""
    if job.pending is None and not job.finished:
        messages = job.process.poll(_MESSAGES_PER_TICK)
        for message in messages:
            _take_in(job, message)
        if not messages:
            return False
    while job.pending is not None and _running is job:
        _step(job)
        if deadline is not None and time.perf_counter() >= deadline:
            break
    if job.finished and job.pending is None and _running is job:
        _end(job, None)
    return True


def _step(job: RunningJob) -> None:
    """One step of work on the scene; a preview that fails is left out."""
    assert job.pending is not None
    try:
        next(job.pending)
    except StopIteration:
        job.pending = None
    except Exception as error:
        job.pending = None
        if job.finished:
            raise
        job.warnings.append(f"A preview could not be shown: {_words(job, error)}")


def _take_in(job: RunningJob, message: Message) -> None:
    job.heard_s = time.monotonic()
    match message:
        case Stage():
            if job.stage:
                job.stages_before.append(job.stage)
            job.stage, job.stage_index, job.stage_count = message.name, message.index, message.count
            job.fraction, job.text = 0.0, ""
        case Progress():
            job.fraction, job.text = min(max(message.fraction, 0.0), 1.0), message.text
        case Warned():
            job.warnings.append(message.text)
        case Checked():
            job.checks.append(message)
        case Preview() if job.on_preview is not None:
            job.pending = _checked(job, Path(message.path), job.on_preview)
        case Finished():
            job.finished = True
            job.pending = _finishing(job, message)
        case Failed(code=code) if code == CRASHED and job.cancelling:
            # it did not answer, and was made to end; a crash of its own would be no news to who stops it
            _end(job, Failed(code=CANCELLED, text="It was stopped, by force.", remedy="Start it again."))
        case Failed():
            _end(job, message)


def _checked(job: RunningJob, path: Path, show: Callable[[Path], Steps]) -> Steps:
    yield from show(inside(job.folder, path))


def _finishing(job: RunningJob, message: Finished) -> Steps:
    output = inside(job.folder, Path(message.output or job.folder))
    for name in message.files:
        inside(output, output / name)
    yield from job.on_finished(message)


def _failed_here(job: RunningJob, error: Exception) -> Failed:
    """What to say of an error on this side."""
    words = _words(job, error)
    if isinstance(error, _EXPECTED):
        text, code = f"What came back cannot be used: {words}.", _REFUSED
    else:
        text, code = f"FewView failed unexpectedly: {words}.", ErrorCode.INTERNAL.value
    return Failed(code=code, text=text, remedy=f"{job.remedy} The log says more: {job.log_path}")


def _words(job: RunningJob, error: Exception) -> str:
    """The error in words; where it is a fault of the program, its trace goes to the log and the console."""
    if isinstance(error, _EXPECTED) and str(error):
        return str(error).rstrip(".")
    trace = "".join(traceback.format_exception(error))
    sys.stderr.write(trace)
    with suppress(OSError), job.log_path.open("a", encoding="utf-8") as log:
        log.write(trace)
    return f"{type(error).__name__}: {error}".rstrip(": ")


def _clean_up(job: RunningJob) -> None:
    """What the job does at its end, however it ended; a failure in it keeps nobody from the next job."""
    if job.on_end is not None:
        try:
            job.on_end()
        except Exception as error:  # noqa: BLE001 - the same border
            job.warnings.append(f"Something of the job was left behind: {_words(job, error)}")


def _end(job: RunningJob, failure: Failed | None) -> None:
    """Keep how the job ended."""
    global _running, _ended
    # In a thread: a program that has said its last word may take a second to end.
    threading.Thread(target=job.process.close, name="job's end", daemon=True).start()
    _running = None
    _clean_up(job)
    _ended = EndedJob(
        title=job.title,
        failure=failure,
        warnings=tuple(job.warnings),
        checks=tuple(job.checks),
        log_path=job.log_path,
        seconds=job.elapsed_s,
        notes=tuple(job.notes),
    )
    redraw()
