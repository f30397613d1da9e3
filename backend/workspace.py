"""The output folder: whose it is, what is finished in it, and how results appear there.

    DIR/                      results, all put in place together at the end; log.txt
    DIR/.fewview/             format.json (the sign that the folder is ours, and what it is for), one
                              `<stage>.npz` for each finished stage with the fingerprint of all it depends
                              on, lock, sfm/

Nothing outside of these names is ever written, replaced or removed.
"""

import hashlib
import json
import logging
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

from .errors import ErrorCode, ReconstructionError
from .failures import output_unusable
from .file_lock import lock
from .held_files import PART, when_let_go, written_whole
from .records import RecordUnreadable, load_record, read_note, save_record

T = TypeVar("T")
FORMAT = 1
PRIVATE = ".fewview"
LOG = "log.txt"
_FORMAT_FILE = "format.json"
_LOCK = "lock"
_PARTS = "results"
_REPLACED = "replaced"
_SFM = "sfm"
Purpose = Literal["photographs", "points", "pictures"]
"""What a folder is for: what becomes of photographs, of points alone, or pictures of a finished job."""
_WORDS: dict[object, str] = {
    "photographs": "a reconstruction from photographs",
    "points": "a surface that was fitted to points",
    "pictures": "pictures of a finished job",
}
_ANOTHER_FOLDER = "Choose a new or empty output folder."
_NOBODYS = frozenset({".DS_Store", "Thumbs.db", "desktop.ini"})
"""Files that file browsers leave behind."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class StageCost:
    """What a stage took when it was computed."""

    seconds: float
    peak_memory_bytes: int | None
    """Of the process until the end of the stage; None where the system does not tell."""


@dataclass(frozen=True, kw_only=True)
class Workspace:
    """An output folder that is ours and locked."""

    folder: Path

    @property
    def private(self) -> Path:
        """Folder of the checkpoints."""
        return self.folder / PRIVATE

    @property
    def log_path(self) -> Path:
        """Where the log of all runs is."""
        return self.folder / LOG

    def preview_path(self, number: int, suffix: str) -> Path:
        """Where the run's first, second ... preview is to be seen."""
        return self.private / f"preview-{number}{suffix}"

    def remove_previews(self) -> None:
        """Without those of earlier runs."""
        for path in self.private.glob("preview*.*"):
            with suppress(OSError):  # on Windows somebody may still be looking at it
                path.unlink()

    def emptied_sfm_folder(self) -> Path:
        """Scratch folder for the camera solver, without what a killed run may have left in it."""
        return self._emptied(_SFM)

    def claim(self, purpose: Purpose, photographs: Iterable[str] = ()) -> None:
        """Note what the folder is for and, by their contents, which photographs it is about.

        ReconstructionError(OUTPUT_UNUSABLE), and nothing noted, where it is for something else, or about
        photographs of which none is among these: what is in it would be lost.
        """
        note = self._read_note()
        # Before it was noted, photographs alone had checkpoints.
        before = note.get("purpose", "photographs" if any(self.private.glob("*.npz")) else purpose)
        wanted, known = set(photographs), set(note.get("photographs", ()))
        if before != purpose:
            text = f"{self.folder} holds {_WORDS[before]}."
            raise ReconstructionError(ErrorCode.OUTPUT_UNUSABLE, text, _ANOTHER_FOLDER)
        if known and not known & wanted:
            text = f"{self.folder} holds a reconstruction from other photographs."
            remedy = f"{_ANOTHER_FOLDER} To use this one again, remove what is in it first."
            raise ReconstructionError(ErrorCode.OUTPUT_UNUSABLE, text, remedy)
        self._write_note({**note, "purpose": purpose, "photographs": sorted(wanted)})

    @property
    def frame(self) -> str | None:
        """Fingerprint of the cameras in whose frame the results in the folder are; None where unknown."""
        frame: str | None = self._read_note().get("frame")
        return frame

    @property
    def results(self) -> tuple[str, ...]:
        """Names of the results that were put in place last; none where that was not noted."""
        names: list[str] = self._read_note().get("results", [])
        return tuple(name for name in names if Path(name).name == name)  # the note may be a stranger's

    def is_finished(self, stage: str, fingerprint: str) -> bool:
        """Whether the stage was finished from exactly the same inputs."""
        note = read_note(self._stage_path(stage))
        return note is not None and note.split(" ")[0] == fingerprint

    def save(self, stage: str, fingerprint: str, record: object, hint: object, cost: StageCost) -> None:
        """Keep the result of a stage."""
        memory = cost.peak_memory_bytes
        note = f"{fingerprint} {cost.seconds:.6f} {'-' if memory is None else memory}"
        try:
            save_record(self._stage_path(stage), record, hint, note=note)
        except OSError as error:
            raise _not_writable(self.folder, error) from error

    def load_or_none(self, stage: str, fingerprint: str, hint: type[T]) -> tuple[T, StageCost] | None:
        """The result of a stage that was finished from the same inputs; None where it must be redone."""
        if not self.is_finished(stage, fingerprint):
            return None
        path = self._stage_path(stage)
        try:
            _, seconds, memory = (read_note(path) or "").split(" ")
            cost = StageCost(seconds=float(seconds), peak_memory_bytes=None if memory == "-" else int(memory))
            return load_record(path, hint), cost
        except (RecordUnreadable, ValueError) as error:
            logger.warning("the checkpoint of stage %s is damaged and is redone: %s", stage, error)
            return None

    def write_results(
        self,
        writers: dict[str, Callable[[Path], object]],
        *,
        replaced: tuple[str, ...] = (),
        frame: str | None = None,
    ) -> None:
        """Write every result under another name, then put all in place together.

        Results of the names in `replaced` that an earlier run left, and this one has not, are removed.
        `frame` is what the property says from then on. Raises ReconstructionError(OUTPUT_UNUSABLE) where an
        earlier result cannot be replaced, as one that is open on Windows; then all are as they were.
        """
        parts, earlier = self._emptied(_PARTS), self._emptied(_REPLACED)
        for name, write in writers.items():
            write(parts / name)
        written = {name.casefold() for name in writers}  # as disks see it that do not tell letter cases apart
        outdated = sorted(name for name in replaced if name.casefold() not in written)
        touched: list[str] = []
        try:
            for name in (*writers, *outdated):
                if (self.folder / name).exists():
                    when_let_go(partial((self.folder / name).replace, earlier / name))
                touched.append(name)
                if name in writers:
                    when_let_go(partial((parts / name).replace, self.folder / name))
        except OSError as error:
            self._put_back(touched, earlier)
            raise _not_replaced(self.folder / name, error) from error
        shutil.rmtree(parts, ignore_errors=True)
        shutil.rmtree(earlier, ignore_errors=True)
        # Last: after a kill before it, what is in the folder is taken for that of other cameras.
        self._write_note({**self._read_note(), "frame": frame, "results": sorted(writers)})

    def discard_stages(self) -> None:
        """Remove what only a run that goes on needs: finished stages, scratch files and previews."""
        self.remove_previews()
        shutil.rmtree(self.private / _SFM, ignore_errors=True)
        for path in self.private.glob("*.npz"):
            with suppress(OSError):  # the results are there: what Windows will not let go does no harm
                when_let_go(path.unlink)

    def discard_if_nothing_done(self) -> None:
        """Remove what opening made, where no stage was finished and nothing else is there."""
        if any(self.private.glob("*.npz")):
            return
        if {entry.name for entry in self.folder.iterdir()} - {PRIVATE, LOG}:
            return
        shutil.rmtree(self.private, ignore_errors=True)  # Windows keeps the lock until the run ends
        self.log_path.unlink(missing_ok=True)
        with suppress(OSError):
            self.folder.rmdir()

    def _stage_path(self, stage: str) -> Path:
        return self.private / f"{stage}.npz"

    def _emptied(self, name: str) -> Path:
        """Folder of that name for what is on its way, without what a killed run may have left in it."""
        folder = self.private / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(exist_ok=True)
        return folder

    def _put_back(self, names: list[str], earlier: Path) -> None:
        """Undo what was done to the results of these names."""
        for name in names:
            with suppress(OSError):  # the others shall come back all the same
                if (earlier / name).exists():
                    (earlier / name).replace(self.folder / name)
                else:
                    (self.folder / name).unlink(missing_ok=True)

    def _read_note(self) -> dict[str, Any]:
        """What format.json says."""
        note: dict[str, Any] = json.loads((self.private / _FORMAT_FILE).read_text(encoding="utf-8"))
        return note

    def _write_note(self, note: dict[str, Any]) -> None:
        _write_format(self.private, note)


