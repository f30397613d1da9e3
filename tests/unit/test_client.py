"""The process that the add-on talks to: what only a race, or only Windows, shows."""

import errno
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from backend.wire import client
from backend.wire.protocol import Heartbeat
from backend.wire.speaker import Speaker


@pytest.mark.skipif(sys.platform == "win32", reason="process groups are POSIX")
def test_a_group_that_ends_while_it_is_killed_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    process = subprocess.Popen([sys.executable, "-c", ""], start_new_session=True)
    process.wait()
    # What poll() says while another thread is inside wait().
    monkeypatch.setattr(process, "poll", lambda: None)
    client._kill_group(process)


@pytest.mark.parametrize("number", [errno.EPIPE, errno.EINVAL])
def test_words_to_a_caller_that_is_gone_are_dropped(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """The second is what Windows says of such a pipe."""

    def refuse(*_: object) -> int:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("backend.wire.speaker.os.write", refuse)
    speaking = Speaker(1)
    speaking.say(Heartbeat(elapsed_s=0.0))
    speaking.beat()  # ends at once


def test_other_troubles_of_the_pipe_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("backend.wire.speaker.os.write", refuse)
    with pytest.raises(OSError, match="No space"):
        Speaker(1).say(Heartbeat(elapsed_s=0.0))


def test_an_interrupt_that_cannot_be_sent_is_no_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Windows refuses it where the caller has no console; harder means follow."""
    process = client.WireProcess(
        [sys.executable, "-c", "import sys; sys.stdin.read()"], log_path=tmp_path / "log"
    )

    def refuse(_number: int) -> None:
        raise OSError(6, "The handle is invalid")

    monkeypatch.setattr(process._process, "send_signal", refuse)
    process.cancel()
    assert process._cancelled_s is not None
    process._cancelled_s = time.monotonic() - client.INTERRUPT_AFTER_S - 0.1
    process.poll()
    process.close()
