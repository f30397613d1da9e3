"""How a run is asked to stop: Ctrl-C, a line on stdin, or the end of stdin.

The first request sets a flag that the next progress call turns into Cancelled, so that the run ends
between two steps with its finished stages kept. The second Ctrl-C ends the process at once, as does the
caller's death after a moment: checkpoints are written atomically, so nothing is half-written.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable

from ..errors import Cancelled
from ..wire.protocol import Cancel, ProtocolError, decode

EXIT_CANCELLED = 130
"""The shell's code for a program ended by Ctrl-C."""
GRACE_S = 1.0
"""How long a run whose caller has died may take to end by itself; the promise is 2 s."""
_CAUGHT = {signal.SIGINT, signal.SIGTERM}
if sys.platform == "win32":
    _CAUGHT.add(signal.SIGBREAK)
_SHOW_CURSOR = b"\x1b[?25h\n"


class CancelRequest:
    """Whether somebody wants the run to stop."""

    def __init__(self) -> None:
        self._asked = threading.Event()

    def ask(self) -> None:
        """Ask the run to stop; may be called from any thread, and twice."""
        self._asked.set()

    @property
    def is_asked(self) -> bool:
        """Whether anybody asked."""
        return self._asked.is_set()

    def check(self) -> None:
        """Raise Cancelled if the run was asked to stop."""
        if self.is_asked:
            raise Cancelled


def watch_signals(request: CancelRequest, on_first: Callable[[], None]) -> None:
    """From now on Ctrl-C and a polite kill ask the run to stop, and the second one ends the process.

    A thread reads the signals from a pipe that the C level of Python fills: handlers in Python wait until
    a long call of a library returns, which is just when the user loses patience.
    """
    reader, writer = os.pipe()
    if sys.platform != "win32":  # there pipes know it since Python 3.12 alone, and nobody asks for it
        os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    catch_signals()

    def watch() -> None:
        while received := os.read(reader, 64):
            for number in received:
                if number not in _CAUGHT:
                    continue
                if request.is_asked:
                    if os.isatty(2):
                        os.write(2, _SHOW_CURSOR)  # the progress bar has hidden it
                    os._exit(EXIT_CANCELLED)
                request.ask()
                on_first()

    threading.Thread(target=watch, name="signals", daemon=True).start()


def catch_signals() -> None:
    """Keep Ctrl-C and a polite kill from ending the process; called again after imports.

    The log library inside pycolmap takes the polite kill for itself when it is loaded.
    """
    for number in _CAUGHT:
        signal.signal(number, lambda *_: None)


def watch_stdin(request: CancelRequest) -> None:
    """From now on a cancel line on stdin asks the run to stop, and so does the end of stdin."""

    def watch() -> None:
        # os.read, not sys.stdin: a thread inside a buffered reader breaks the interpreter's exit.
        pending = b""
        while received := _read_or_end(0):
            *lines, pending = (pending + received).split(b"\n")
            if any(_is_cancel(line) for line in lines):
                request.ask()
        request.ask()
        timer = threading.Timer(GRACE_S, os._exit, (EXIT_CANCELLED,))
        timer.daemon = True
        timer.start()

    threading.Thread(target=watch, name="stdin", daemon=True).start()


def _read_or_end(descriptor: int) -> bytes:
    try:
        return os.read(descriptor, 4096)
    except OSError:  # closed from the start, as under some service managers
        return b""


def _is_cancel(line: bytes) -> bool:
    """Whether the line is a cancel message; what is not understood is not obeyed."""
    try:
        return isinstance(decode(line.decode()), Cancel)
    except (ProtocolError, UnicodeDecodeError):
        return False
