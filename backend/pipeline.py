"""The stages in order: what each gets, what is kept of it, and what is redone.

The only module that knows all stages. A stage's result is kept under a fingerprint of everything it
depends on: the inputs' content, its settings and those of the stages before it, the seed, the kind of
device and the code. The same fingerprint means that the result can be taken from the last run.
"""

import logging
import time
import typing
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import takewhile
from pathlib import Path
from types import MappingProxyType

import torch

from .errors import ErrorCode, ReconstructionError
from .machine import choose_device, peak_memory_bytes, set_up_torch
from .maths.metrics import TrueSurface, elsewhere_text, load_truth
from .mesh_files import SPARSE
from .presets import Settings
from .previews import Previews
from .provenance import code_fingerprint, versions
from .results import cameras_summary, check_no_mesh_of_others, summary, write_all, write_cameras
from .scene import CutOut, Decision, Photo, Region, SolvedCameras, StereoResult, SurfaceMesh, View
from .stages.cameras.camera_report import build_camera_report
from .stages.cameras.confirmation import unconfirmed
from .stages.cameras.copies import copies_apart_text
from .stages.cameras.known_cameras import cameras_source, may_be_unturned
from .stages.cameras.solving import solve_cameras
from .stages.cutout.cutting_out import cut_out, with_cut_out
from .stages.mesh.extraction import extract_mesh
from .stages.mesh.originals import Original
from .stages.photos import (
    load_photos,
    match_masks,
    named_photos,
    turned_text,
    unused_masks_text,
    white_masks_text,
    without_masks_text,
)
from .stages.published.neus_fit import NeusConfig, fit_neus
from .stages.published.radiance_fit import RadianceConfig, fit_radiance
from .stages.radiance import Radiance
from .stages.region import find_region
from .stages.report import Report, ReportInputs, StageTiming, build_report
from .stages.stereo.camera_refinement import with_refined
from .stages.stereo.disagreement import disagreement
from .stages.stereo.matching import match_solved
from .stages.stereo.outlines_alone import hollows_filled
from .stages.surface import Surface
from .stages.train.surface_fit import TrainConfig, fit_surface
from .wire.photographs import passed_over, passed_over_text
from .workspace import StageCost, Workspace, check_free_space, content_of, fingerprint

T = typing.TypeVar("T")
CHECKPOINTED = ("photos", "cameras", "cutout", "region", "stereo", "train", "mesh")
STAGE_NAMES = (*CHECKPOINTED, "report")
_UNTIL = {"cameras": ("photos", "cameras", "cutout", "region"), "report": STAGE_NAMES}
"""The stages of a run, by what it is asked for."""
_CAMERA_FILES = frozenset({".json", ".txt", ".bin"})
_BYTES_PER_PIXEL = MappingProxyType({"photos": 16, "cameras": 24, "cutout": 4, "stereo": 40})
"""On disk, of each photograph: with its mask; its undistorted twin and what cameras are found by; a mask that
was made; depth and points. Measured: 12 to 16, 14 to 18, 4, 8 to 23."""
_SHORT_BY_LONG_SIDE = 0.75
"""Of most photographs; the others are a little narrower."""
_BYTES_FOR_RESULTS = 400_000_000
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
    cut_out: bool = False
    """Whether the subject is cut out of photographs without masks."""
    until: str = "report"
    """"cameras" to end when cameras and region are known; a later run of the whole goes on from there."""


FITS: typing.Mapping[type, Callable[..., Surface]] = MappingProxyType(
    {TrainConfig: fit_surface, RadianceConfig: fit_radiance, NeusConfig: fit_neus}
)
"""What is fitted, by the type of its settings."""


def fit_by_settings(
    views: tuple[View, ...],
    region: Region,
    stereo: StereoResult,
    config: TrainConfig | RadianceConfig | NeusConfig,
    **keywords: typing.Any,
) -> Surface:
    """The surface as the type of the settings asks for it; each of FITS has the same arguments."""
    return FITS[type(config)](views, region, stereo, config, **keywords)


