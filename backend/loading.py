"""How packages are loaded: what they hold stays, so nothing looks through it for what could go."""

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def packages_that_stay() -> Iterator[None]:
    """Inside it torch and all that uses it are imported; nothing happens where torch is there already.

    They make half a million objects. Python would go through them again and again while there are ever more,
    and once more at the end of the program: of the 3.5 s of both on one core, that was 1 s.
    """
    if "torch" in sys.modules:
        yield
        return
    gc.disable()
    try:
        yield
        gc.freeze()
    finally:
        gc.enable()
