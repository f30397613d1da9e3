"""Where the files of a job lie; no Blender needed.

    PARENT/reconstruct-001/     job.json      what was asked for
                                backend.log   what the backend's libraries said
                                result/       the backend's own folder: mesh.ply, cameras.json
                                novel-views-001/   of Blender's cameras: images/, transforms.json, backend.log
    PARENT/views-001/           rendered views: images/, transforms.json, truth.ply
    PARENT/points-001/          cloud.ply     points alone
                                backend.log, result/
    ANY/                        what the command line made: mesh.ply, report.json and all else of a result/

A job never writes outside its folder, and a name that a backend gives is only taken if it lies inside.
"""

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ..backend.wire.protocol import Job, ProtocolError, decode_job, encode_job

JOB_FILE, LOG, RESULT, CLOUD = "job.json", "backend.log", "result", "cloud.ply"
MESH, TEXTURE, RADIANCE, CAMERAS, CAMERAS_PAGE, REPORT_PAGE, REPORT_NUMBERS, SPARSE = (
    "mesh.ply",
    "texture.png",
    "radiance.npz",
    "cameras.json",
    "cameras.html",
    "report.html",
    "report.json",
    "sparse.ply",
)
_LARGEST_JOB_BYTES = 1_000_000
_KIND = "reconstruct"
"""How the names of such jobs' folders begin."""


class FolderError(ValueError):
    """A file or folder that cannot be used, in a sentence for the user."""


@dataclass(frozen=True, kw_only=True)
class PastJob:
    """A job on disk, as a rule one that has a mesh."""

    folder: Path
    job: Job | None
    """What Blender asked for; None for points alone, and for what the command line made."""

    @property
    def result(self) -> Path:
        """Folder of the results."""
        return results_in(self.folder)

    @property
    def of_points(self) -> bool:
        """Whether it is a surface that was fitted to points alone, which have no cameras."""
        return self.job is None and ((self.folder / CLOUD).is_file() or not (self.result / CAMERAS).is_file())

    @property
    def words(self) -> str:
        """What it is, for a list."""
        if self.job is not None:
            count = len(self.job.images)  # one may be a folder with any number of photographs
            return f"{self.folder.name}: {self.job.preset}" + (f", {count} images" if count > 1 else "")
        return f"{self.folder.name}: {'points' if self.of_points else 'from the command line'}"


def results_in(folder: Path) -> Path:
    """Where the results in a job's folder lie: one made by the command line is itself that of the results."""
    inner = folder / RESULT
    return inner if inner.is_dir() or not (folder / MESH).is_file() else folder


def new_folder(parent: Path, kind: str) -> Path:
    """A folder of its own for a job: PARENT/KIND-NNN, the number one more than the last.

    Raises FolderError where it cannot be made.
    """
    try:
        parent.mkdir(parents=True, exist_ok=True)
        pattern = re.compile(re.escape(kind) + r"-(\d+)")
        numbers = [int(m[1]) for entry in parent.iterdir() if (m := pattern.fullmatch(entry.name))]
        number = max(numbers, default=0)
        while True:
            number += 1
            folder = parent / f"{kind}-{number:03d}"
            try:
                folder.mkdir()
            except FileExistsError:  # another Blender was quicker
                continue
            return folder
    except OSError as error:
        reason = error.strerror or error
        raise FolderError(f"{parent} cannot be written ({reason}): choose another output folder") from error


def folder_for(parent: Path, job: Job) -> Path:
    """The folder of just this job where it was stopped or failed, for it to go on, or else a new one.

    Raises FolderError where none can be made.
    """
    asked = decode_job(encode_job(job))
    result = CAMERAS if job.until == "cameras" else MESH
    for folder in sorted(parent.glob(f"{_KIND}-*"), reverse=True):
        try:
            if read_job_file(folder) == asked and not (folder / RESULT / result).is_file():
                return folder
        except FolderError:
            continue
    return new_folder(parent, _KIND)


def write_job(folder: Path, job: Job) -> Path:
    """Write job.json; its path."""
    path = folder / JOB_FILE
    part = path.with_suffix(".part")
    part.write_text(encode_job(job), encoding="utf-8")
    part.replace(path)
    return path


def read_job_file(folder: Path) -> Job:
    """What was asked for. Raises FolderError where the file is missing or damaged."""
    path = folder / JOB_FILE
    try:
        if path.stat().st_size > _LARGEST_JOB_BYTES:
            raise FolderError(f"{path} is too large to be a job")
        return decode_job(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise FolderError(f"{folder} is not the folder of a job: it has no {JOB_FILE}") from error
    except (OSError, UnicodeDecodeError, ProtocolError) as error:
        raise FolderError(f"{path} cannot be read: {error}") from error


def read_job(folder: Path) -> PastJob:
    """The job of a folder that has a mesh. Raises FolderError where there is none or it is damaged.

    Points alone and what the command line made have no job.json: a mesh with its report is one of them.
    """
    if folder.name == RESULT and (folder.parent / JOB_FILE).is_file():
        folder = folder.parent
    result = results_in(folder)
    has_mesh = (result / MESH).is_file()
    if not (folder / JOB_FILE).exists() and has_mesh and (result / REPORT_NUMBERS).is_file():
        return PastJob(folder=folder, job=None)
    job = read_job_file(folder)
    inside(folder, folder / job.output)
    if not has_mesh:
        raise FolderError(f"The job {folder.name} has no mesh yet")
    return PastJob(folder=folder, job=job)


def can_be_rendered(folder: Path) -> bool:
    """Whether the folder of a job holds what the backend renders from cameras."""
    return any((results_in(folder) / name).is_file() for name in (MESH, RADIANCE))


def has_report(folder: Path) -> bool:
    """Whether the folder of a job holds a page for a web browser; a fit to points leaves none."""
    return (results_in(folder) / REPORT_PAGE).is_file()


def past_jobs(parent: Path) -> Iterator[PastJob]:
    """The jobs with a mesh in a folder, the newest first; folders that are no such jobs are left out.

    Each is read when it is asked for: the panel asks for few, and is drawn again and again.
    """
    made: list[tuple[float, Path]] = []
    try:
        with os.scandir(parent) as entries:
            folders = [Path(entry.path) for entry in entries if entry.is_dir()]
    except OSError:
        return
    for folder in folders:
        with suppress(OSError):
            made.append(((results_in(folder) / MESH).stat().st_mtime, folder))
    for _, folder in sorted(made, reverse=True):
        with suppress(FolderError, OSError):
            yield read_job(folder)


def inside(folder: Path, path: Path) -> Path:
    """The path, resolved. Raises FolderError where it leaves the folder."""
    try:
        resolved = path.resolve()
        if resolved.is_relative_to(folder.resolve()):
            return resolved
    except (OSError, ValueError, RuntimeError) as error:  # a null byte, a loop of links
        raise FolderError(f"{path!s} is no usable path ({error})") from error
    raise FolderError(f"{path} lies outside of the job's folder {folder}")
