"""The command line: python -m backend COMMAND; --help lists the commands."""

import argparse
import faulthandler
import io
import logging
import sys
from pathlib import Path
from typing import Any

from . import doctor
from .commands import install
from .commands.argument_types import finite_number, positive_seconds, seed
from .commands.benchmark import add_benchmark, benchmark
from .commands.doctor import doctor_on_wire
from .commands.fit_points import add_fit_points, fit_points_command
from .commands.reconstruct import EXIT_FINE, EXIT_USER_ERROR, on_terminal, on_wire
from .commands.rehearse import ENDS, rehearse
from .commands.render import add_render, render
from .standard_streams import open_closed_streams
from .waiting import set_waiting_policy
from .wire.environment import BUILDS
from .wire.protocol import DEVICES, PRESETS, PROTOCOL_VERSION, Job

_CAMERA_OPTIONS = ("output", "cameras", "masks", "cut_out", "preset", "seed")
_JOB_OPTIONS = (*_CAMERA_OPTIONS, "device", "truth", "without_ground")


def main(arguments: list[str] | None = None) -> int:
    """Run a command; the exit code: 0 fine, 1 a fault of the program, 2 of the input, 130 stopped."""
    open_closed_streams()
    faulthandler.enable()
    if isinstance(sys.stdout, io.TextIOWrapper):
        # As stderr does: a pipe on Windows knows the letters of one language, and folders may have others.
        sys.stdout.reconfigure(errors="backslashreplace")
    set_waiting_policy()
    logging.basicConfig(level=logging.WARNING, stream=sys.stderr)
    logging.getLogger("backend").setLevel(logging.INFO)
    logging.getLogger().handlers[0].setLevel(logging.WARNING)
    return run(arguments)


def run(arguments: list[str] | None) -> int:
    """Run a command in a process that is set up; the exit code."""
    parser = _parser()
    parsed = parser.parse_args(arguments)
    if parsed.command == "doctor":
        return _doctor(as_json=parsed.json, on_wire=parsed.wire)
    if parsed.command == "install":
        return _install(parsed)
    if parsed.command == "benchmark":
        return benchmark(parsed)
    if parsed.command == "cameras":
        return _cameras(parsed)
    if parsed.command == "render":
        return render(parsed)
    if parsed.command == "fit-points":
        return fit_points_command(parsed)
    if parsed.command == "rehearse":
        return rehearse(parsed.output, seconds=parsed.seconds, end=parsed.end)
    return _reconstruct(parser, parsed)


def _reconstruct(parser: argparse.ArgumentParser, parsed: argparse.Namespace) -> int:
    given = {name: value for name in _JOB_OPTIONS if (value := getattr(parsed, name)) is not None}
    region: dict[str, Any] = {}
    if parsed.region is not None:
        *centre, radius = parsed.region
        if radius <= 0:
            parser.error("--region: the radius must be positive")
        region = {"region_centre": tuple(centre), "region_radius": radius}
    budget = {} if parsed.budget_seconds is None else {"budget_s": parsed.budget_seconds}
    if len(parsed.images) == 1 and parsed.images[0].endswith(".json"):
        options = [*given, *(["region"] if region else []), *(["budget-seconds"] if budget else [])]
        if options:
            words = ", ".join("--" + name.replace("_", "-") for name in options)
            parser.error(f"with a job file, {words} stands in the file")
        return on_wire(Path(parsed.images[0]))
    if "output" not in given:
        parser.error("--output is needed")
    job = Job(protocol=PROTOCOL_VERSION, images=tuple(parsed.images), **given, **region, **budget)
    return on_terminal(job, stop_with_stdin=parsed.stop_with_stdin)


def _cameras(parsed: argparse.Namespace) -> int:
    given = {name: value for name in _CAMERA_OPTIONS if (value := getattr(parsed, name)) is not None}
    return on_terminal(Job(protocol=PROTOCOL_VERSION, images=tuple(parsed.images), until="cameras", **given))


def _doctor(*, as_json: bool, on_wire: bool) -> int:
    if on_wire:
        return doctor_on_wire()
    checks = tuple(doctor.examine())
    sys.stdout.write((doctor.as_json if as_json else doctor.as_text)(checks) + "\n")
    return EXIT_FINE if doctor.is_ready(checks) else EXIT_USER_ERROR


