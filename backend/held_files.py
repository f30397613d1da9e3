"""Files that another program holds for a moment; standard library only."""

import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

T = TypeVar("T")
_TRIES_S = (0.2, 0.5, 1.0, 2.0)
"""Waits between tries: on Windows a virus scanner holds new files for a moment."""


def when_let_go(move: Callable[[], T]) -> T:
    """What `move` gives, a change of a file's name; tried again for a few seconds where Windows refuses it.

    Raises what `move` does.
    """
    for wait_s in _TRIES_S if sys.platform == "win32" else ():
        with suppress(PermissionError):
            return move()
        time.sleep(wait_s)
    return move()
