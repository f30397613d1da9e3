"""Another program run to its end, line by line, that does not outlive the request to stop.

Standard library only.
"""

import os
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from ..wire.client import own_group
from .cancelling import CancelRequest

_LOOK_S = 0.1
"""Time between two looks at the request to stop."""
_GRACE_S = 0.5
"""From the polite request to the kill: together with _LOOK_S less than cancelling.GRACE_S."""


def run_child(
    command: Sequence[str],
    *,
    environment: Mapping[str, str],
    folder: Path,
    request: CancelRequest,
    on_line: Callable[[str], None],
    errors_too: bool = True,
) -> int:
    """Run the command in the folder and pass on each line that it writes; its exit code.

    With `errors_too` the lines of its stderr are among them, else they go to this program's stderr.
    Its stdin stays open and empty, and its end tells a child that watches it that this program died.
    Raises Cancelled, when the child and its children have been ended, and OSError where there is no
    such program.
    """
    process = subprocess.Popen(
        list(command),
        cwd=folder,
        env=dict(environment),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT if errors_too else None,
        encoding="utf-8",
        errors="replace",
        **own_group(),
    )
    try:
        for line in _lines(process, request):
            on_line(line)
        return process.wait()
    finally:
        _end_group(process)
        assert process.stdin is not None
        process.stdin.close()


def _lines(process: subprocess.Popen[str], request: CancelRequest) -> Any:
    """Each line as it comes, without its break; Cancelled within a moment of the request."""
    lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    assert process.stdout is not None
    threading.Thread(target=_read, args=(process.stdout, lines), name="child", daemon=True).start()
    while True:
        request.check()
        try:
            line = lines.get(timeout=_LOOK_S)
        except queue.Empty:
            continue
        if line is None:
            return
        yield line


def _read(stream: IO[str], lines: "queue.SimpleQueue[str | None]") -> None:
    with stream:
        for line in stream:
            lines.put(line.rstrip("\n"))
    lines.put(None)


if sys.platform == "win32":

    def _end_group(process: subprocess.Popen[str]) -> None:
        if process.poll() is None:
            command = ["taskkill", "/T", "/F", "/PID", str(process.pid)]
            # Not this program's stdin: a program that is given a pipe on which a thread waits may wait too.
            subprocess.run(command, check=False, capture_output=True, stdin=subprocess.DEVNULL)
            process.wait()

else:

    def _end_group(process: subprocess.Popen[str]) -> None:
        if process.poll() is not None:  # its number may belong to somebody else by now
            return
        with suppress(ProcessLookupError):  # it may end between the two
            os.killpg(process.pid, signal.SIGTERM)
        try:
            process.wait(_GRACE_S)
        except subprocess.TimeoutExpired:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
