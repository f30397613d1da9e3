"""Standard streams that were closed when the program was started, as by `>&-` in a shell."""

import os
import sys
from pathlib import Path

_NOWHERE = Path(os.devnull)


def open_closed_streams() -> None:
    """From now on they lead nowhere.

    Else the file that happens to be opened first would get what libraries print.
    """
    while (descriptor := os.open(_NOWHERE, os.O_RDWR)) <= 2:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)
    sys.stdout = sys.stdout or _NOWHERE.open("w", encoding="utf-8")
    sys.stderr = sys.stderr or _NOWHERE.open("w", encoding="utf-8")