def _install(parsed: argparse.Namespace) -> int:
    if parsed.remove:
        return install.remove(parsed.folder)
    return install.install(
        install.Plan(
            folder=parsed.folder,
            build=parsed.torch,
            again=parsed.again,
            requirements_file=parsed.requirements,
        )
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m backend", description="From a few photographs to a mesh."
    )
    commands = parser.add_subparsers(dest="command", required=True)
    reconstruct = commands.add_parser("reconstruct", help="make a mesh from photographs")
    add = reconstruct.add_argument
    add("images", nargs="+", metavar="IMAGES", help="image files or folders; or one job.json")
    add("--output", metavar="DIR", help="new or empty folder, or one of an earlier run to resume")
    add(
        "--cameras",
        metavar="FILE_OR_FOLDER",
        help="transforms.json, COLMAP model or finished run; else they are estimated",
    )
    add("--masks", metavar="FOLDER", help="an image per photograph, white on the subject")
    add("--preset", choices=PRESETS, help="speed against detail (balanced); others: for comparison")
    add("--device", choices=DEVICES, help="where to compute (auto: CUDA, else the CPU)")
    add("--seed", type=seed, metavar="N", help="random seed (0)")
    add("--truth", metavar="MESH", help="true mesh to measure the result against")
    add(
        "--region",
        nargs=4,
        type=finite_number,
        metavar=("X", "Y", "Z", "RADIUS"),
        help="sphere to reconstruct, in the frame of the cameras; else it is found",
    )
    _add_cut_out(reconstruct)
    add(
        "--without-ground",
        action="store_true",
        default=None,  # as of the options above: not asked for
        help="leave out the flat ground that the subject stands on",
    )
    add(
        "--budget-seconds",
        type=positive_seconds,
        metavar="S",
        help="time for fitting the surface, the rest of the run not counted (what the preset needs)",
    )
    add("--stop-with-stdin", action="store_true", help=argparse.SUPPRESS)
    _add_cameras(
        commands.add_parser("cameras", help="find where photographs were taken, and how sure that is")
    )
    add_render(commands.add_parser("render", help="pictures of a finished job from given cameras"))
    add_fit_points(commands.add_parser("fit-points", help="make a mesh from points alone"))
    check = commands.add_parser("doctor", help="check that everything needed is there")
    form = check.add_mutually_exclusive_group()
    form.add_argument("--json", action="store_true", help="for programs")
    form.add_argument("--wire", action="store_true", help="for the add-on: each check as it is made")
    _add_install(commands.add_parser("install", help="make an environment with everything needed"))
    rehearsal = commands.add_parser("rehearse", help="play a run's messages without running it")
    rehearsal.add_argument("--output", metavar="DIR", type=Path, help="new folder for a toy mesh")
    rehearsal.add_argument(
        "--seconds", metavar="S", type=finite_number, default=1.0, help="how long it takes (1)"
    )
    rehearsal.add_argument("--end", choices=ENDS, default="finished", help="how it ends (finished)")
    add_benchmark(commands.add_parser("benchmark", help="measure speed against error"))
    return parser


def _add_cameras(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("images", nargs="+", metavar="IMAGES", help="image files or folders")
    add("--output", metavar="DIR", required=True, help="folder of the results, as for reconstruct")
    add("--cameras", metavar="FILE_OR_FOLDER", help="cameras to be looked at; else they are estimated")
    add("--masks", metavar="FOLDER", help="an image per photograph, white on the subject")
    _add_cut_out(parser)
    add("--preset", choices=PRESETS, help="of a reconstruction that is to go on from here (balanced)")
    add("--seed", type=seed, metavar="N", help="random seed (0)")


def _add_cut_out(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--cut-out",
        action="store_true",
        default=None,  # as of the options above: not asked for
        help="cut the subject out of photographs without masks, by a network that is fetched once (179 MB)",
    )


def _add_install(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--folder", metavar="DIR", type=Path, required=True, help="where the environment is to be")
    add("--torch", choices=BUILDS, default="default", help="build of torch (default: the package index's)")
    add("--again", action="store_true", help="replace an environment that is ready")
    add("--remove", action="store_true", help="remove the environment instead")
    add("--requirements", metavar="FILE", type=Path, help=argparse.SUPPRESS)


if __name__ == "__main__":
    sys.exit(main())
