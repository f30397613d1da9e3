"""From photographs to a mesh in the scene with one function, for scripts.

from bl_ext.user_default.fewview.addon.api import reconstruct

result = reconstruct(["photos"], output="jobs")
print(result.mesh.name, result.folder)
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import bpy

from ..backend.wire.protocol import PROTOCOL_VERSION, Failed, Job, decode_job, encode_job
from . import jobs
from .job_folder import RESULT, folder_for
from .operators.environment import backend_python_or_reason
from .operators.reconstruct import start
from .properties import settings_of
from .scenes import reason_against_changes


class ReconstructionFailed(RuntimeError):  # noqa: N818 - it says what happened
    """The backend could not make a mesh; `failure` has a code, a sentence and a remedy."""

    def __init__(self, failure: Failed) -> None:
        super().__init__(f"{failure.text} {failure.remedy}".strip())
        self.failure = failure


@dataclass(frozen=True, kw_only=True)
class Reconstruction:
    """What came of it."""

    mesh: bpy.types.Object
    folder: Path
    """Of the job; `folder / "result" / "report.html"` shows how good it is."""
    warnings: tuple[str, ...]


def reconstruct(
    images: Sequence[Path | str],
    *,
    output: Path | str,
    cameras: Path | str | None = None,
    masks: Path | str | None = None,
    truth: Path | str | None = None,
    preset: str = "balanced",
    device: str = "auto",
    seed: int = 0,
    region: tuple[tuple[float, float, float], float] | None = None,
    cut_out: bool = False,
    without_ground: bool = False,
) -> Reconstruction:
    """Reconstruct from image files or folders, wait, and bring the mesh into the scene.

    The job gets a folder of its own in `output`, and goes on in it where just this job was stopped.
    `cameras` are known ones: a transforms.json or a COLMAP model; `region` is a centre and a radius in their
    frame; `cut_out` cuts the subject out of photographs without masks; `without_ground` leaves out the flat
    ground that it stands on. Nothing is taken from the panel. Raises JobError where nothing can be started,
    ValueError for arguments that make no sense, ReconstructionFailed where the backend gives up.
    """
    python, reason = backend_python_or_reason(bpy.context)
    reason = reason_against_changes(bpy.context.scene) or reason
    if python is None or reason:
        raise jobs.JobError(reason)
    centre, radius = _region(region)
    asked = Job(
        protocol=PROTOCOL_VERSION,
        images=tuple(str(Path(path).absolute()) for path in images),
        output=RESULT,
        cameras=_absolute(cameras),
        masks=_absolute(masks),
        truth=_absolute(truth),
        preset=preset,
        device=device,
        seed=seed,
        region_centre=centre,
        region_radius=radius,
        cut_out=cut_out,
        without_ground=without_ground,
        keep_stages=False,
    )
    _check(asked)
    folder = folder_for(Path(output).absolute(), asked)
    start(python, folder, asked, scene_name=bpy.context.scene.name)
    end = jobs.wait()
    if end.failure is not None:
        raise ReconstructionFailed(end.failure)
    return Reconstruction(mesh=settings_of(bpy.context).result, folder=folder, warnings=end.warnings)


def _check(asked: Job) -> None:
    """What can be known before a folder is made. Raises ValueError."""
    if not asked.images:
        raise ValueError("There are no images: give files or folders")
    decode_job(encode_job(asked))
    named = (*asked.images, *filter(None, (asked.cameras, asked.masks, asked.truth)))
    missing = [path for path in named if not Path(path).exists()]
    if missing:
        raise ValueError(f"There is nothing at {', '.join(missing)}: check the path")


def _region(
    given: tuple[tuple[float, float, float], float] | None,
) -> tuple[tuple[float, ...] | None, float | None]:
    """Centre and radius. Raises ValueError where it is something else."""
    if given is None:
        return None, None
    try:
        centre, radius = given
        return tuple(map(float, centre)), float(radius)
    except (TypeError, ValueError) as error:
        raise ValueError("The region is a centre of three numbers and a radius: ((x, y, z), r)") from error


def _absolute(path: Path | str | None) -> str | None:
    return None if path is None else str(Path(path).absolute())
