"""The caller's side: start a program that speaks the wire, read what it says, stop it, name its death.

Whatever happens, exactly one `Finished` or `Failed` comes out, as the last message: a program that ends
without a last word gets a `Failed` made up from its exit code and the end of its log. Nothing here waits,
so that a user interface can call it from a timer, and what is kept of the program's words has bounds.
Standard library only.
"""

import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from .protocol import (
    CRASHED,
    PROTOCOL_BROKEN,
    Cancel,
    Failed,
    Finished,
    Heartbeat,
    Hello,
    Message,
    Progress,
    ProtocolError,
    decode,
    encode,
)

ROOT = Path(__file__).resolve().parents[2]
"""Folder that holds the package `backend`."""
INTERRUPT_AFTER_S, TERMINATE_AFTER_S, KILL_AFTER_S = 10.0, 15.0, 20.0
"""The ladder after a cancel line that is not obeyed."""
PARTED_S = 5.0
"""For how long a program may outlive its stdout, or a child of it hold that open after its death."""
_LONGEST_LINE_BYTES, _MOST_BYTES = 2**20, 2**22
"""Of one message, and of all but progress and signs of life: a caller keeps those."""
_MOST_WAITING = 1000
"""Messages that the caller has not taken yet; then the program has to wait."""
_WAIT_S = 0.02
_LOG_TAIL_BYTES = 2000
_PLEASE_REPORT = "Check the installation (doctor); where it is ready, please report this with the log."

_WINDOWS_CODES = {
    0xC0000005: "a memory access violation",
    0xC0000135: "a missing DLL",
    0xC0000142: "a DLL that could not start",
    0xC00000FD: "a stack overflow",
    0xC0000017: "too little memory",
}


def backend_command(python: Path | str, *arguments: str) -> tuple[str, ...]:
    """The command that starts the backend beside this file in the given Python."""
    return (str(python), "-m", "backend", *arguments)


class WireProcess:
    """A running program that speaks the wire, most often the backend."""

    def __init__(
        self,
        command: Sequence[str],
        *,
        log_path: Path,
        environment: Mapping[str, str] | None = None,
        noisy_start: bool = False,
    ) -> None:
        """Start the command; its stderr goes to the log file.

        The environment is `clean_environment` of this process's where none is given. With `noisy_start`,
        lines before the program's Hello that are no messages are left out: Blender greets before any
        script runs. Raises OSError where the program cannot be started.
        """
        self._log_path = log_path
        self._noisy_start = noisy_start
        self._messages: queue.SimpleQueue[Message | ProtocolError] = queue.SimpleQueue()
        self._cancelled_s: float | None = None
        self._parted_s: float | None = None
        self._heard_hello = False
        self._ended = False
        log_path.write_bytes(b"")
        with log_path.open("ab") as log:  # to its end, so that the caller may add to it
            self._process = subprocess.Popen(
                list(command),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env=clean_environment(os.environ) if environment is None else dict(environment),
                **own_group(),
            )
        self._reader = threading.Thread(target=self._read, name="wire reader", daemon=True)
        self._reader.start()

    @property
    def is_running(self) -> bool:
        """Whether the last message is still to come."""
        return not self._ended

    def poll(self, limit: int = 1000) -> list[Message]:
        """What the program said since the last call, no more than the limit at once; never waits."""
        self._climb_ladder()
        found: list[Message] = []
        while not self._ended and len(found) < limit and (message := self._next_or_none()) is not None:
            found.append(message)
            self._ended = isinstance(message, Finished | Failed)
        return found

    def cancel(self) -> None:
        """Ask the backend to stop; later calls of `poll` press harder where it does not."""
        if self._cancelled_s is None:
            self._cancelled_s = time.monotonic()
            self._write(encode(Cancel()) + "\n")

    def close(self, timeout_s: float = 3.0) -> None:
        """End the backend now, by closing its stdin and, after the timeout, by force."""
        self._ended = True
        assert self._process.stdin is not None
        with suppress(OSError):  # it is dead already
            self._process.stdin.close()
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            _kill_group(self._process)
            self._process.wait()

    def _next_or_none(self) -> Message | None:
        """The next message; None where it is still to come."""
        silent = not self._reader.is_alive()  # asked first: then all that it heard is on the queue
        try:
            return self._understood(self._messages.get_nowait())
        except queue.Empty:
            return self._end_or_none(silent=silent)

    def _end_or_none(self, *, silent: bool) -> Failed | None:
        """A Failed for a program that has ended without a last word, or has not but will say none."""
        exit_code = self._process.poll()
        if exit_code is None and not silent:
            return None
        if self._parted_s is None:
            self._parted_s = time.monotonic()
        parted = time.monotonic() - self._parted_s > PARTED_S
        if exit_code is not None:
            return describe_crash(exit_code, _tail(self._log_path)) if silent or parted else None
        if not parted:
            return None
        _kill_group(self._process)
        return _crashed(
            "it fell silent and did not end, and was ended", _tail(self._log_path), _PLEASE_REPORT
        )

    def _understood(self, item: Message | ProtocolError) -> Message:
        """The message; a Failed for a line against the protocol."""
        if isinstance(item, ProtocolError) or isinstance(item, Hello) == self._heard_hello:
            _kill_group(self._process)
            reason = item if isinstance(item, ProtocolError) else "the backend did not begin with one hello"
            return Failed(
                code=PROTOCOL_BROKEN,
                text=f"The backend and its caller do not understand each other: {reason}.",
                remedy="Install the backend and the add-on from the same version of FewView.",
            )
        self._heard_hello = True
        return item

    def _read(self) -> None:
        """Put every message on the queue; runs in a thread of its own, whose end is that of stdout."""
        assert self._process.stdout is not None
        heard_message, kept_bytes = False, 0
        with self._process.stdout as stdout:
            while line := stdout.readline(_LONGEST_LINE_BYTES):
                try:
                    message = _message_or_none(line)
                    if message is None:
                        continue
                    if not isinstance(message, Progress | Heartbeat):
                        kept_bytes += len(line)
                    if kept_bytes > _MOST_BYTES:
                        raise ProtocolError("it says too much")
                    self._put(message)
                    heard_message = True
                except (ProtocolError, UnicodeDecodeError) as error:
                    if heard_message or not self._noisy_start:
                        self._put(ProtocolError(str(error)))

    def _put(self, item: Message | ProtocolError) -> None:
        """Onto the queue when the caller has taken enough: until then the pipe fills, not the memory."""
        while self._messages.qsize() >= _MOST_WAITING and not self._ended:
            time.sleep(_WAIT_S)
        if not self._ended:
            self._messages.put(item)

    def _climb_ladder(self) -> None:
        if self._cancelled_s is None or self._process.poll() is not None:
            return
        waited_s = time.monotonic() - self._cancelled_s
        if waited_s > KILL_AFTER_S:
            _kill_group(self._process)
        elif waited_s > TERMINATE_AFTER_S:
            self._process.terminate()
        elif waited_s > INTERRUPT_AFTER_S:
            with suppress(OSError):  # Windows hands it on to programs of the same console alone
                self._process.send_signal(_INTERRUPT)

    def _write(self, text: str) -> None:
        stdin: IO[bytes] | None = self._process.stdin
        assert stdin is not None
        with suppress(OSError):  # it is dead, and the reader will say so
            stdin.write(text.encode())
            stdin.flush()


