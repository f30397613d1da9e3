"""The first step of an installation: a Python of the right version, and a virtual environment from it.

Standard library only.
"""

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

from ..errors import ErrorCode, ReconstructionError
from ..wire.environment import python_in
from .environment_folder import empty
from .installer import Installer

_PREFERRED = "3.12"
_TESTED = ((3, 11), (3, 13))
"""First and last version that all packages are known to have builds for."""
_SUITS = "import sys, venv, ensurepip; sys.exit(sys.version_info[:2] < (3, 11) or sys.maxsize < 2**32)"


def make_environment(folder: Path, installer: Installer) -> None:
    """Make a virtual environment with pip in the folder, by uv where it is, else by a Python that can.

    Raises ReconstructionError(MISSING_DEPENDENCY) where there is no such Python.
    """
    for command in _commands(folder, installer):
        installer.progress(0.2, f"Making an environment with {Path(command[0]).name}")
        empty(folder)  # not by venv --clear, which would take the marker along
        if installer.run(command) and works(folder, installer):
            installer.progress(1.0, "")
            return
    raise ReconstructionError(
        ErrorCode.MISSING_DEPENDENCY,
        "There is no Python from 3.11 on with the modules venv and ensurepip on this computer.",
        "Install uv or Python 3.12 and try again, or make an environment as Set Up by Hand says.",
    )


def works(folder: Path, installer: Installer) -> bool:
    """Whether the folder has a Python that starts and has pip."""
    python = python_in(folder)
    return python.is_file() and installer.ask([str(python), "-c", "import pip"])


def _commands(folder: Path, installer: Installer) -> Iterator[list[str]]:
    """What may make the environment, the best first; each is looked at when it is its turn."""
    if uv := shutil.which("uv"):
        yield [uv, "venv", "--allow-existing", "--seed", "--python", _PREFERRED, str(folder)]
    for python in _pythons():
        if installer.ask([*python, "-c", _SUITS]):
            yield [*python, "-m", "venv", str(folder)]


def _pythons() -> Iterator[list[str]]:
    """The running Python and those on the path; a running one that is too new comes last."""
    is_tested = _TESTED[0] <= sys.version_info[:2] <= _TESTED[1]
    if is_tested:
        yield [sys.executable]
    for minor in range(_TESTED[1][1], _TESTED[0][1] - 1, -1):
        if sys.platform == "win32" and (launcher := shutil.which("py")):
            yield [launcher, f"-3.{minor}"]
        if found := shutil.which(f"python3.{minor}"):
            yield [found]
    if not is_tested:
        yield [sys.executable]
