"""What the add-on and the installer agree on about the managed environment; standard library only.

DIR/        a virtual environment that passed `doctor`, with MARKER and RECORD in it
DIR.part/   one that is being made
DIR.old/    one that is being replaced or removed
DIR.lock    locked by the installer that works on DIR
"""

import sys
import tomllib
from pathlib import Path

MARKER = ".fewview-environment"
"""Name of the file that says that a folder was made by the installer, and how."""
RECORD = "env.json"
"""Name of the file that says what is in a finished environment."""
PART, OLD, LOCK = ".part", ".old", ".lock"
"""What is added to the folder's name."""
CONSTRAINTS = "constraints.txt"
OFFLINE = "FEWVIEW_OFFLINE"
"""Variable of a backend's environment: set where its caller must not go online."""
BUILDS = ("default", "cpu", "cuda")
"""Builds of torch: what the package index offers for this system, the smallest, the one for NVIDIA's GPUs."""
_SMALL_GB, _CUDA_GB = (0.6, 1.7), (3.2, 7.2)
"""To fetch, and on the disk when finished. Measured on Linux without CUDA; with CUDA an estimate."""
_WHILE_INSTALLING = 1.6
"""Disk that is needed, over the size of the finished environment: downloads are kept beside it."""


def python_in(folder: Path) -> Path:
    """The interpreter of a virtual environment."""
    return folder / "Scripts" / "python.exe" if sys.platform == "win32" else folder / "bin" / "python"


def beside(folder: Path, ending: str) -> Path:
    """The folder or file with an ending of its own beside the environment's folder."""
    return folder.with_name(folder.name + ending)


def is_ours(folder: Path) -> bool:
    """Whether the installer made the folder, so that it may be removed."""
    return not folder.is_symlink() and (folder / MARKER).is_file()


def sizes_gb(build: str) -> tuple[float, float]:
    """About how much is to be fetched, and the size of the finished environment, in GB.

    Raises ValueError on an unknown build.
    """
    if build not in BUILDS:
        raise ValueError(f"unknown build {build!r}; known: {', '.join(BUILDS)}")
    # On Linux the usual torch of the index is the one with CUDA.
    with_cuda = build == "cuda" or (build == "default" and sys.platform.startswith("linux"))
    return _CUDA_GB if with_cuda else _SMALL_GB


def needed_bytes(build: str) -> int:
    """About the free disk space that making an environment takes."""
    return int(sizes_gb(build)[1] * _WHILE_INSTALLING * 1e9)


def requirements(root: Path) -> tuple[str, ...]:
    """What the backend needs, as pip writes it, from the pyproject.toml in the program's folder.

    Raises OSError or tomllib.TOMLDecodeError where that file is missing or damaged.
    """
    with (root / "pyproject.toml").open("rb") as file:
        return tuple(tomllib.load(file)["project"]["dependencies"])
