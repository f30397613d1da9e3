"""The command that measures speed against error over a suite of cases."""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from itertools import product
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING

from ..benchmark.suites import SUITES, Found, Suite, find_cases, with_budget
from ..errors import ErrorCode, ReconstructionError
from ..failures import output_unusable
from ..wire.client import backend_command
from ..wire.protocol import DEVICES, PRESETS
from .argument_types import count, positive_seconds
from .cancelling import CancelRequest, catch_signals, watch_signals
from .reconstruct import settle

if TYPE_CHECKING:
    from ..benchmark.measuring import Measurement


def add_benchmark(parser: argparse.ArgumentParser) -> None:
    """The command's words."""
    add = parser.add_argument
    add("suite", choices=tuple(SUITES), help="what to measure")
    add(
        "--output",
        metavar="DIR",
        type=Path,
        required=True,
        help="new, empty, or of a benchmark to go on with",
    )
    add("--scenes", metavar="DIR", type=Path, help="the suite's scenes, as make renders them")
    add("--photos", metavar="DIR", type=Path, help="the sets of real photographs")
    add("--cases", nargs="+", metavar="CASE", help="of the suite, only these")
    add(
        "--presets",
        nargs="+",
        choices=PRESETS,
        metavar="PRESET",
        default=["fast", "balanced"],
        help=f"of {', '.join(PRESETS)} (fast balanced)",
    )
    add("--seeds", type=count, metavar="N", default=3, help="how often to run everything (3)")
    add(
        "--budgets",
        nargs="+",
        type=positive_seconds,
        metavar="S",
        default=[],
        help="run each preset also with these times for fitting the surface",
    )
    add("--only-budgets", action="store_true", help="leave out the runs without a budget")
    add("--device", choices=DEVICES, default="auto", help="where to compute (auto)")
    add(
        "--record",
        metavar="DIR",
        type=Path,
        help="where to leave SUITE.json and SUITE.md, to be kept with the code",
    )


def benchmark(parsed: argparse.Namespace, *, program: Sequence[str] | None = None) -> int:
    """Measure the suite and leave results.json, table.md and plot.svg; the exit code.

    What was measured before in the same folder is kept where nothing that it depends on has changed.
    `program` is the command that starts the backend: by default this one.
    """
    request = CancelRequest()
    watch_signals(request, lambda: None)
    command = tuple(program or backend_command(sys.executable))
    return settle(
        lambda: _measure_all(parsed, command, request),
        failed=lambda error: _say(f"Error: {error.text}\n{error.remedy}"),
        cancelled=lambda: _say(f"Stopped; what was measured is in {parsed.output}."),
    )


def _measure_all(parsed: argparse.Namespace, program: tuple[str, ...], request: CancelRequest) -> None:
    # Here, so that the other commands start without torch; and before hours of work, if one is missing.
    from ..benchmark.measuring import (
        Trial,
        inputs_of,
        measure,
        measured_before,
        measuring_fingerprint,
        suite_written,
    )
    from ..benchmark.record import write_record
    from ..benchmark.writing import machine_facts, write_results
    from ..machine import choose_device

    catch_signals()
    suite = SUITES[parsed.suite]
    found = find_cases(_chosen(suite, parsed.cases), parsed.scenes, parsed.photos)
    _check(parsed, found, suite_written(parsed.output))
    device = choose_device(parsed.device).type
    budgets_s = parsed.budgets if parsed.only_budgets else [None, *parsed.budgets]
    machine = machine_facts()
    about = {
        "suite": parsed.suite,
        "device": device,
        "machine": machine,
        "missing": found.missing,
    }
    if found.missing:
        _say(f"Left out, because their files are not there: {', '.join(found.missing)}")
    trials = [
        Trial(case=case, folder=folder, preset=preset, seed=seed, device=device, budget_s=budget_s)
        for case, folder in found.cases
        for preset, budget_s, seed in product(parsed.presets, budgets_s, range(parsed.seeds))
    ]
    # those of cases that are not asked for now stay
    runs = measured_before(parsed.output, find_cases(suite, parsed.scenes, parsed.photos), machine)

    def measured() -> list["Measurement"]:
        asked_first = dict.fromkeys((*trials, *runs))
        return [runs[trial] for trial in asked_first if trial in runs]

    def write() -> None:
        write_results(parsed.output, {**about, **_asked(measured())}, measured())

    if runs:
        _say(f"Kept from before, as nothing that it depends on has changed: {len(runs)}.")
    write()  # of nothing, too: who is killed in the first run finds the folder begun
    for trial in trials:
        if trial not in runs:
            runs[trial] = measure(
                trial,
                parsed.output / "runs" / trial.name,
                inputs=inputs_of(trial, machine),
                program=program,
                request=request,
            )
            _say(_line(runs[trial]))
            write()
    if parsed.record is not None:
        today = datetime.now(UTC).date().isoformat()
        everything = {**about, **_asked(measured())}
        write_record(parsed.record, everything, measured(), code=measuring_fingerprint(), date=today)
    sys.stdout.write(f"{parsed.output / 'table.md'}\n")


