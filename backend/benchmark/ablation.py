"""What each part is worth: the stages after the cameras, with one part changed at a time."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

from ..errors import ReconstructionError
from ..machine import choose_device, peak_memory_bytes, set_up_torch
from ..maths.metrics import load_truth, surface_error
from ..presets import Settings
from ..provenance import versions
from ..scene import StereoResult, SurfaceMesh, View
from ..stages.report import error_numbers
from ..stages.surface import Surface
from ..stages.train.surface_fit import TrainConfig
from ..workspace import fingerprint
from .among_surroundings import error_of_subject
from .held_out import held_out_fit, known_views
from .measuring import Measurement, Numbers, case_files, flat_errors, measuring_fingerprint
from .one_by_one import Seconds, extract, fit, match, place
from .suites import Case
from .summary import Column
from .variants import Variant

T = TypeVar("T")

COLUMNS = (
    Column(heading="visible Chamfer %", number="visible_chamfer_percent", digits=3),
    Column(heading="F@1%", number="visible_f_score_at_one_percent", digits=3),
    Column(heading="normals", number="visible_normal_consistency", digits=3),
    Column(heading="whole Chamfer %", number="whole_chamfer_percent", digits=3),
    Column(heading="held out dB", number="held_out_psnr_db", digits=1),
    Column(heading="stereo s", number="stereo_processor_s", digits=1),
    Column(heading="field s", number="train_processor_s", digits=1),
    Column(heading="mesh s", number="mesh_processor_s", digits=1),
    Column(heading="memory GB", number="peak_memory_bytes", digits=2, scale=1e-9),
)
"""Seconds are the processor's, of all threads."""


@dataclass(frozen=True, kw_only=True)
class Step(Generic[T]):
    """A stage's result and its cost."""

    result: T
    took: Seconds
    peak_memory_bytes: int | None
    """Of the process, until then."""


@dataclass(frozen=True, kw_only=True)
class Known:
    """What need not be done again for a variant, because an earlier one had the same settings."""

    stereo: Step[StereoResult] | None = None
    surface: Step[Surface] | None = None


Alone = Callable[..., tuple[Measurement, Known]]
"""Calls a function with arguments, as `benchmarks.chosen.alone` does in a process of its own."""


def at_once(work: Callable[..., tuple[Measurement, Known]], *arguments: Any) -> tuple[Measurement, Known]:
    """In this process: then the peak of memory is that of all runs so far."""
    return work(*arguments)


def is_random(settings: Settings) -> bool:
    """Whether another seed gives another surface: rendering draws by lot, the linear fit does not."""
    return not isinstance(settings.train, TrainConfig) or any(settings.train.steps)


def inputs_of(case: Case, folder: Path, variant: Variant, device: str, machine: Mapping[str, object]) -> str:
    """Changes with all that a variant's numbers depend on, but the seed."""
    parts = (variant, variant.settings, case, device, sorted(machine.items()))
    return fingerprint(measuring_fingerprint(), Path(__file__), *parts, *case_files(case, folder))


def measure_variants(
    case: Case,
    folder: Path,
    variants: Sequence[Variant],
    *,
    num_seeds: int,
    device: str,
    done: Mapping[tuple[str, int], Measurement],
    alone: Alone = at_once,
) -> Iterator[Measurement]:
    """Each variant on a case, once for each seed where it is random; its name stands for the preset's.

    What is `done`, by variant's name and seed, is given back as it is. Stereo and field are used again, with
    what they cost, where their settings are the same. Raises ReconstructionError where the cameras or the
    region cannot be found; what fails later is told in the measurement.
    """
    known: dict[object, Step[Any]] = {}
    for variant in variants:
        settings = variant.settings
        for seed in range(num_seeds if is_random(settings) else 1):
            if (variant.name, seed) in done:
                yield done[variant.name, seed]
                continue
            of_stereo = (settings.photos, settings.stereo, variant.with_masks, variant.cameras_doubted)
            of_surface = (of_stereo, settings.train, seed)
            before = Known(stereo=known.get(of_stereo), surface=known.get(of_surface))
            measurement, after = alone(measure_variant, case, folder, variant, seed, device, before)
            if after.stereo is not None:
                known[of_stereo] = after.stereo
            if after.surface is not None:
                known[of_surface] = after.surface
            yield measurement


def measure_variant(
    case: Case, folder: Path, variant: Variant, seed: int, device_kind: str, known: Known
) -> tuple[Measurement, Known]:
    """A variant on a case in this process, and what it made."""
    device = choose_device(device_kind)
    set_up_torch(device)
    settings = variant.settings
    done = partial(
        Measurement, case=case.name, preset=variant.name, seed=seed, versions=versions(), device=device.type
    )
    placed = place(case, folder, case.given, settings)
    placed = placed if variant.with_masks else placed.without_masks()
    placed = placed.with_doubted_cameras() if variant.cameras_doubted else placed
    try:
        stereo = known.stereo or _step(*match(placed, settings, device))
        known = replace(known, stereo=stereo)
        placed = placed.refined(stereo.result)
        made = known.surface or _step(*fit(placed, stereo.result, settings, seed=seed, device=device))
        known = replace(known, surface=made)
        mesh = _step(*extract(placed, stereo.result, made.result, settings))
    except ReconstructionError as error:
        return done(numbers={}, failure=error.text), known
    numbers = {
        **_costs({"stereo": stereo, "train": made, "mesh": mesh}),
        **errors_of(case, folder, mesh.result, placed.views, seed, settings.report.error_samples),
    }
    return done(numbers=numbers), known


def _step(result: T, took: Seconds) -> Step[T]:
    return Step(result=result, took=took, peak_memory_bytes=peak_memory_bytes())


def _costs(steps: Mapping[str, Step[Any]]) -> dict[str, float | None]:
    peaks = [step.peak_memory_bytes for step in steps.values() if step.peak_memory_bytes is not None]
    costs: dict[str, float | None] = {"peak_memory_bytes": max(peaks) if peaks else None}
    for name, step in steps.items():
        costs |= {f"{name}_s": step.took.wall, f"{name}_processor_s": step.took.processor}
    return costs


def errors_of(
    case: Case, folder: Path, mesh: SurfaceMesh, views: Sequence[View], seed: int, num_samples: int
) -> Numbers:
    """As a benchmark measures them, and by the same names."""
    numbers: dict[str, float | None] = {}
    if case.truth is not None:
        truths = [load_truth(folder / name) for name in (case.truth, case.surroundings) if name is not None]
        measure = surface_error if case.surroundings is None else error_of_subject
        cameras = [view.camera for view in views]
        error = measure(mesh, *truths, cameras=cameras, seed=seed, num_samples=num_samples)
        numbers |= flat_errors({} if error is None else error_numbers(error))
    if case.held_out:
        numbers["held_out_psnr_db"] = held_out_fit(mesh, known_views(case, folder, case.held_out)).psnr_db
    return numbers
