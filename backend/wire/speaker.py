"""The backend's side of the wire: messages out on a private descriptor, and signs of life between them."""

import errno
import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from .protocol import HEARTBEAT_S, Heartbeat, Message, encode

_CALLER_GONE = (errno.EPIPE, errno.EINVAL)
"""What a pipe says whose reader has closed it: the second on Windows."""


class Speaker:
    """Writes messages, one a line; when the caller is gone they are dropped."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._lock = threading.Lock()
        self._started_s = time.monotonic()
        self._last_s = self._started_s
        self._silent = threading.Event()

    def say(self, message: Message) -> None:
        """Send the message; may be called from any thread."""
        with self._lock:
            self._write(message)

    def beat(self) -> None:
        """Give a sign of life whenever nothing else was said for a while, until silenced."""
        while not self._silent.wait(max(0.0, self._last_s + HEARTBEAT_S - time.monotonic())):
            with self._lock:
                if not self._silent.is_set() and time.monotonic() - self._last_s >= HEARTBEAT_S:
                    self._write(Heartbeat(elapsed_s=time.monotonic() - self._started_s))

    def silence(self) -> None:
        """End the signs of life: whatever is said next is the last word."""
        with self._lock:
            self._silent.set()

    def _write(self, message: Message) -> None:
        self._last_s = time.monotonic()
        data = (encode(message) + "\n").encode()
        try:
            while data:
                data = data[os.write(self._descriptor, data) :]
        except OSError as error:
            if error.errno not in _CALLER_GONE:
                raise
            self._silent.set()


@contextmanager
def private_stdout() -> Iterator[int]:
    """A private copy of descriptor 1, which then points at stderr: no library's print breaks the wire."""
    private = os.dup(1)
    os.dup2(2, 1)
    try:
        yield private
    finally:
        os.close(private)


@contextmanager
def speaker() -> Iterator[Speaker]:
    """A speaker on the standard output, with its signs of life."""
    with private_stdout() as descriptor:
        speaking = Speaker(descriptor)
        beating = threading.Thread(target=speaking.beat, name="heartbeat", daemon=True)
        beating.start()
        try:
            yield speaking
        finally:
            speaking.silence()
            beating.join()
