"""The command that reconstructs, for a person on a terminal or for a program on the wire."""

import logging
import os
import platform
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import Cancelled, ErrorCode, ReconstructionError
from ..failures import explain_or_none, internal_error
from ..loading import packages_that_stay
from ..version import VERSION
from ..wire import protocol
from ..wire.speaker import Speaker, speaker
from .cancelling import EXIT_CANCELLED, CancelRequest, catch_signals, watch_signals, watch_stdin

if TYPE_CHECKING:
    from ..pipeline import Job, Listener, Outcome
    from ..presets import Settings
    from ..terminal import TerminalListener

EXIT_FINE, EXIT_INTERNAL, EXIT_USER_ERROR = 0, 1, 2

logger = logging.getLogger(__name__)


def on_terminal(job: protocol.Job, *, stop_with_stdin: bool = False) -> int:
    """Run the job with progress on stderr and the names of the results on stdout; the exit code."""
    return with_terminal(
        lambda listener: listener.finished(Path(job.output), run_job(_checked(job), Path(), listener)),
        cancelled=lambda listener: listener.cancelled(),
        stop_with_stdin=stop_with_stdin,
    )


def with_terminal(
    work: Callable[["TerminalListener"], None],
    *,
    cancelled: Callable[["TerminalListener"], None],
    stop_with_stdin: bool = False,
) -> int:
    """Do the work before a person's eyes, who may stop it; the exit code.

    Give `stop_with_stdin` where a program started it: it is not to outlive that, however it ends.
    """
    try:
        from ..terminal import terminal_listener  # here, because rich may be missing
    except ImportError as error:
        known = explain_or_none(error) or internal_error(error)
        sys.stderr.write(f"Error: {known.text}\n{known.remedy}\n")
        return EXIT_USER_ERROR
    request = CancelRequest()
    with terminal_listener(request) as listener:
        watch_signals(request, listener.stopping)
        if stop_with_stdin:
            watch_stdin(request)
        return settle(lambda: work(listener), failed=listener.failed, cancelled=lambda: cancelled(listener))


def on_wire(job_path: Path) -> int:
    """Run the job of the file with messages on stdout; the exit code."""
    return converse(lambda request, speaking: _run_job_file(job_path, request, speaking), cancelled_message())


def converse(work: Callable[[CancelRequest, Speaker], None], cancelled: protocol.Failed) -> int:
    """Do the work between the first message on stdout and its last; the exit code.

    The work says its own `Finished`; `cancelled` is the last word where it was asked to stop.
    """
    request = CancelRequest()
    with speaker() as speaking:
        speaking.say(hello())
        watch_signals(request, lambda: None)
        watch_stdin(request)
        return settle(
            lambda: work(request, speaking),
            failed=lambda error: say_last(speaking, failed_message(error)),
            cancelled=lambda: say_last(speaking, cancelled),
        )


def converse_or_show(
    work: Callable[["Listener"], "Outcome"], output: Path, *, wire: bool, cancelled: protocol.Failed
) -> int:
    """Do the work for a program on the wire, or before a person's eyes; the exit code.

    `cancelled` is the last word where it was asked to stop.
    """
    if wire:
        return converse(lambda request, speaking: _work_and_say(work, output, request, speaking), cancelled)
    return with_terminal(
        lambda listener: listener.finished(output, work(listener)),
        cancelled=lambda listener: listener.warned(cancelled.text),
    )


def settle(
    work: Callable[[], None],
    *,
    failed: Callable[[ReconstructionError], None],
    cancelled: Callable[[], None],
) -> int:
    """Do the work and tell how it ended; the exit code."""
    try:
        work()
    except Cancelled:
        cancelled()
        return EXIT_CANCELLED
    except Exception as error:  # the border of the program: nothing leaves without words
        known = explain_or_none(error)
        if known is None:
            logger.exception("internal error")
        failed(known or internal_error(error))
        return EXIT_INTERNAL if known is None else EXIT_USER_ERROR
    return EXIT_FINE


def run_job(job: protocol.Job, base: Path, listener: "Listener") -> "Outcome":
    """Reconstruct into the job's output folder."""
    with packages_that_stay():
        from .. import pipeline  # torch may be missing, and doctor must still start
    from ..workspace import open_workspace

    catch_signals()
    resolved = resolve(job, base)
    with open_workspace(resolved.output) as workspace:
        try:
            with _logging_to(workspace.log_path):
                outcome = pipeline.run(
                    resolved,
                    workspace,
                    settings=settings_of(job),
                    stages=pipeline.STAGES,
                    listener=listener,
                )
            if not job.keep_stages:
                workspace.discard_stages()
            return outcome
        except (ReconstructionError, Cancelled):
            workspace.discard_if_nothing_done()
            raise


