"""The command line: python -m backend reconstruct | doctor | rehearse."""

import argparse
import faulthandler
import logging
import sys
from pathlib import Path

from .commands.reconstruct import EXIT_FINE, EXIT_USER_ERROR, on_terminal, on_wire
from .commands.rehearse import rehearse
from .wire.protocol import DEVICES, PRESETS, PROTOCOL_VERSION, Job

_JOB_OPTIONS = ("output", "cameras", "masks", "preset", "device", "seed", "truth")


def main(arguments: list[str] | None = None) -> int:
    """Run a command; the exit code: 0 fine, 1 a fault of the program, 2 of the input, 130 stopped."""
    faulthandler.enable()
    logging.basicConfig(level=logging.WARNING, stream=sys.stderr)
    logging.getLogger("backend").setLevel(logging.INFO)
    logging.getLogger().handlers[0].setLevel(logging.WARNING)
    parser = _parser()
    parsed = parser.parse_args(arguments)
    if parsed.command == "doctor":
        return _doctor(as_json=parsed.json)
    if parsed.command == "rehearse":
        return rehearse(parsed.output)
    given = {name: value for name in _JOB_OPTIONS if (value := getattr(parsed, name)) is not None}
    if len(parsed.images) == 1 and parsed.images[0].endswith(".json"):
        if given:
            parser.error(f"with a job file, {', '.join('--' + name for name in given)} stands in the file")
        return on_wire(Path(parsed.images[0]))
    if "output" not in given:
        parser.error("--output is needed")
    return on_terminal(Job(protocol=PROTOCOL_VERSION, images=tuple(parsed.images), **given))


def _doctor(*, as_json: bool) -> int:
    from . import doctor  # loads every package, which takes seconds

    checks = doctor.examine()
    sys.stdout.write((doctor.as_json if as_json else doctor.as_text)(checks) + "\n")
    return EXIT_FINE if doctor.is_ready(checks) else EXIT_USER_ERROR


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
        "--cameras", metavar="FILE_OR_FOLDER", help="transforms.json or COLMAP model; else they are estimated"
    )
    add("--masks", metavar="FOLDER", help="an image per photograph, white on the subject")
    add("--preset", choices=PRESETS, help="speed against detail (balanced)")
    add("--device", choices=DEVICES, help="where to compute (auto: the fastest there is)")
    add("--seed", type=_seed, metavar="N", help="of all chance (0)")
    add("--truth", metavar="MESH", help="true mesh to measure the result against")
    doctor = commands.add_parser("doctor", help="check that everything needed is there")
    doctor.add_argument("--json", action="store_true", help="for programs")
    rehearsal = commands.add_parser("rehearse", help="play a run's messages without running it")
    rehearsal.add_argument("--output", metavar="DIR", type=Path, help="new folder for a toy mesh")
    return parser


def _seed(text: str) -> int:
    seed = int(text)
    if not 0 <= seed < 2**31:
        raise argparse.ArgumentTypeError("must be from 0 to 2147483647")
    return seed


if __name__ == "__main__":
    sys.exit(main())