def _chosen(suite: Suite, names: Sequence[str] | None) -> Suite:
    """The suite with the cases of these names alone, or all of it."""
    if names is None:
        return suite
    cases = {case.name: case for case in suite.cases}
    if unknown := [name for name in names if name not in cases]:
        raise ReconstructionError(
            ErrorCode.SETTINGS_INVALID,
            f"The suite {suite.name} has no case {', '.join(unknown)}.",
            f"It has {', '.join(cases)}.",
        )
    return replace(suite, cases=tuple(cases[name] for name in names))


def _asked(runs: Sequence["Measurement"]) -> dict[str, object]:
    """What the runs were asked for, in this call or in those before whose runs are kept."""
    return {
        "presets": list(dict.fromkeys(run.preset for run in runs)),
        "budgets_s": sorted({run.budget_s for run in runs if run.budget_s is not None}),
        "seeds": sorted({run.seed for run in runs}),
    }


def _check(parsed: argparse.Namespace, found: Found, begun: str | None) -> None:
    """ReconstructionError where there is nothing to measure or no place for it.

    `begun` is the suite that the output folder holds numbers of.
    """
    if parsed.only_budgets and not parsed.budgets:
        raise ReconstructionError(
            ErrorCode.SETTINGS_INVALID,
            "--only-budgets leaves nothing to measure where there are no budgets.",
            "Give --budgets with the seconds for the surface, or leave --only-budgets out.",
        )
    if not found.cases:
        raise ReconstructionError(
            ErrorCode.NO_PHOTOS,
            f"None of the cases of {parsed.suite} is there.",
            "Run `make benchmark`, which renders the scenes, or give --scenes and --photos.",
        )
    output: Path = parsed.output
    for folder in filter(None, (output, parsed.record)):  # the record, too, before hours of work
        _make_writable(folder)
    text = ""
    if begun is None and any(output.iterdir()):
        text = f"{output} is neither an empty folder nor that of a benchmark."
    elif begun not in (None, parsed.suite):
        text = f"{output} holds the numbers of the suite {begun}, which would be lost."
    if text:
        remedy = "Choose a new folder for --output."
        raise ReconstructionError(ErrorCode.OUTPUT_UNUSABLE, text, remedy)


def _make_writable(folder: Path) -> None:
    """Make the folder where it is missing; ReconstructionError(OUTPUT_UNUSABLE) where it takes no file."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        TemporaryFile(dir=folder).close()
    except OSError as error:
        text = f"{folder} cannot be written ({error.strerror or error})."
        raise output_unusable(error, text, "Choose a folder that you may write to.") from error


def _line(run: "Measurement") -> str:
    """A run in a line for a person who waits."""
    name = f"{run.case}, {with_budget(run.preset, run.budget_s)}, seed {run.seed}"
    if run.failure is not None:
        return f"{name}: {run.failure}"
    words = [f"{run.numbers['after_cameras_s']:.1f} s after the cameras"]
    known = (
        ("visible_chamfer_percent", "visible Chamfer {:.3f} %"),
        ("held_out_psnr_db", "held out {:.1f} dB"),
    )
    values = ((run.numbers.get(number), text) for number, text in known)
    return (
        f"{name}: {', '.join([*words, *(text.format(value) for value, text in values if value is not None)])}"
    )


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")