def _write_format(private: Path, note: dict[str, Any]) -> None:
    """Write format.json whole or not at all; ReconstructionError(OUTPUT_UNUSABLE) where it cannot be."""
    try:
        with written_whole(private / _FORMAT_FILE) as part:
            part.write_text(json.dumps(note) + "\n", encoding="utf-8")
    except OSError as error:
        raise _not_writable(private.parent, error) from error


@contextmanager
def open_workspace(folder: Path) -> Iterator[Workspace]:
    """The output folder, made where it is missing and locked against a second run.

    Raises ReconstructionError(OUTPUT_UNUSABLE) and touches nothing where the folder is a file, holds
    somebody's files, was made by another format, cannot be written or is in use.
    """
    _check_ours(folder)
    private = folder / PRIVATE
    try:
        private.mkdir(parents=True, exist_ok=True)
        lock_file = (private / _LOCK).open("ab")
    except OSError as error:
        raise _not_writable(folder, error) from error
    with lock_file:
        if not lock(lock_file):
            raise ReconstructionError(
                ErrorCode.OUTPUT_UNUSABLE,
                f"Another run is writing to {folder}.",
                "Wait until it ends, or choose another output folder.",
            )
        if not (private / _FORMAT_FILE).is_file():
            _write_format(private, {"program": "fewview", "format": FORMAT})
        yield Workspace(folder=folder)


