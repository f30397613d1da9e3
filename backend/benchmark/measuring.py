"""One run, in a process of its own, because a process knows only one peak of its memory; and its numbers."""

import dataclasses
import json
import os
import shutil
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

from ..commands.cancelling import CancelRequest
from ..commands.child import run_child
from ..errors import ReconstructionError
from ..machine import choose_device
from ..maths.metrics import load_truth
from ..mesh_files import read_mesh
from ..presets import PRESETS
from ..provenance import code_fingerprint
from ..records import load_record
from ..results import RADIANCE
from ..stages.radiance import Radiance
from ..stages.report import error_numbers
from ..waiting import without_own_policy
from ..wire.client import ROOT, clean_environment
from ..workspace import fingerprint
from .among_surroundings import error_of_subject
from .held_out import held_out_fit, held_out_radiance_fit, known_views
from .suites import Case, Found, image_paths, with_budget

_MEASURING = ("among_surroundings.py", "held_out.py", "measuring.py", "one_by_one.py")
_WITH_KNOWN_CAMERAS = ("region", "stereo", "train", "mesh")
"""The stages after the cameras."""
_ERRORS = (
    "chamfer_percent",
    "accuracy_percent",
    "completeness_percent",
    "f_score_at_half_percent",
    "f_score_at_one_percent",
    "normal_consistency",
)

Numbers = Mapping[str, float | None]
"""By name; the unit is its last word. None where there is nothing to measure, as without a truth."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """What is to be run."""

    case: Case
    folder: Path
    """Of the case."""
    preset: str
    seed: int
    device: str
    """Its kind; "auto" is none."""
    budget_s: float | None = None
    """For the field stage; None for what the preset needs."""

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"{self.case.name}-{with_budget(self.preset, self.budget_s)}-{self.seed}-{self.device}"


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """What a run gave."""

    case: str
    preset: str
    seed: int
    numbers: Numbers
    """Empty where the run failed."""
    versions: Mapping[str, str]
    budget_s: float | None = None
    failure: str | None = None
    """What the run, or the comparison with held-out views, said last."""
    device: str = ""
    """The kind that it ran on."""
    inputs: str = ""
    """Fingerprint of all that the numbers depend on."""


def inputs_of(trial: Trial, machine: Mapping[str, object]) -> str:
    """Changes with the code, the preset's settings, the case's files and the machine."""
    settings = dataclasses.replace(trial, folder=Path(trial.case.folder)), PRESETS[trial.preset]
    given = case_files(trial.case, trial.folder)
    return fingerprint(measuring_fingerprint(), settings, sorted(machine.items()), *given)


def case_files(case: Case, folder: Path) -> tuple[Path, ...]:
    """Files and folders that a case is read from."""
    return tuple(folder / name for name in (case.images, *case.files))


@cache
def measuring_fingerprint() -> str:
    """Changes with the code of runs and with that which measures them."""
    return fingerprint(code_fingerprint(), *measuring_sources())


def measuring_sources() -> tuple[Path, ...]:
    """The files whose code makes numbers of a run, beside those of the run itself."""
    here = Path(__file__).parent
    return (*(here / name for name in _MEASURING), here.parent / "mesh_files.py", here.parent / "records.py")


def measured_before(output: Path, found: Found, machine: Mapping[str, object]) -> dict[Trial, Measurement]:
    """What a benchmark left in the folder, on any device, where nothing that it depends on has changed."""
    places = {case.name: (case, folder) for case, folder in found.cases}
    kept = {}
    for run in runs_written(output):
        if run.case in places and run.preset in PRESETS and run.failure is None:
            case, folder = places[run.case]
            trial = Trial(
                case=case,
                folder=folder,
                preset=run.preset,
                seed=run.seed,
                device=run.device,
                budget_s=run.budget_s,
            )
            if inputs_of(trial, machine) == run.inputs:
                kept[trial] = run
    return kept


def runs_written(output: Path) -> tuple[Measurement, ...]:
    """All that results.json in a folder holds; nothing where there is none of today's form."""
    try:
        written = json.loads((output / "results.json").read_text(encoding="utf-8"))["runs"]
        return tuple(Measurement(**run) for run in written)
    except (OSError, ValueError, KeyError, TypeError):
        return ()


