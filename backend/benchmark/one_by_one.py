"""The stages one by one on a case, without a job folder: so one of them can be changed or timed alone."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

import torch

from ..pipeline import fit_by_settings
from ..presets import Settings
from ..scene import Region, SolvedCameras, StereoResult, SurfaceMesh, View, no_progress
from ..stages.cameras.solving import CamerasConfig, solve_cameras
from ..stages.mesh.extraction import extract_mesh
from ..stages.photos import PhotosConfig, load_photos
from ..stages.region import find_region
from ..stages.stereo.camera_refinement import with_refined
from ..stages.stereo.matching import match_solved
from ..stages.surface import ShowSurface, Surface, show_nothing
from .suites import Case, image_paths

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Placed:
    """What stereo starts from."""

    solved: SolvedCameras
    region: Region

    @property
    def views(self) -> tuple[View, ...]:
        """The photographs with their cameras."""
        return self.solved.views

    def without_masks(self) -> "Placed":
        """The same photographs and the same region, with nothing cut out."""
        bare = tuple(replace(view, mask=None) for view in self.views)
        return replace(self, solved=replace(self.solved, views=bare))

    def with_doubted_cameras(self) -> "Placed":
        """The same with cameras that are held against the surface, as if they had been estimated."""
        return replace(self, solved=replace(self.solved, estimated=True))

    def refined(self, stereo: StereoResult) -> "Placed":
        """The same with the cameras that the depth maps belong to."""
        return replace(self, solved=with_refined(self.solved, stereo))


@dataclass(frozen=True, kw_only=True)
class Seconds:
    """What a stage took."""

    wall: float
    processor: float
    """Of all threads: what else a machine does hardly changes it."""


def solve(
    case: Case, folder: Path, indices: tuple[int, ...], photos: PhotosConfig, cameras: CamerasConfig
) -> SolvedCameras:
    """The case's images with these numbers, undistorted. Raises ReconstructionError."""
    masks = None if case.masks is None else folder / case.masks
    known = None if case.cameras is None else folder / case.cameras
    loaded = load_photos(image_paths(case, folder, indices), masks, photos, progress=no_progress)
    with TemporaryDirectory() as scratch:
        return solve_cameras(loaded, known, cameras, workdir=Path(scratch), seed=0, progress=no_progress)


def place(case: Case, folder: Path, indices: tuple[int, ...], settings: Settings) -> Placed:
    """The case's images with these numbers, undistorted, and the region. Raises ReconstructionError."""
    solved = solve(case, folder, indices, settings.photos, settings.cameras)
    region = find_region(solved, settings.region, progress=no_progress)
    return Placed(solved=solved, region=region)


def match(placed: Placed, settings: Settings, device: torch.device) -> tuple[StereoResult, Seconds]:
    """Depth maps and points, and the seconds that they took.

    Raises ReconstructionError, and ValueError where the settings are those of a method without points.
    """
    if settings.stereo is None:
        raise ValueError(f"these settings ask for no points: {settings.train}")
    work = partial(match_solved, placed.solved, placed.region, settings.stereo, device=device)
    return _timed(partial(work, progress=no_progress))


def fit(
    placed: Placed,
    stereo: StereoResult,
    settings: Settings,
    *,
    seed: int,
    device: torch.device,
    show: ShowSurface = show_nothing,
) -> tuple[Surface, Seconds]:
    """The field, and the seconds that it took. Raises ReconstructionError."""
    work = partial(fit_by_settings, placed.views, placed.region, stereo, settings.train, show=show)
    generator = torch.Generator().manual_seed(seed)
    return _timed(partial(work, device=device, generator=generator, progress=no_progress))


def extract(
    placed: Placed, stereo: StereoResult, surface: Surface, settings: Settings
) -> tuple[SurfaceMesh, Seconds]:
    """The mesh, and the seconds that it took. Raises ReconstructionError."""
    work = partial(extract_mesh, placed.views, placed.region, stereo, surface, settings.mesh)
    return _timed(partial(work, progress=no_progress))


def _timed(work: Callable[[], T]) -> tuple[T, Seconds]:
    began, processor_began = time.perf_counter(), time.process_time()
    result = work()
    return result, Seconds(wall=time.perf_counter() - began, processor=time.process_time() - processor_began)
