"""Which Python reconstructs, whether it is ready, and how one is made; no Blender needed."""

import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from ..backend.wire.client import ROOT, backend_command
from ..backend.wire.environment import CONSTRAINTS, is_ours, python_in, requirements, sizes_gb
from ..backend.wire.photographs import first_names
from ..backend.wire.protocol import Checked

VARIABLE = "FEWVIEW_PYTHON"
"""Environment variable with the Python to use, before every other choice."""
MANAGED_NAME = "environment"
HAND_VERSION = "3.12"
"""The Python that the lines for a shell ask for."""
_PYTHON, _DEVICES = "Python", {"cuda": "CUDA", "mps": "MPS", "cpu": "CPU"}


class PythonMissing(ValueError):  # noqa: N818 - it says what is the matter
    """A Python that was chosen and is not there, in a sentence for the user."""


@dataclass(frozen=True, kw_only=True)
class FoundPython:
    """The Python that is used."""

    path: Path
    """Absolute; links are kept, because a virtual environment is one."""
    source: str
    """Who chose it, for the user."""


class State(Enum):
    """What is known of a Python."""

    UNKNOWN = "unknown"
    READY = "ready"
    NOT_READY = "not ready"


@dataclass(frozen=True, kw_only=True)
class Readiness:
    """What the last check of a Python found."""

    state: State
    text: str
    """Its torch and device, or what is missing."""


_Key = tuple[str, tuple[int, ...]]
_known: dict[_Key, Readiness] = {}
"""What the last checks found, for each Python as it was on the disk then."""


def find_python(*, variable: str, preference: str, managed: Path) -> FoundPython | None:
    """The Python that reconstructs: of the environment variable, else the preference, else the managed one.

    Texts may be empty; `managed` is the folder of the managed environment. None where none is chosen
    and none was made. Raises PythonMissing where the chosen one is not there: the next best may be
    another version, and nobody would know.
    """
    for text, source in ((variable, f"the variable {VARIABLE}"), (preference, "the preferences")):
        if text.strip():
            return FoundPython(path=_chosen(text.strip(), source), source=source)
    python = python_in(managed)
    if python.is_file():
        return FoundPython(path=python.absolute(), source="the managed environment")
    if is_ours(managed):
        raise PythonMissing(f"The Python that {managed} was made from is gone: press Set Up FewView again")
    return None


def managed_folder(base: Path) -> Path:
    """The folder of the managed environment in a folder that is ours or the user's."""
    return base / MANAGED_NAME


def short_folder(environment: Mapping[str, str], *, windows: bool = sys.platform == "win32") -> Path | None:
    """Where the managed environment goes on Windows; None elsewhere, and where there is no such folder.

    There the folder that Blender keeps for an extension leaves too few characters for the files of torch.
    """
    local = environment.get("LOCALAPPDATA")
    return Path(local) / "fewview" if windows and local else None


def can_be_removed(folder: Path) -> bool:
    """Whether the folder is a managed environment that the installer made."""
    return is_ours(folder)


def doctor_command(python: Path) -> tuple[str, ...]:
    """The command that checks a Python, on the wire."""
    return backend_command(python, "doctor", "--wire")


def install_command(python: str, folder: Path, *, build: str, again: bool) -> tuple[str, ...]:
    """The command, run by any Python from 3.11 on, that makes the managed environment, on the wire."""
    more = ("--again",) if again else ()
    return backend_command(python, "install", "--folder", str(folder), "--torch", build, *more)


def remove_command(python: str, folder: Path) -> tuple[str, ...]:
    """The command that removes the managed environment, on the wire."""
    return backend_command(python, "install", "--folder", str(folder), "--remove")


def size_text(build: str) -> str:
    """What an installation takes, told before it begins."""
    fetched_gb, disk_gb = sizes_gb(build)
    return f"About {fetched_gb:g} GB to download, {disk_gb:g} GB on the disk"


def hand_lines(folder: Path, *, root: Path = ROOT, windows: bool = sys.platform == "win32") -> str:
    """The two lines for a shell (cmd.exe on Windows) that make an environment by hand.

    Raises OSError where the extension is incomplete.
    """
    if windows:
        python, made = ["py", f"-{HAND_VERSION}"], f"{folder}\\Scripts\\python.exe"
    else:
        python, made = [f"python{HAND_VERSION}"], f"{folder}/bin/python"
    install = [made, "-m", "pip", "install", "--constraint", str(root / CONSTRAINTS), *requirements(root)]
    quoted = _quoted_for_cmd if windows else shlex.join
    return f"{quoted([*python, '-m', 'venv', str(folder)])}\n{quoted(install)}"


def shell_name(*, windows: bool = sys.platform == "win32") -> str:
    """What those lines are written for: PowerShell, the other shell of Windows, reads quotes otherwise."""
    return "the Command Prompt (cmd)" if windows else "a shell"


def readiness(python: Path) -> Readiness:
    """What the last check of this Python found; unknown where it has changed since."""
    return _known.get(_key(python), Readiness(state=State.UNKNOWN, text="Not checked yet"))


def remember(python: Path, checks: Sequence[Checked], *, finished: bool) -> None:
    """Keep what a check found; one that neither finished nor found a fault came to no result.

    One that finished says "ready", whatever it found: a GPU that fails is no reason against the CPU.
    """
    faults = [check for check in checks if not check.fine]
    if finished:
        found = Readiness(state=State.READY, text=_ready_text(checks))
    elif faults:
        found = Readiness(state=State.NOT_READY, text=_fault_text(faults))
    else:
        found = Readiness(state=State.NOT_READY, text="The check ended early; Show Log says why")
    _known[_key(python)] = found


def chosen_text(environment: Mapping[str, str]) -> str:
    """The Python of the environment variable; empty where it is not set."""
    return environment.get(VARIABLE, "")


def _chosen(text: str, source: str) -> Path:
    """The interpreter that a user named, or that of the virtual environment that they named."""
    path = Path(text).expanduser()
    if not path.is_absolute():
        path = Path.cwd() / path
    if path.is_dir() and python_in(path).is_file():
        return python_in(path)
    if path.is_file():
        return path
    raise PythonMissing(f"The Python of {source} is not there: {path}")


def _key(python: Path) -> _Key:
    """The Python as it is on the disk now: itself, not what it links to, and its environment."""
    times = []
    for path in (python, python.parent.parent / "pyvenv.cfg"):
        try:
            times.append(path.lstat().st_mtime_ns)
        except OSError:
            times.append(0)
    return str(python), tuple(times)


def _ready_text(checks: Sequence[Checked]) -> str:
    """Its torch and its best device, such as "torch 2.13.0, CUDA NVIDIA H200"; and devices that fail."""
    found = {check.name: check.found for check in checks if check.fine}
    device = next((f"{shown} {found[name]}" for name, shown in _DEVICES.items() if name in found), "")
    text = ", ".join(filter(None, (f"torch {found.get('torch', '?')}", device)))
    fails = [
        f"{_DEVICES.get(check.name, check.name)} fails: {check.found}" for check in checks if not check.fine
    ]
    return "; ".join([text, *fails])


def _fault_text(faults: Sequence[Checked]) -> str:
    """What is missing or wrong, in short."""
    first = faults[0]
    if first.name == _PYTHON or len(faults) == 1:
        return f"{first.name}: {first.found}"
    return f"Missing: {first_names([fault.name for fault in faults])}"


def _quoted_for_cmd(words: Sequence[str]) -> str:
    """As cmd.exe takes it: it would read <, > and & outside of quotes as its own."""
    return " ".join(f'"{word}"' if set(word) & set(" <>&|^()") else word for word in words)
