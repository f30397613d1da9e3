"""The command that renders a finished job from given cameras, for a person on a terminal."""

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

from ..wire.protocol import DEVICES
from .reconstruct import with_terminal

if TYPE_CHECKING:
    from ..terminal import TerminalListener


def add_render(parser: argparse.ArgumentParser) -> None:
    """The command's words."""
    add = parser.add_argument
    add("job", metavar="JOB", type=Path, help="output folder of a finished reconstruction")
    add(
        "--cameras",
        metavar="FILE_OR_FOLDER",
        type=Path,
        required=True,
        help="transforms.json or COLMAP model in the job's frame; no pictures are needed",
    )
    add("--output", metavar="DIR", type=Path, required=True, help="new or empty folder, or one rendered into")
    add("--device", choices=DEVICES, default="auto", help="where to compute (auto)")


def render(parsed: argparse.Namespace) -> int:
    """Render with progress on stderr and the names of the pictures on stdout; the exit code."""
    return with_terminal(
        lambda listener: _render(parsed, listener),
        cancelled=lambda listener: listener.warned("stopped; no picture was written."),
    )


def _render(parsed: argparse.Namespace, listener: "TerminalListener") -> None:
    from ..pipeline import Outcome  # torch may be missing, and doctor must still start
    from ..rendering import render_job
    from ..workspace import StageCost

    listener.stage_started("render", 1, 1)
    began_s = time.perf_counter()
    names = render_job(parsed.job, parsed.cameras, parsed.output, parsed.device, listener.progressed)
    listener.stage_finished(StageCost(seconds=time.perf_counter() - began_s, peak_memory_bytes=None))
    listener.finished(parsed.output, Outcome(files=names, summary=()))