@dataclass(frozen=True, kw_only=True)
class Stages:
    """The work itself, so that a test can put something quick in its place.

    The annotated return type of each says how its result is kept.
    """

    load_photos: Callable[..., tuple[Photo, ...]] = load_photos
    solve_cameras: Callable[..., SolvedCameras] = solve_cameras
    cut_out: Callable[..., CutOut] = cut_out
    find_region: Callable[..., Region] = find_region
    match_views: Callable[..., StereoResult] = match_solved
    fit_surface: Callable[..., Surface] = fit_by_settings
    extract_mesh: Callable[..., SurfaceMesh] = extract_mesh
    build_report: Callable[..., Report] = build_report


STAGES = Stages()


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a run gave."""

    files: tuple[str, ...]
    """Names in the output folder."""
    summary: tuple[str, ...]
    """A few lines for a person."""


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
class _Files:
    """The photographs and masks as files of today, by the photographs' names."""

    photos: typing.Mapping[str, Path]
    photo_contents: typing.Mapping[str, str]
    mask_contents: typing.Mapping[str, str]


@dataclass(frozen=True, kw_only=True)
class _Run:
    """One pass over the stages."""

    workspace: Workspace
    listener: Listener
    fingerprints: dict[str, str]
    stage_names: tuple[str, ...]
    costs: dict[str, StageCost] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def warn(self, text: str) -> None:
        """Tell the user now, and again in the report."""
        self.warnings.append(text)
        logger.info("warned: %s", text)  # to the log alone: the listener tells the user
        self.listener.warned(text)

    def stage(self, name: str, work: "partial[T]") -> T:
        """The result of the stage, from the last run where nothing it depends on has changed."""
        hint: type[T] = typing.get_type_hints(work.func)["return"]
        self._start(name)
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

    def unkept_stage(self, name: str, work: "partial[T]") -> T:
        """The result of a stage that is quicker to do again than to keep."""
        self._start(name)
        result, cost = self._measured(work)
        self.listener.stage_finished(cost)
        return result

    def timings(self) -> tuple[StageTiming, ...]:
        """What each stage took when it was computed, be it by an earlier run."""
        return tuple(
            StageTiming(name=name, seconds=cost.seconds, peak_memory_bytes=cost.peak_memory_bytes)
            for name, cost in self.costs.items()
        )

    def _start(self, name: str) -> None:
        self.listener.stage_started(name, self.stage_names.index(name) + 1, len(self.stage_names))

    def _measured(self, work: "partial[T]") -> tuple[T, StageCost]:
        self.listener.progressed(0.0, "")
        started = time.perf_counter()
        result = work(progress=self.listener.progressed)
        cost = StageCost(seconds=time.perf_counter() - started, peak_memory_bytes=peak_memory_bytes())
        return result, cost


def run(job: Job, workspace: Workspace, *, settings: Settings, stages: Stages, listener: Listener) -> Outcome:
    """Reconstruct, going on where an earlier run of the same job stopped.

    Raises ReconstructionError for what the user can mend and Cancelled where the listener does; then the
    results of an earlier run are as they were. A folder about other photographs is such a thing, and one with
    a mesh that would not fit the cameras, where these alone are asked for.
    """
    # what is unreadable is better told now than after minutes of work
    truth = None if job.truth is None else load_truth(job.truth)
    full_gpu: list[str] = []
    device = choose_device(job.device, full_gpu.append)
    set_up_torch(device)
    files = _files(job)
    fingerprints = stage_fingerprints(job, files, settings, device.type)
    frame = fingerprints["cameras"]
    workspace.claim("photographs", files.photo_contents.values())
    if job.until == "cameras":
        check_no_mesh_of_others(workspace, frame)
    names = _stage_names(job)
    finished = _finished(workspace, fingerprints, names)
    if finished:
        listener.resumed(finished)
    to_come = set(names) - set(finished)
    check_free_space(workspace.folder, _needed_bytes(len(files.photos), to_come, settings))
    this = _Run(workspace=workspace, listener=listener, fingerprints=fingerprints, stage_names=names)
    for text in full_gpu:
        this.warn(text)
    solved, region = _placed(job, files, this, settings, stages)
    if job.until == "cameras":
        name = job.output.resolve().name
        told = build_camera_report(solved, region, job_name=name, seed=job.seed, versions=versions())
        return Outcome(files=write_cameras(told, workspace, frame=frame), summary=cameras_summary(told))
    lenses = zip(solved.views, solved.lenses, strict=True)
    originals = tuple(Original(path=files.photos[view.name], lens=lens) for view, lens in lenses)
    placed = (solved, region, device)
    inputs, radiance = _reconstructed(
        job, this, settings, stages, placed=placed, originals=originals, truth=truth
    )
    report = this.unkept_stage("report", partial(stages.build_report, inputs, settings.report))
    return Outcome(files=write_all(report, radiance, workspace, frame=frame), summary=summary(report))


