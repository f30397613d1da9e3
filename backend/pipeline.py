"""The stages in order: what each gets, what is kept of it, and what is redone.

The only module that knows all stages. A stage's result is kept under a fingerprint of everything it
depends on: the inputs' content, its settings and those of the stages before it, the seed, the kind of
device and the code. The same fingerprint means that the result can be taken from the last run.
"""

import json
import logging
import time
import typing
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import takewhile
from pathlib import Path

import torch

from .errors import ErrorCode, ReconstructionError
from .machine import choose_device, peak_memory_bytes, set_up_torch
from .mesh_files import write_glb, write_mesh, write_points
from .scene import Photo, Region, SolvedCameras, SurfaceMesh
from .workspace import LOG, StageCost, Workspace, check_free_space, fingerprint

if typing.TYPE_CHECKING:
    from .presets import Settings

T = typing.TypeVar("T")
CHECKPOINTED = ("photos", "cameras", "region", "stereo", "train", "mesh")
STAGE_NAMES = (*CHECKPOINTED, "report")
_CAMERA_FILES = frozenset({".json", ".txt", ".bin"})
_BYTES_PER_PHOTO = 60_000_000
"""On disk while a run goes on: the photograph, its undistorted twin, depth and normals, as floats."""
_BYTES_FOR_RESULTS = 200_000_000

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Job:
    """What the user asked for."""

    images: tuple[Path, ...]
    """Files, or folders of them."""
    output: Path
    cameras: Path | None = None
    masks: Path | None = None
    preset: str = "balanced"
    device: str = "auto"
    seed: int = 0
    truth: Path | None = None
    """A mesh to measure the result against."""


@dataclass(frozen=True, kw_only=True)
class Stages:
    """The work itself, so that a test can put something quick in its place.

    The annotated return type of each says how its result is kept.
    """

    load_photos: Callable[..., tuple[Photo, ...]]
    solve_cameras: Callable[..., SolvedCameras]
    find_region: Callable[..., Region]
    match_views: Callable[..., typing.Any]
    fit_surface: Callable[..., typing.Any]
    extract_mesh: Callable[..., SurfaceMesh]
    build_report: Callable[..., typing.Any]
    transforms_json: Callable[[SolvedCameras], dict[str, object]]


class Listener(typing.Protocol):
    """Who shows the run; `progressed` may raise Cancelled."""

    def resumed(self, stages: tuple[str, ...]) -> None:
        """These stages were finished by an earlier run."""

    def stage_started(self, name: str, index: int, count: int) -> None:
        """A stage begins; index counts from 1."""

    def progressed(self, fraction: float, text: str) -> None:
        """The stage is that far."""

    def stage_finished(self, cost: StageCost) -> None:
        """The stage is done and kept."""

    def previewed(self, path: Path) -> None:
        """A file shows the result so far."""

    def warned(self, text: str) -> None:
        """The run goes on, and the user should know this."""


@dataclass(frozen=True, kw_only=True)
class _Run:
    """One pass over the stages."""

    workspace: Workspace
    listener: Listener
    fingerprints: dict[str, str]
    costs: dict[str, StageCost] = field(default_factory=dict)

    def stage(self, name: str, work: "partial[T]") -> T:
        """The result of the stage, from the last run where nothing it depends on has changed."""
        hint: type[T] = typing.get_type_hints(work.func)["return"]
        self.listener.stage_started(name, STAGE_NAMES.index(name) + 1, len(STAGE_NAMES))
        kept = self.workspace.load_or_none(name, self.fingerprints[name], hint)
        if kept is None:
            result, cost = self._measured(work)
            self.workspace.save(name, self.fingerprints[name], result, hint, cost)
            logger.info("%s: %.2f s, peak memory %s bytes", name, cost.seconds, cost.peak_memory_bytes)
        else:
            result, cost = kept
            logger.info("%s: kept from an earlier run", name)
        self.costs[name] = cost
        self.listener.stage_finished(cost)
        return result

    def _measured(self, work: "partial[T]") -> tuple[T, StageCost]:
        self.listener.progressed(0.0, "")
        started = time.perf_counter()
        result = work(progress=self.listener.progressed)
        cost = StageCost(seconds=time.perf_counter() - started, peak_memory_bytes=peak_memory_bytes())
        return result, cost


