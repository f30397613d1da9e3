"""From exceptions of the system and of libraries to words a user understands; standard library only."""

import errno

from .errors import ErrorCode, ReconstructionError

_MEMORY_WORDS = ("out of memory", "not enough memory", "can't allocate memory", "cannot allocate memory")
"""What torch says on its CUDA, CPU (Windows and Linux) and MPS paths, in a plain RuntimeError."""

_MISNAMED = (errno.ENAMETOOLONG, errno.EACCES)
"""What paths say that are no paths, as a list of files in one word is none, or that are somebody else's."""


def explain_or_none(error: Exception) -> ReconstructionError | None:
    """The failure as a ReconstructionError; None where it is a fault of the program."""
    if isinstance(error, ReconstructionError):
        return error
    if isinstance(error, ImportError) and not (error.name or "").startswith("backend"):
        return ReconstructionError(
            ErrorCode.MISSING_DEPENDENCY,
            f"A package that the reconstruction needs cannot be loaded: {error}.",
            "Check the installation (doctor), which says what is missing, and install it again.",
        )
    if _is_out_of_memory(error):
        return ReconstructionError(
            ErrorCode.OUT_OF_MEMORY,
            "The computer ran out of memory.",
            "Use a faster preset or fewer photographs, or close other programs.",
        )
    if isinstance(error, OSError) and is_disk_full(error):
        return ReconstructionError(
            ErrorCode.DISK_FULL,
            "The disk is full.",
            "Free some space and start the same again.",
        )
    if isinstance(error, OSError) and error.errno in _MISNAMED and error.filename is not None:
        return ReconstructionError(
            ErrorCode.SETTINGS_INVALID,
            f"{error.filename} cannot be looked at ({error.strerror}).",
            "Check the path, and that you may use what is there.",
        )
    return None


def internal_error(error: Exception) -> ReconstructionError:
    """What to tell the user about a fault of the program."""
    return ReconstructionError(
        ErrorCode.INTERNAL,
        f"FewView failed unexpectedly: {type(error).__name__}: {error}",
        "Please report this with the log; that of a reconstruction is log.txt in its output folder.",
    )


def output_unusable(error: OSError, text: str, remedy: str) -> Exception:
    """What to raise where the file system refuses to write; a full disk stays what it is."""
    return error if is_disk_full(error) else ReconstructionError(ErrorCode.OUTPUT_UNUSABLE, text, remedy)


def first_line(error: Exception) -> str:
    """What an error says, without the advice for programmers that torch puts below it."""
    return str(error).partition("\n")[0]


def is_disk_full(error: OSError) -> bool:
    """Whether the disk, or the user's share of it, has no room left."""
    return error.errno in (errno.ENOSPC, errno.EDQUOT)


def _is_out_of_memory(error: Exception) -> bool:
    if isinstance(error, MemoryError):
        return True
    return isinstance(error, RuntimeError) and any(words in str(error).lower() for words in _MEMORY_WORDS)