def _stage_names(job: Job) -> tuple[str, ...]:
    return tuple(name for name in _UNTIL[job.until] if job.cut_out or name != "cutout")


def _files(job: Job) -> _Files:
    """The job's photographs and masks.

    Raises ReconstructionError: NO_PHOTOS, TOO_FEW_PHOTOS, MASK_UNUSABLE, PHOTO_UNREADABLE.
    """
    photos = named_photos(job.images)
    masks = {} if job.masks is None else match_masks(photos, job.masks)
    return _Files(
        photos=photos,
        photo_contents={name: _content(path) for name, path in photos.items()},
        mask_contents={name: _content(path) for name, path in masks.items()},
    )


def _content(path: Path) -> str:
    try:
        return content_of(path)
    except OSError as error:  # no leave to read it, or a cloud's placeholder without a connection
        text = f"{path.name} cannot be read ({error.strerror or error})."
        remedy = "Make it readable on this computer, or leave it out."
        raise ReconstructionError(ErrorCode.PHOTO_UNREADABLE, text, remedy) from error


def _placed(
    job: Job, files: _Files, this: _Run, settings: Settings, stages: Stages
) -> tuple[SolvedCameras, Region]:
    """Where each photograph was taken, and what of the world is to be reconstructed."""
    sources = job.images if job.masks is None else (*job.images, job.masks)
    if text := passed_over_text(passed_over(sources)):
        this.warn(text)
    if not job.masks and (text := unused_masks_text(job.images)):
        this.warn(text)
    photos = this.stage("photos", partial(stages.load_photos, job.images, job.masks, settings.photos))
    # Those of an earlier run are where the folder was then.
    photos = tuple(replace(photo, path=files.photos[photo.name]) for photo in photos)
    if job.masks and (bare := [photo.name for photo in photos if photo.mask is None]):
        this.warn(without_masks_text(bare))
    if text := white_masks_text(photos):
        this.warn(text)
    if text := turned_text("masks", [photo for photo in photos if photo.name in files.mask_contents]):
        this.warn(text)
    scratch = {"workdir": this.workspace.emptied_sfm_folder(), "seed": job.seed}
    solve = partial(stages.solve_cameras, photos, job.cameras, settings.cameras, **scratch)
    solved = this.stage("cameras", solve)
    in_doubt = job.cameras is not None and not solved.way_up_told and may_be_unturned(job.cameras)
    if in_doubt and (text := turned_text("cameras", photos)):
        this.warn(text)
    _warn_of_unplaced(solved, len(photos), this)
    if text := copies_apart_text(solved.views):
        this.warn(text)
    if doubt := unconfirmed(solved):
        this.warn(doubt)
    del photos, solve  # the views hold what is needed of them
    solved = _cut_out(solved, this, stages) if job.cut_out else solved
    region = this.stage("region", partial(stages.find_region, solved, settings.region))
    if region.doubt:
        this.warn(region.doubt)
    return solved, region


def _cut_out(solved: SolvedCameras, this: _Run, stages: Stages) -> SolvedCameras:
    """With masks where there were none."""
    cut = this.stage("cutout", partial(stages.cut_out, solved))
    if cut.doubt:
        this.warn(cut.doubt)
    return with_cut_out(solved, cut)