def suite_written(output: Path) -> str | None:
    """Name of the suite whose results.json is in the folder; None where there is none."""
    try:
        written = json.loads((output / "results.json").read_text(encoding="utf-8"))
        return str(written["suite"]) if "runs" in written else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def measure(
    trial: Trial, output: Path, *, inputs: str, program: tuple[str, ...], request: CancelRequest
) -> Measurement:
    """Run the trial from nothing into `output`; what a trial before left there is removed.

    `inputs` is the trial's fingerprint, `program` the command that starts the backend. Raises Cancelled.
    """
    shutil.rmtree(output, ignore_errors=True)
    last_lines: deque[str] = deque(maxlen=2)
    started = time.perf_counter()
    exit_code = run_child(
        (*program, *reconstruct_words(trial, output), "--stop-with-stdin"),
        environment=clean_environment(without_own_policy(os.environ)),
        folder=ROOT,
        request=request,
        on_line=lambda line: last_lines.append(line.strip()) if line.strip() else None,
    )
    wall_s = time.perf_counter() - started
    done = partial(
        Measurement,
        case=trial.case.name,
        preset=trial.preset,
        budget_s=trial.budget_s,
        seed=trial.seed,
        device=trial.device,
        inputs=inputs,
    )
    if exit_code:
        words = " ".join([f"ended with exit code {exit_code}:", *last_lines])
        return done(numbers={}, versions={}, failure=words)
    report = json.loads((output / "report.json").read_text(encoding="utf-8"))
    numbers = {**report_numbers(report), "wall_s": wall_s}
    failure = None
    try:
        if trial.case.surroundings is not None:
            numbers |= _errors_of_subject(trial, output)
        if trial.case.held_out:
            numbers |= _held_out_numbers(trial, output)
    except ReconstructionError as error:
        failure = str(error)
    return done(numbers=numbers, versions=report["versions"], failure=failure)


def reconstruct_words(trial: Trial, output: Path) -> tuple[str, ...]:
    """The trial as words of the command line; the held-out images are not among them."""
    case, folder = trial.case, trial.folder.absolute()
    files = {"--cameras": case.cameras, "--masks": case.masks, "--truth": case.truth}
    options = {option: str(folder / name) for option, name in files.items() if name is not None}
    options |= {"--preset": trial.preset, "--seed": str(trial.seed), "--device": trial.device}
    if trial.budget_s is not None:
        options["--budget-seconds"] = f"{trial.budget_s:g}"
    images = (str(path) for path in image_paths(case, folder, case.given))
    words = (word for option in options.items() for word in option)
    alone = ("--without-ground",) if case.without_ground else ()
    return ("reconstruct", *images, *words, *alone, "--output", str(output.absolute()))


def report_numbers(report: Mapping[str, Any]) -> dict[str, float | None]:
    """What a run's report.json says, flat."""
    seconds = {stage["name"]: float(stage["seconds"]) for stage in report["stages"]}
    numbers: dict[str, float | None] = {f"{name}_s": value for name, value in seconds.items()}
    numbers["after_cameras_s"] = sum(seconds[name] for name in _WITH_KNOWN_CAMERAS)
    numbers["total_s"] = report["total_seconds"]
    numbers["peak_memory_bytes"] = report["peak_memory_bytes"]
    numbers["given_psnr_db"] = report["mean_psnr_db"]
    numbers["watertight"] = float(report["mesh"]["watertight"])
    return numbers | flat_errors(report["error"] or {})


def flat_errors(error: Mapping[str, Any]) -> dict[str, float | None]:
    """The error of a report, flat; None for what was not compared with a truth."""
    numbers: dict[str, float | None] = {}
    for part in ("visible", "whole"):
        found = error.get(part) or {}
        numbers |= {f"{part}_{name}": found.get(name) for name in _ERRORS}
    numbers["support_auc"] = (error.get("support") or {}).get("auc")
    return numbers


def _held_out_numbers(trial: Trial, output: Path) -> dict[str, float | None]:
    views = known_views(trial.case, trial.folder, trial.case.held_out)
    if (output / RADIANCE).is_file():
        device = choose_device(trial.device)
        fit = held_out_radiance_fit(load_record(output / RADIANCE, Radiance), views, device)
    else:
        fit = held_out_fit(read_mesh(output / "mesh.ply"), views)
    return {"held_out_psnr_db": fit.psnr_db, "held_out_covered_share": fit.covered_share}


def _errors_of_subject(trial: Trial, output: Path) -> dict[str, float | None]:
    """In place of the report's errors, which count what is true of the surroundings as wrong."""
    case, folder = trial.case, trial.folder
    assert case.truth is not None
    assert case.surroundings is not None
    error = error_of_subject(
        read_mesh(output / "mesh.ply"),
        load_truth(folder / case.truth),
        load_truth(folder / case.surroundings),
        cameras=[view.camera for view in known_views(case, folder, case.given)],
        seed=trial.seed,
        num_samples=PRESETS[trial.preset].report.error_samples,
    )
    return flat_errors({} if error is None else error_numbers(error))