def resolve(job: protocol.Job, base: Path) -> "Job":
    """The job with paths; relative ones start at base."""
    from ..pipeline import Job

    def path_or_none(name: str | None) -> Path | None:
        return None if name is None else base / name

    return Job(
        images=tuple(base / name for name in job.images),
        output=base / job.output,
        cameras=path_or_none(job.cameras),
        masks=path_or_none(job.masks),
        preset=job.preset,
        device=job.device,
        seed=job.seed,
        truth=path_or_none(job.truth),
        cut_out=job.cut_out,
        until=job.until,
    )


def settings_of(job: protocol.Job) -> "Settings":
    """The preset's settings, with the job's budget, its region where it names one, and without the ground.

    Raises ReconstructionError(SETTINGS_INVALID) where the preset cannot tell the ground.
    """
    from ..presets import PRESETS

    settings = PRESETS[job.preset]
    settings = replace(settings, train=replace(settings.train, budget_s=job.budget_s))
    if job.without_ground:
        if settings.stereo is None:
            text = f"The preset {job.preset} measures no points, so it cannot leave out the ground."
            remedy = "Take fast, balanced or detailed, or keep the ground."
            raise ReconstructionError(ErrorCode.SETTINGS_INVALID, text, remedy)
        settings = replace(settings, stereo=replace(settings.stereo, without_ground=True))
    if job.region_centre is None or job.region_radius is None:
        return settings
    x, y, z = job.region_centre
    region = replace(settings.region, centre_world=(x, y, z), radius_world=job.region_radius)
    return replace(settings, region=region)


def hello() -> protocol.Hello:
    """First message of every conversation."""
    return protocol.Hello(
        protocol=protocol.PROTOCOL_VERSION,
        backend=VERSION,
        python=platform.python_version(),
        pid=os.getpid(),
    )


def failed_message(error: ReconstructionError) -> protocol.Failed:
    """The error as a last message."""
    return protocol.Failed(code=error.code.value, text=error.text, remedy=error.remedy)


def cancelled_message() -> protocol.Failed:
    """The last message of a run that was stopped."""
    return protocol.Failed(
        code=protocol.CANCELLED,
        text="The reconstruction was stopped; finished stages are kept.",
        remedy="Start the same again, and it goes on from there.",
    )


def say_last(speaking: Speaker, message: protocol.Message) -> None:
    """Send a message after which nothing may follow."""
    speaking.silence()
    speaking.say(message)


def _run_job_file(job_path: Path, request: CancelRequest, speaking: Speaker) -> None:
    job, base = _read_job(job_path), job_path.absolute().parent
    _work_and_say(lambda listener: run_job(job, base, listener), base / job.output, request, speaking)


def _work_and_say(
    work: Callable[["Listener"], "Outcome"], output: Path, request: CancelRequest, speaking: Speaker
) -> None:
    from .wire_listener import WireListener

    outcome = work(WireListener(request, speaking))
    say_last(speaking, protocol.Finished(output=str(output), files=outcome.files))


def _checked(job: protocol.Job) -> protocol.Job:
    """The job, if it could have come over the wire; ReconstructionError(SETTINGS_INVALID) otherwise."""
    try:
        protocol.check_paths(job)
        return protocol.decode_job(protocol.encode_job(job))
    except protocol.ProtocolError as error:
        text = f"The job cannot be used: {error}."
        raise ReconstructionError(ErrorCode.SETTINGS_INVALID, text, "Check the options.") from error


def _read_job(path: Path) -> protocol.Job:
    """The job of the file; ReconstructionError(SETTINGS_INVALID) where it is none."""
    remedy = "Write the file as backend/wire/protocol.py describes it."
    try:
        job = protocol.decode_job(path.read_text(encoding="utf-8-sig"))
        protocol.check_paths(job)
        return job
    except (OSError, UnicodeDecodeError, protocol.ProtocolError) as error:
        text = f"The job file {path} cannot be used: {error}."
        raise ReconstructionError(ErrorCode.SETTINGS_INVALID, text, remedy) from error


@contextmanager
def _logging_to(path: Path) -> Iterator[None]:
    """Add what is logged to the file, and the trace of what ends the run."""
    handler = logging.FileHandler(path, encoding="utf-8", errors="backslashreplace")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    root = logging.getLogger()
    root.addHandler(handler)
    logger.info("FewView %s, Python %s, %s", VERSION, platform.python_version(), sys.platform)
    try:
        yield
    except Cancelled:
        logger.info("stopped by the user")
        raise
    except Exception:
        logger.info("the run ended early", exc_info=True)
        raise
    finally:
        root.removeHandler(handler)
        handler.close()