def _reconstructed(
    job: Job,
    this: _Run,
    settings: Settings,
    stages: Stages,
    *,
    placed: tuple[SolvedCameras, Region, torch.device],
    originals: tuple[Original, ...],
    truth: TrueSurface | None,
) -> tuple[ReportInputs, Radiance | None]:
    """The mesh, with all that the report tells of it, and the field to render from, where there is one."""
    solved, region, device = placed
    previews = Previews(this.workspace, this.listener.previewed)
    previews.show_cameras(solved, region)
    match = partial(stages.match_views, solved, region, settings.stereo, device=device)
    stereo = this.stage("stereo", match)
    if settings.stereo is not None and (lack := hollows_filled(stereo, region)):
        this.warn(lack)
    if stereo.doubt:
        this.warn(stereo.doubt)
    for doubt in disagreement(solved, stereo):
        this.warn(doubt)
    solved = with_refined(solved, stereo)
    views = solved.views
    if len(stereo.points.positions):
        previews.show_points(stereo.points, region)
    chance = {"device": device, "generator": torch.Generator().manual_seed(job.seed)}
    show = partial(previews.show_surface, points=stereo.points, region=region)
    fit = partial(stages.fit_surface, views, region, stereo, settings.train, show=show, **chance)
    surface = this.stage("train", fit)
    extract = partial(stages.extract_mesh, views, region, stereo, surface, settings.mesh, originals=originals)
    mesh = this.stage("mesh", extract)
    if truth is not None and (text := elsewhere_text(mesh, truth)):
        this.warn(text)
    inputs = ReportInputs(
        job_name=job.output.resolve().name,
        settings=settings,
        seed=job.seed,
        timings=this.timings(),
        warnings=tuple(this.warnings),
        decisions=_decisions(solved, region, stereo, stereo.points, surface, mesh),
        solved=solved,
        region=region,
        points=stereo.points,
        mesh=mesh,
        truth=truth,
        versions=versions(),
    )
    return inputs, surface.radiance


def stage_fingerprints(job: Job, files: _Files, settings: Settings, device_kind: str) -> dict[str, str]:
    """For each stage, a name of all it depends on; a stage after a changed one changes too."""
    own: dict[str, tuple[object, ...]] = {
        "photos": (
            code_fingerprint(),
            sorted(files.photo_contents.items()),
            "masks" if job.masks else None,
            sorted(files.mask_contents.items()),
            settings.photos,
        ),
        "cameras": (*_camera_files(job.cameras), job.seed, settings.cameras),
        "cutout": (job.cut_out,),
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


def _finished(workspace: Workspace, fingerprints: dict[str, str], names: tuple[str, ...]) -> tuple[str, ...]:
    """Those of the stages, from the first one on, that need not be done again."""
    kept = (name for name in names if name in CHECKPOINTED)
    return tuple(takewhile(lambda name: workspace.is_finished(name, fingerprints[name]), kept))


def _camera_files(cameras: Path | None) -> list[Path | str]:
    """The files that may hold the given cameras; their images are among the photographs."""
    if cameras is None:
        return ["cameras"]
    source = cameras_source(cameras)
    if source.is_file():
        return ["cameras", source, source.with_name(SPARSE)]
    return sorted(path for path in source.rglob("*") if path.suffix in _CAMERA_FILES)


def _needed_bytes(num_photos: int, to_come: typing.Collection[str], settings: Settings) -> int:
    """About what these stages will write: generous, because a full disk ends them after minutes of work."""
    num_pixels = num_photos * round(settings.photos.max_side_px**2 * _SHORT_BY_LONG_SIDE)
    return _BYTES_FOR_RESULTS + num_pixels * sum(_BYTES_PER_PIXEL.get(name, 0) for name in to_come)


def _warn_of_unplaced(solved: SolvedCameras, num_photos: int, this: _Run) -> None:
    if solved.unplaced:
        names = "; ".join(f"{photo.name} ({photo.why})" for photo in solved.unplaced)
        this.warn(f"{len(solved.unplaced)} of {num_photos} photographs could not be placed: {names}.")


def _decisions(*results: typing.Any) -> tuple[Decision, ...]:
    """The decisions of all stages, in their order, each once."""
    found = (decision for result in results for decision in getattr(result, "decisions", ()))
    return tuple(dict.fromkeys(found))