def clean_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment for a backend: the caller's own Python settings would lead another Python astray."""
    kept = {k: v for k, v in environment.items() if not k.startswith(("PYTHON", "BLENDER_", "__PYVENV"))}
    ours = {
        "PYTHONPATH": str(ROOT),
        "PYTHONSAFEPATH": "1",  # files beside the caller cannot pose as modules
        "PYTHONUTF8": "1",
        "PYTHONNOUSERSITE": "1",
        "PYTHONUNBUFFERED": "1",
        "PYTHONDONTWRITEBYTECODE": "1",  # the folder of an extension is Blender's, not ours to write to
    }
    return {**kept, **ours}


def describe_crash(exit_code: int, log_tail: str) -> Failed:
    """What to say of a backend that ended without a last word."""
    remedy = "Try a faster preset or fewer photographs; if it happens again, please report it with the log."
    if -exit_code == getattr(signal, "SIGKILL", None) or exit_code == 137:
        reason = "it was killed, most likely because the computer ran out of memory"
    elif exit_code < 0:
        reason = f"it was ended by the signal {_signal_name(-exit_code)}"
    elif exit_code in _WINDOWS_CODES:
        reason = f"it was ended by {_WINDOWS_CODES[exit_code]}"
    else:
        reason = f"it ended with exit code {exit_code}"
        remedy = _PLEASE_REPORT
    return _crashed(reason, log_tail, remedy)


def _crashed(reason: str, log_tail: str, remedy: str) -> Failed:
    log = f"\n{log_tail}" if log_tail else ""
    return Failed(code=CRASHED, text=f"The backend ended without a result: {reason}.{log}", remedy=remedy)


def _message_or_none(line: bytes) -> Message | None:
    """The message of a line; None for one that its program's death has cut off.

    Raises ProtocolError, or UnicodeDecodeError.
    """
    if not line.endswith(b"\n"):
        if len(line) < _LONGEST_LINE_BYTES:
            return None
        raise ProtocolError(f"a line is longer than {_LONGEST_LINE_BYTES} bytes")
    return decode(line.decode("utf-8"))


def _signal_name(number: int) -> str:
    known = {member.value: member.name for member in signal.Signals}
    return known.get(number, str(number))


def _tail(path: Path) -> str:
    """The end of the log, in whole lines."""
    try:
        with path.open("rb") as file:
            start = max(file.seek(0, os.SEEK_END) - _LOG_TAIL_BYTES, 0)
            file.seek(start)
            tail = file.read(_LOG_TAIL_BYTES)
    except OSError:
        return ""
    if start:
        tail = tail.partition(b"\n")[2]
    return tail.decode("utf-8", "replace").strip()


if sys.platform == "win32":
    _INTERRUPT = signal.CTRL_BREAK_EVENT

    def own_group() -> dict[str, Any]:
        """Popen options: no Ctrl-C of the caller reaches it, and no window opens."""
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.CREATE_NO_WINDOW}

    def _kill_group(process: subprocess.Popen[bytes]) -> None:
        subprocess.run(["taskkill", "/T", "/F", "/PID", str(process.pid)], check=False, capture_output=True)

else:
    _INTERRUPT = signal.SIGINT

    def own_group() -> dict[str, Any]:
        """Popen options: no Ctrl-C of the caller reaches it, and it can be ended with its children."""
        return {"start_new_session": True}

    def _kill_group(process: subprocess.Popen[bytes]) -> None:
        if process.poll() is None:  # else the number may belong to somebody else by now
            with suppress(ProcessLookupError):  # it may end between the two
                os.killpg(process.pid, signal.SIGKILL)