def check_free_space(folder: Path, needed_bytes: int) -> None:
    """ReconstructionError(DISK_FULL) where the disk of the folder has less than that free."""
    free = shutil.disk_usage(folder).free
    if free < needed_bytes:
        raise ReconstructionError(
            ErrorCode.DISK_FULL,
            f"{free / 1e9:.1f} GB are free on the disk of {folder}; "
            f"this run needs about {needed_bytes / 1e9:.1f} GB.",
            "Free some space, choose an output folder on another disk, or use fewer photographs or a faster "
            "preset.",
        )


def fingerprint(*parts: object) -> str:
    """A short name of the parts' representations and of the content of those that are paths."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, Path):
            for path in _files_of(part):
                digest.update(f"\0file {path.name}\0{content_of(path)}\0".encode())
        else:
            digest.update(f"\0{part!r}\0".encode())
    return digest.hexdigest()[:32]


def content_of(path: Path) -> str:
    """A short name of what is in the file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:32]


def _files_of(path: Path) -> list[Path]:
    """The file, or the files right in the folder but for file browsers' own; none where there is nothing."""
    if path.is_dir():
        return sorted(entry for entry in path.iterdir() if entry.is_file() and entry.name not in _NOBODYS)
    return [path] if path.is_file() else []


def _check_ours(folder: Path) -> None:
    """ReconstructionError(OUTPUT_UNUSABLE) where writing into the folder could hurt somebody's files."""
    remedy = _ANOTHER_FOLDER
    try:
        if not folder.exists():
            return
        if not folder.is_dir():
            raise ReconstructionError(ErrorCode.OUTPUT_UNUSABLE, f"{folder} is a file, not a folder.", remedy)
        names = sorted({entry.name for entry in folder.iterdir()} - _NOBODYS)
    except OSError as error:
        raise _not_writable(folder, error) from error
    private = folder / PRIVATE
    marker = private / _FORMAT_FILE
    unmarked = set() if not private.is_dir() else {entry.name for entry in private.iterdir()}
    if not names or (names == [PRIVATE] and unmarked <= {_LOCK, _FORMAT_FILE + PART}):
        return
    if not marker.is_file():
        shown = ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
        raise ReconstructionError(
            ErrorCode.OUTPUT_UNUSABLE, f"{folder} holds files that FewView did not make ({shown}).", remedy
        )
    try:
        found = json.loads(marker.read_text(encoding="utf-8")).get("format")
    except (OSError, ValueError, AttributeError):
        found = None
    if found != FORMAT:
        raise ReconstructionError(
            ErrorCode.OUTPUT_UNUSABLE, f"{folder} was made by another version of FewView.", remedy
        )


def _not_replaced(result: Path, error: OSError) -> Exception:
    """What to raise where an earlier result stands in the way of a new one."""
    return output_unusable(
        error,
        f"{result} cannot be replaced ({error.strerror or error}); all results are as they were.",
        f"Close the program that has {result.name} open and start the same command again; finished stages "
        "are kept.",
    )


def _not_writable(folder: Path, error: OSError) -> Exception:
    return output_unusable(
        error,
        f"{folder} cannot be written ({error.strerror or error}).",
        "Choose an output folder that you may write to.",
    )
