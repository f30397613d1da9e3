"""The report: the mesh beside the photographs, what it cost, and how far it can be trusted.

`build_report` measures and draws, `render_report_html` makes one page that needs nothing but itself,
`report_numbers` the same facts for programs, with units in the keys.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np
import torch
import trimesh
from jaxtyping import Float32

from ..images import fitted_size, resized
from ..kernels.side_by_side import side_by_side
from ..maths.metrics import (
    ErrorAgainstTruth,
    SurfaceError,
    TrueSurface,
    psnr,
    samples_worth_it,
    surface_error,
    vertex_error_percent,
)
from ..maths.raycast import MeshImage, RayCaster, render_mesh
from ..report_page.pictures import (
    ERROR_STOPS_SRGB,
    SUPPORT_STOPS_SRGB,
    Picture,
    before_backdrop,
    clay,
    picture,
    turntable_cameras,
    value_map,
)
from ..report_page.template import filled
from ..scene import (
    Camera,
    Decision,
    Progress,
    Region,
    SolvedCameras,
    SurfaceMesh,
    SurfacePoints,
    View,
    within,
)

GUESSED_BELOW, MEASURED_FROM = 0.2, 0.6
"""Support of surface that counts as a guess, and of surface that counts as measured."""
ERROR_MAP_LIMIT_PERCENT = 2.0
"""Of the true diagonal: where the error map's last colour begins."""

Seen = TypeVar("Seen")
Drawn = TypeVar("Drawn")


@dataclass(frozen=True, kw_only=True)
class ReportConfig:
    """How much the page shows."""

    num_photos_shown: int = 4
    """Beside the mesh; all photographs are measured."""
    num_turntable: int = 4
    picture_px: int = 440
    """Longer side of a picture on the page; twice that is rendered."""
    error_samples: int = 200_000
    """Points drawn on either surface to compare it with the truth."""


@dataclass(frozen=True, kw_only=True)
class StageTiming:
    """What a stage took."""

    name: str
    seconds: float
    peak_memory_bytes: int | None
    """Of the process until the stage's end; None where the system does not tell."""


@dataclass(frozen=True, kw_only=True)
class ReportInputs:
    """What the run made, and how."""

    job_name: str
    settings: object
    """A dataclass, possibly of dataclasses."""
    seed: int
    timings: tuple[StageTiming, ...]
    warnings: tuple[str, ...]
    decisions: tuple[Decision, ...]
    """Of all stages, in their order."""
    solved: SolvedCameras
    region: Region
    points: SurfacePoints
    mesh: SurfaceMesh
    truth: TrueSurface | None
    versions: dict[str, str]
    """Program to version."""


@dataclass(frozen=True, kw_only=True)
class PhotoFit:
    """How well the coloured mesh repeats a photograph."""

    name: str
    psnr_db: float | None
    """Inside the pixels that the mesh covers, and the mask where there is one; None where that is nothing."""
    covered_share: float
    """Of the photograph's pixels."""
    silhouette_overlap: float | None
    """Intersection over union of mesh and mask; None without a mask."""
    panels: tuple[Picture, ...] = ()
    """Photograph, mesh in its colours, in clay, in the colours of its support; empty where not shown."""


@dataclass(frozen=True, kw_only=True)
class MeshFacts:
    """Facts about the mesh; shares are of its area."""

    num_vertices: int
    num_faces: int
    num_pieces: int
    watertight: bool
    size_world: tuple[float, float, float]
    """Of the bounding box, world units."""
    support_histogram: tuple[float, ...]
    """Share of the area in ten equal steps of support, from guessed to measured."""
    guessed_share: float
    measured_share: float


@dataclass(frozen=True, kw_only=True)
class Report:
    """All that the page shows."""

    inputs: ReportInputs
    photos: tuple[PhotoFit, ...]
    mesh: MeshFacts
    turntable: tuple[Picture, ...]
    error: ErrorAgainstTruth | None
    error_maps: tuple[Picture, ...]

    @property
    def total_seconds(self) -> float:
        """Sum over the stages."""
        return math.fsum(timing.seconds for timing in self.inputs.timings)

    @property
    def peak_memory_bytes(self) -> int | None:
        """Highest of any stage."""
        known = [t.peak_memory_bytes for t in self.inputs.timings if t.peak_memory_bytes is not None]
        return max(known, default=None)

    @property
    def mean_psnr_db(self) -> float | None:
        """Mean over the photographs that the mesh covers."""
        known = [photo.psnr_db for photo in self.photos if photo.psnr_db is not None]
        return sum(known) / len(known) if known else None


