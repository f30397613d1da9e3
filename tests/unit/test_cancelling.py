"""Signals where the system is another: what Windows has not before Python 3.12 is not asked for there."""

import os
import signal
import threading
from types import SimpleNamespace

import pytest

from backend.commands import cancelling
from backend.commands.cancelling import CancelRequest, watch_signals


def test_windows_needs_no_pipe_that_does_not_block(monkeypatch: pytest.MonkeyPatch) -> None:
    """The bytes that Python writes for signals are written here by hand: the system's own would refuse."""
    heard = threading.Event()
    given: list[int] = []
    monkeypatch.setattr(cancelling, "sys", SimpleNamespace(platform="win32"))
    monkeypatch.setattr(cancelling, "catch_signals", lambda: None)  # pytest's own Ctrl-C stays as it is
    monkeypatch.setattr(signal, "set_wakeup_fd", lambda fd, **_: given.append(fd))
    monkeypatch.delattr(os, "set_blocking")
    request = CancelRequest()
    watch_signals(request, heard.set)
    os.write(given[0], bytes([signal.SIGINT]))
    assert heard.wait(10)
    assert request.is_asked
    os.close(given[0])  # the end of the pipe ends the thread
