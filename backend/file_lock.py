"""A lock on a file between programs, which the system takes back when one ends; standard library only."""

import errno
import sys
from typing import BinaryIO

if sys.platform == "win32":
    import msvcrt

    def lock(file: BinaryIO) -> bool:
        """Whether the open file is now locked by this program; False where another one has it."""
        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True

else:
    import fcntl

    def lock(file: BinaryIO) -> bool:
        """Whether the open file is now locked by this program; False where another one has it."""
        try:
            fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            # Some network drives know no locks: work there is better than none.
            return error.errno not in (errno.EWOULDBLOCK, errno.EACCES)
        return True
