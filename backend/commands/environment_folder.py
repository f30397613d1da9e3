"""The folders of a managed environment: whose they are, and how they are made, put in place and removed.

Only folders with the installer's marker in them are ever changed. Standard library only.
"""

import json
import ntpath
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ..errors import ErrorCode, ReconstructionError
from ..failures import output_unusable
from ..file_lock import lock
from ..held_files import when_let_go
from ..wire.environment import LOCK, MARKER, OLD, PART, beside, is_ours, needed_bytes

_LONGEST_NAME = 173
"""Characters of a file's path within site-packages, at most: those of licences in torch 2.13.0+cu130."""
_LONGEST_PATH = 259
"""What Windows takes, unless long paths are switched on."""


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """The environment's folder, locked against other installers, with a half-done exchange undone.

    Raises ReconstructionError(OUTPUT_UNUSABLE) where somebody else's files are in the way, the place can
    not be written, or another installer works there.
    """
    check_ours(folder, beside(folder, PART), beside(folder, OLD))
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        file = beside(folder, LOCK).open("ab")
    except OSError as error:
        raise _not_writable(folder, error) from error
    with file:
        if not lock(file):
            raise ReconstructionError(
                ErrorCode.OUTPUT_UNUSABLE,
                f"Another installation is working on {folder}.",
                "Wait until it ends, or choose another folder.",
            )
        old = beside(folder, OLD)
        if old.exists() and not folder.exists():
            old.rename(folder)
        yield


def check_ours(*folders: Path) -> None:
    """ReconstructionError(OUTPUT_UNUSABLE) where one of them is there and was not made by the installer."""
    for folder in folders:
        if not os.path.lexists(folder) or is_ours(folder) or _is_empty_folder(folder):
            continue
        raise ReconstructionError(
            ErrorCode.OUTPUT_UNUSABLE,
            f"{folder} is there and was not made by FewView, so it is left as it is.",
            "Choose a new folder for the environment.",
        )


def check_length(folder: Path) -> None:
    """ReconstructionError(OUTPUT_UNUSABLE) where Windows takes no paths as long as those of the packages."""
    packages = beside(folder, PART) / "Lib" / "site-packages"
    surplus = len(str(packages)) + 1 + _LONGEST_NAME - _LONGEST_PATH
    if surplus > 0 and not takes_long_paths():
        raise ReconstructionError(
            ErrorCode.OUTPUT_UNUSABLE,
            f"The path of {folder} is {surplus} characters too long: torch has files with long names, and "
            f"Windows takes paths of {_LONGEST_PATH} characters.",
            "Choose a shorter Environment Folder in the add-on's preferences, such as C:\\fewview, "
            "or switch on long paths in Windows.",
        )


def check_space(folder: Path, build: str) -> None:
    """ReconstructionError(DISK_FULL) where the disk is too small for what is still to come."""
    place = next(path for path in folder.parents if path.exists())
    part = beside(folder, PART)
    needed = needed_bytes(build) - (_size_bytes(part) if part.is_dir() else 0)
    free = shutil.disk_usage(place).free
    if free < needed:
        raise ReconstructionError(
            ErrorCode.DISK_FULL,
            f"{free / 1e9:.1f} GB are free on the disk of {place}; "
            f"the environment needs about {needed / 1e9:.1f} GB while it is made.",
            "Free some space, or choose a folder on another disk.",
        )


def begin_part(part: Path, note: dict[str, object]) -> bool:
    """Make the folder ready to be filled; whether one that was begun for the same note is continued."""
    if is_ours(part) and read_json(part / MARKER) == note:
        return True
    try:
        remove(part)
        part.mkdir()
        write_json(part / MARKER, note)
    except OSError as error:
        raise _not_writable(part, error) from error
    return False


def put_in_place(part: Path, folder: Path) -> str:
    """Rename the finished part; what was at its place goes. A warning where that left something behind.

    The folder is never half-made: it is the old one, the new one or, for a moment, not there. Raises
    ReconstructionError(OUTPUT_UNUSABLE), with the old one back in its place.
    """
    old = beside(folder, OLD)
    try:
        remove(old)
        if folder.exists():
            _rename(folder, old)
        try:
            _rename(part, folder)
        except OSError:
            if old.exists():
                _rename(old, folder)
            raise
    except OSError as error:
        raise _not_writable(folder, error) from error
    return _removed_or_warning(old)


def take_away(folder: Path) -> str:
    """Remove the environment and what is left of others; a warning where something is left behind."""
    old = beside(folder, OLD)
    try:
        remove(old)
        if folder.exists():
            _rename(folder, old)
    except OSError as error:
        raise _not_writable(folder, error) from error
    return " ".join(filter(None, map(_removed_or_warning, (old, beside(folder, PART)))))


def remove(folder: Path) -> None:
    """Remove a folder of ours or an empty one, the marker last, so that a half-removed one stays ours."""
    if not os.path.lexists(folder):
        return
    check_ours(folder)
    empty(folder)
    (folder / MARKER).unlink(missing_ok=True)
    folder.rmdir()


def empty(folder: Path) -> None:
    """Remove what is in a folder of ours, but for the marker."""
    for entry in list(Path(unlimited(str(folder))).iterdir()):
        if entry.name == MARKER:
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        else:
            entry.unlink()


if sys.platform == "win32":

    def takes_long_paths() -> bool:
        """Whether paths may be as long as they like, which a setting of Windows says."""
        import winreg

        try:
            place = r"SYSTEM\CurrentControlSet\Control\FileSystem"
            with winreg.OpenKey(winreg.HKEY_LOCAL_MACHINE, place) as key:
                return bool(winreg.QueryValueEx(key, "LongPathsEnabled")[0])
        except OSError:
            return False

else:

    def takes_long_paths() -> bool:
        """Whether paths may be as long as they like, which a setting of Windows says."""
        return True


def unlimited(path: str, *, windows: bool = sys.platform == "win32") -> str:
    """The path as Windows takes it however long it is; what lies under it may have been made by others."""
    if not windows:
        return path
    whole = ntpath.abspath(path)
    if whole.startswith("\\\\?\\"):
        return whole
    return "\\\\?\\UNC" + whole[1:] if whole.startswith("\\\\") else "\\\\?\\" + whole


def write_json(path: Path, content: dict[str, object]) -> None:
    """Write the file whole or not at all."""
    part = path.with_name(path.name + PART)
    part.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    part.replace(path)


def read_json(path: Path) -> object:
    """The content; None where it is missing or damaged."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _removed_or_warning(folder: Path) -> str:
    try:
        remove(folder)
    except OSError as error:
        return f"{folder} could not be removed ({error.strerror or error}); it is not needed any more."
    return ""


def _rename(source: Path, target: Path) -> None:
    if _is_empty_folder(target):
        target.rmdir()  # Windows renames onto nothing that exists
    when_let_go(lambda: source.rename(target))


def _is_empty_folder(folder: Path) -> bool:
    return folder.is_dir() and not folder.is_symlink() and next(folder.iterdir(), None) is None


def _size_bytes(folder: Path) -> int:
    """Of the files in it; one that goes away meanwhile counts nothing."""
    size = 0
    for place, _, names in os.walk(unlimited(str(folder))):
        for name in names:
            with suppress(OSError):
                size += os.lstat(os.path.join(place, name)).st_size
    return size


def _not_writable(folder: Path, error: OSError) -> Exception:
    return output_unusable(
        error,
        f"{folder} cannot be written ({error.strerror or error}).",
        "Choose a folder that you may write to, and close programs that use it.",
    )
