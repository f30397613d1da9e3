"""Files that another program holds for a moment; standard library only."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")
PART = ".part"
"""End of the name of a file that is being written."""
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


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """A file beside the path, to write to; it takes the path's place in one step if nothing is raised."""
    part = path.with_name(path.name + PART)
    yield part
    when_let_go(partial(part.replace, path))