def run(
    job: Job, workspace: Workspace, *, settings: "Settings", stages: Stages, listener: Listener
) -> tuple[str, ...]:
    """Reconstruct, going on where an earlier run of the same job stopped; names of the files written.

    Raises ReconstructionError for what the user can mend and Cancelled where the listener does; then the
    results of an earlier run are as they were.
    """
    if job.truth is not None and not job.truth.is_file():
        raise ReconstructionError(
            ErrorCode.TRUTH_UNREADABLE,
            f"There is no file {job.truth}.",
            "Give the path of a mesh to --truth.",
        )
    device = choose_device(job.device)
    set_up_torch(device)
    fingerprints = stage_fingerprints(job, settings, device.type)
    finished = _finished(workspace, fingerprints)
    if finished:
        listener.resumed(finished)
    check_free_space(workspace.folder, _needed_bytes(job))
    this = _Run(workspace=workspace, listener=listener, fingerprints=fingerprints)

    photos = this.stage("photos", partial(stages.load_photos, job.images, job.masks, settings.photos))
    workdir = workspace.emptied_sfm_folder()
    solve = partial(
        stages.solve_cameras, photos, job.cameras, settings.cameras, workdir=workdir, seed=job.seed
    )
    solved = this.stage("cameras", solve)
    _warn_of_unplaced(solved, len(photos), listener)
    del photos  # the views hold what is needed of them
    region = this.stage("region", partial(stages.find_region, solved, settings.region))
    views = solved.views
    stereo = this.stage("stereo", partial(stages.match_views, views, region, settings.stereo, device=device))
    write_points(workspace.preview_path, stereo.points, region)
    listener.previewed(workspace.preview_path)
    generator = torch.Generator(device).manual_seed(job.seed)
    fit = partial(
        stages.fit_surface, views, region, stereo, settings.train, device=device, generator=generator
    )
    surface = this.stage("train", fit)
    extract = partial(stages.extract_mesh, views, region, stereo, surface, settings.mesh, device=device)
    mesh = this.stage("mesh", extract)

    writers: dict[str, Callable[[Path], object]] = {
        "mesh.ply": partial(write_mesh, mesh=mesh),
        "mesh.glb": partial(write_glb, mesh=mesh),
        "points.ply": partial(write_points, points=stereo.points, region=region),
        "cameras.json": partial(_write_json, content=stages.transforms_json(solved)),
    }
    workspace.write_results(writers)
    return (*writers, LOG)


def stage_fingerprints(job: Job, settings: "Settings", device_kind: str) -> dict[str, str]:
    """For each stage, a name of all it depends on; a stage after a changed one changes too."""
    own: dict[str, tuple[object, ...]] = {
        "photos": (code_fingerprint(), *job.images, "masks", job.masks, settings.photos),
        "cameras": (*_camera_files(job.cameras), job.seed, settings.cameras),
        "region": (settings.region,),
        "stereo": (device_kind, settings.stereo),
        "train": (settings.train,),
        "mesh": (settings.mesh,),
    }
    found: dict[str, str] = {}
    before = ""
    for name in CHECKPOINTED:
        before = found[name] = fingerprint(before, *own[name])
    return found


def code_fingerprint() -> str:
    """Changes with the code that computes results, so that no result of older code is taken for new."""
    here = Path(__file__).parent
    folders = [*(here / "maths").rglob("*.py"), *(here / "stages").rglob("*.py")]
    sources = [here / "scene.py", here / "images.py", *folders]
    return fingerprint(*sorted(sources))


def _finished(workspace: Workspace, fingerprints: dict[str, str]) -> tuple[str, ...]:
    """The stages, from the first one on, that need not be done again."""
    return tuple(takewhile(lambda name: workspace.is_finished(name, fingerprints[name]), CHECKPOINTED))


def _camera_files(cameras: Path | None) -> list[Path | str]:
    """The files that may hold the given cameras; their images are among the photographs."""
    if cameras is None or not cameras.is_dir():
        return ["cameras", *([cameras] if cameras else [])]
    return sorted(path for path in cameras.rglob("*") if path.suffix in _CAMERA_FILES)


def _needed_bytes(job: Job) -> int:
    """About what the run will write: generous, because a full disk ends it after minutes of work."""
    num_photos = sum(len(list(path.iterdir())) if path.is_dir() else 1 for path in job.images)
    return _BYTES_FOR_RESULTS + num_photos * _BYTES_PER_PHOTO


def _warn_of_unplaced(solved: SolvedCameras, num_photos: int, listener: Listener) -> None:
    if solved.unplaced:
        names = ", ".join(solved.unplaced)
        listener.warned(f"{len(solved.unplaced)} of {num_photos} photographs could not be placed: {names}.")


def _write_json(path: Path, content: dict[str, object]) -> None:
    path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _pending(*_arguments: object, **_options: object) -> typing.Any:
    raise NotImplementedError


STAGES = Stages(
    load_photos=_pending,
    solve_cameras=_pending,
    find_region=_pending,
    match_views=_pending,
    fit_surface=_pending,
    extract_mesh=_pending,
    build_report=_pending,
    transforms_json=lambda _solved: {},
)
