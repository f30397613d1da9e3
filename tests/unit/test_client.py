"""The process that the add-on talks to: what only a race, only Windows, or a program gone mad shows."""

import errno
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from backend.wire import client
from backend.wire.protocol import CRASHED, PROTOCOL_BROKEN, Failed, Finished, Heartbeat, Message
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


SAYS = """
import os, subprocess, sys, time
def say(text): sys.stdout.write(text + "\\n")
PROGRESS = '{"type": "progress", "stage": "s", "fraction": 0.5, "text": "", "remaining_s": null}'
WARNED, FINISHED = '{"type": "warned", "text": "dark"}', '{"type": "finished", "output": "", "files": []}'
say('{"type": "hello", "protocol": 1, "backend": "0", "python": "3", "pid": 1}')
sys.stdout.flush()
"""


def says(body: str, folder: Path) -> client.WireProcess:
    """A program that says hello and then does what the body says."""
    return client.WireProcess([sys.executable, "-c", SAYS + body], log_path=folder / "log")


def heard_of(process: client.WireProcess, limit_s: float = 15.0) -> list[Message]:
    """All that it says, asked for as a timer does."""
    heard: list[Message] = []
    deadline = time.monotonic() + limit_s
    while process.is_running:
        assert time.monotonic() < deadline, "it did not come to an end"
        began_s = time.monotonic()
        heard += process.poll()
        assert time.monotonic() - began_s < 1.0, "poll waited"
        time.sleep(0.01)
    process.close()
    return heard


def test_a_program_that_closes_its_stdout_and_lives_on_is_ended(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(client, "PARTED_S", 0.3)
    *_, last = heard_of(says("os.close(1); time.sleep(60)", tmp_path))
    assert isinstance(last, Failed)
    assert last.code == CRASHED
    assert "fell silent" in last.text
    assert "memory" not in last.text


@pytest.mark.skipif(sys.platform == "win32", reason="there children do not keep what they were not given")
def test_a_child_that_keeps_stdout_does_not_hide_its_parents_death(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(client, "PARTED_S", 0.3)
    body = """
child = subprocess.Popen(["sleep", "60"], start_new_session=True)
say(WARNED.replace("dark", str(child.pid)))
sys.stdout.flush()
os._exit(3)
"""
    _, child, last = heard_of(says(body, tmp_path))
    os.kill(int(child.text), signal.SIGKILL)  # type: ignore[union-attr]
    assert isinstance(last, Failed)
    assert "exit code 3" in last.text


def test_a_line_without_end_is_not_kept(tmp_path: Path) -> None:
    body = 'while True: os.write(1, b"x" * 65536)'
    *_, last = heard_of(says(body, tmp_path))
    assert isinstance(last, Failed)
    assert last.code == PROTOCOL_BROKEN
    assert "longer than" in last.text


def test_a_message_that_was_cut_off_by_a_death_is_told_as_that(tmp_path: Path) -> None:
    body = "sys.stdout.write(PROGRESS[:20]); sys.stdout.flush(); os._exit(3)"
    *_, last = heard_of(says(body, tmp_path))
    assert isinstance(last, Failed)
    assert last.code == CRASHED
    assert "exit code 3" in last.text


def test_a_flood_of_progress_waits_in_the_program(tmp_path: Path) -> None:
    process = says("for _ in range(100_000): say(PROGRESS)\nsay(FINISHED)", tmp_path)
    time.sleep(1.0)
    assert process._messages.qsize() <= client._MOST_WAITING
    heard = heard_of(process, limit_s=60.0)
    assert len(heard) == 100_002
    assert isinstance(heard[-1], Finished)


def test_a_flood_of_what_is_kept_is_ended(tmp_path: Path) -> None:
    *_, last = heard_of(says("while True: say(WARNED)", tmp_path), limit_s=60.0)
    assert isinstance(last, Failed)
    assert last.code == PROTOCOL_BROKEN
    assert "too much" in last.text


def test_closing_leaves_no_reader_behind(tmp_path: Path) -> None:
    process = says("while True: say(PROGRESS)", tmp_path)
    time.sleep(0.5)
    process.close(timeout_s=0.1)
    process._reader.join(5.0)
    assert not process._reader.is_alive()


def test_what_is_said_of_a_bad_line_is_short(tmp_path: Path) -> None:
    body = """say('{"type": "warned", "text": [' + ", ".join(['"' + "x" * 99 + '"'] * 5000) + "]}")"""
    *_, last = heard_of(says(body, tmp_path))
    assert isinstance(last, Failed)
    assert last.code == PROTOCOL_BROKEN
    assert "warned.text" in last.text
    assert len(last.text) < 1000


def test_of_a_huge_log_the_end_is_read(tmp_path: Path) -> None:
    path = tmp_path / "log"
    with path.open("wb") as file:
        file.truncate(3 * 10**9)  # a hole: it takes no disk, but would take memory
        file.seek(0, os.SEEK_END)
        file.write(b"\nthe last words\n")
    assert client._tail(path) == "the last words"