def build_report(inputs: ReportInputs, config: ReportConfig, *, progress: Progress) -> Report:
    """Measure the mesh against the photographs, and against the truth where there is one; draw it."""
    mesh, views, truth = inputs.mesh, inputs.solved.views, inputs.truth
    caster = RayCaster(mesh.vertices, mesh.faces)
    given = [view.camera for view in views]
    shown = {views[index].name for index in _evenly(len(views), config.num_photos_shown)}

    def fit_photo(view: View) -> PhotoFit:
        return _fit_photo(view, mesh, caster, config.picture_px, with_panels=view.name in shown)

    told = within(progress, 0.0, 0.6)
    photos = _in_turn(fit_photo, views, told, lambda view: f"comparing with {view.name}")
    error: ErrorAgainstTruth | None = None
    drawn = mesh
    if truth is not None:
        progress(0.6, "measuring against the truth")
        seed, num_samples = inputs.seed, samples_worth_it(mesh, truth, config.error_samples)
        error = surface_error(mesh, truth, cameras=given, seed=seed, num_samples=num_samples)
        # The error takes the place of the support, which is drawn in colours from 0 to 1.
        distance = vertex_error_percent(mesh, truth, seed=seed, num_samples=num_samples)
        drawn = replace(mesh, support=distance / np.float32(ERROR_MAP_LIMIT_PERCENT))
    cameras = turntable_cameras(given, mesh.vertices, config.num_turntable, 2 * config.picture_px)
    draw = partial(_from_new_side, drawn, caster, with_error=error is not None)
    told = within(progress, 0.7, 1.0)
    sides = _in_turn(draw, list(enumerate(cameras, 1)), told, lambda _: "drawing the mesh from other sides")
    return Report(
        inputs=inputs,
        photos=tuple(photos),
        mesh=mesh_facts(mesh),
        turntable=tuple(shape for shape, _ in sides),
        error=error,
        error_maps=tuple(map_ for _, map_ in sides if map_ is not None),
    )


def _in_turn(
    draw: Callable[[Seen], Drawn], seen: Sequence[Seen], progress: Progress, doing: Callable[[Seen], str]
) -> list[Drawn]:
    """What is drawn of each, as many at a time as there are threads, with progress before each of these."""
    threads = torch.get_num_threads()
    drawn: list[Drawn] = []
    while len(drawn) < len(seen):
        first = len(drawn)
        progress(first / len(seen), doing(seen[first]))
        drawn += side_by_side(draw, seen[first : first + threads], threads)
    return drawn


def mesh_facts(mesh: SurfaceMesh) -> MeshFacts:
    """Counts, closedness and support of a mesh with at least one face."""
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    area = np.asarray(solid.area_faces, np.float64)
    support = mesh.support[mesh.faces].mean(axis=1)
    histogram, _ = np.histogram(support, bins=10, range=(0.0, 1.0), weights=area / area.sum())
    x, y, z = np.ptp(mesh.vertices, axis=0)
    return MeshFacts(
        num_vertices=len(mesh.vertices),
        num_faces=len(mesh.faces),
        num_pieces=int(solid.body_count),
        watertight=bool(solid.is_watertight),
        size_world=(float(x), float(y), float(z)),
        support_histogram=tuple(float(share) for share in histogram),
        guessed_share=float(area[support < GUESSED_BELOW].sum() / area.sum()),
        measured_share=float(area[support >= MEASURED_FROM].sum() / area.sum()),
    )


def render_report_html(report: Report) -> str:
    """One page without anything outside itself: styles inline, pictures as data URIs."""
    return filled(
        "page.html.j2",
        report=report,
        inputs=report.inputs,
        mesh=report.mesh,
        settings=flat_settings(report.inputs.settings),
        support_stops=SUPPORT_STOPS_SRGB,
        error_stops=ERROR_STOPS_SRGB,
        error_limit=ERROR_MAP_LIMIT_PERCENT,
    )


def report_numbers(report: Report) -> dict[str, object]:
    """The report's facts as JSON knows them (no NaN, no infinity), with units in the keys."""
    inputs, solved = report.inputs, report.inputs.solved
    return {
        "job": inputs.job_name,
        "seed": inputs.seed,
        "versions": dict(inputs.versions),
        "settings": dict(flat_settings(inputs.settings)),
        "warnings": list(inputs.warnings),
        "decisions": [dataclasses.asdict(decision) for decision in inputs.decisions],
        "stages": [dataclasses.asdict(timing) for timing in inputs.timings],
        "total_seconds": report.total_seconds,
        "peak_memory_bytes": report.peak_memory_bytes,
        "cameras": {
            "estimated": solved.estimated,
            "num_placed": len(solved.views),
            "unplaced": [photo.name for photo in solved.unplaced],
            "unplaced_because": [photo.why for photo in solved.unplaced],
            "reprojection_error_px": solved.reprojection_error_px,
        },
        "num_stereo_points": len(inputs.points.positions),
        "region": {
            "centre_world": inputs.region.centre_world.tolist(),
            "radius_world": inputs.region.radius_world,
        },
        "mesh": dataclasses.asdict(report.mesh),
        "mean_psnr_db": _finite_or_none(report.mean_psnr_db),
        "photos": [_photo_numbers(photo) for photo in report.photos],
        "error": None if report.error is None else error_numbers(report.error),
    }


