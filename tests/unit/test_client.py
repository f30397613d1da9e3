"""The process that the add-on talks to: what only a race shows."""

import subprocess
import sys

import pytest

from backend.wire import client


@pytest.mark.skipif(sys.platform == "win32", reason="process groups are POSIX")
def test_a_group_that_ends_while_it_is_killed_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    process = subprocess.Popen([sys.executable, "-c", ""], start_new_session=True)
    process.wait()
    # What poll() says while another thread is inside wait().
    monkeypatch.setattr(process, "poll", lambda: None)
    client._kill_group(process)