def flat_settings(settings: object, prefix: str = "") -> tuple[tuple[str, object], ...]:
    """(dotted name, value) of every field of a dataclass of dataclasses; values as JSON knows them."""
    if not dataclasses.is_dataclass(settings):
        plain = settings is None or isinstance(settings, bool | int | float | str)
        return ((prefix, settings if plain else str(settings)),)
    dot = f"{prefix}." if prefix else ""
    return tuple(
        pair
        for field in dataclasses.fields(settings)
        for pair in flat_settings(getattr(settings, field.name), f"{dot}{field.name}")
    )


def _evenly(count: int, wanted: int) -> list[int]:
    """Indices spread over all, first and last among them."""
    return sorted({round(place) for place in np.linspace(0, count - 1, min(count, wanted))})


def _render_camera(view: View, picture_px: int) -> Camera:
    """The view's camera at twice the page's picture size, never larger than the photograph."""
    width, height = fitted_size(view.camera.width, view.camera.height, 2 * picture_px)
    return view.camera.resized(width, height)


def _page_size(camera: Camera) -> tuple[int, int]:
    """(width, height) of the picture made of what a camera rendered at twice its size."""
    return max(1, camera.width // 2), max(1, camera.height // 2)


def _fit_photo(
    view: View, mesh: SurfaceMesh, caster: RayCaster, picture_px: int, *, with_panels: bool
) -> PhotoFit:
    camera = _render_camera(view, picture_px)
    image = render_mesh(mesh, camera, caster=caster)
    photo = resized(view.image_srgb, camera.width, camera.height)
    inside, overlap = image.coverage, None
    if view.mask is not None:
        mask = resized(view.mask, camera.width, camera.height) > 0.5
        inside = image.coverage & mask
        overlap = float(inside.sum() / max(1, (image.coverage | mask).sum()))
    return PhotoFit(
        name=view.name,
        psnr_db=psnr(photo, image.colour_srgb, inside),
        covered_share=float(image.coverage.mean()),
        silhouette_overlap=overlap,
        panels=_panels(view.name, photo, image, camera) if with_panels else (),
    )


def _panels(
    name: str, photo: Float32[np.ndarray, "height width 3"], image: MeshImage, camera: Camera
) -> tuple[Picture, ...]:
    size = _page_size(camera)
    painted = before_backdrop(image.colour_srgb[image.coverage], image.coverage)
    return (
        picture(photo, size, f"The photograph {name}"),
        picture(painted, size, f"The mesh in its colours, seen from where {name} was taken"),
        picture(clay(image, camera), size, f"The mesh as grey clay, seen from where {name} was taken"),
        picture(
            value_map(image, camera, SUPPORT_STOPS_SRGB),
            size,
            f"Which parts of the mesh the photographs support, seen from where {name} was taken",
        ),
    )


def _from_new_side(
    drawn: SurfaceMesh, caster: RayCaster, numbered: tuple[int, Camera], *, with_error: bool
) -> tuple[Picture, Picture | None]:
    """The mesh as clay and, where its support stands for the error, a map of that."""
    number, camera = numbered
    image, size = render_mesh(drawn, camera, caster=caster), _page_size(camera)
    shape = picture(clay(image, camera), size, f"The mesh as grey clay from new side {number}")
    if not with_error:
        return shape, None
    errors = value_map(image, camera, ERROR_STOPS_SRGB)
    return shape, picture(errors, size, f"Distance of the mesh from the truth, from new side {number}")


def _photo_numbers(photo: PhotoFit) -> dict[str, object]:
    return {
        "name": photo.name,
        "psnr_db": _finite_or_none(photo.psnr_db),
        "covered_share": photo.covered_share,
        "silhouette_overlap": photo.silhouette_overlap,
    }


def error_numbers(error: ErrorAgainstTruth) -> dict[str, object]:
    """The error with units in the keys, as report.json holds it."""

    def part(found: SurfaceError | None) -> dict[str, object] | None:
        if found is None:
            return None
        return {**dataclasses.asdict(found), "chamfer_percent": found.chamfer_percent}

    return {
        "whole": part(error.whole),
        "visible": part(error.visible),
        "visible_share_of_truth": error.visible_share_of_truth,
        "visible_share_of_mesh": error.visible_share_of_mesh,
        "truth_diagonal_world": error.truth_diagonal_world,
        "support": dataclasses.asdict(error.support),
    }


def _finite_or_none(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
