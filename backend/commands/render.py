"""The command that renders a finished job from given cameras, for a terminal or for a program on the wire."""

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

from ..loading import packages_that_stay
from ..wire import protocol
from .cancelling import catch_signals
from .reconstruct import converse_or_show

if TYPE_CHECKING:
    from ..pipeline import Listener, Outcome


def add_render(parser: argparse.ArgumentParser) -> None:
    """The command's words."""
    add = parser.add_argument
    add("job", metavar="JOB", type=Path, help="output folder of a finished reconstruction")
    add(
        "--cameras",
        metavar="FILE_OR_FOLDER",
        type=Path,
        required=True,
        help="transforms.json, COLMAP model or finished run in the job's frame; no pictures are needed",
    )
    add("--output", metavar="DIR", type=Path, required=True, help="new or empty folder, or one rendered into")
    add("--device", choices=protocol.DEVICES, default="auto", help="where to compute (auto)")
    add("--wire", action="store_true", help="for programs: messages on stdout")


def render(parsed: argparse.Namespace) -> int:
    """Render and say which pictures there are; the exit code."""
    cancelled = protocol.Failed(
        code=protocol.CANCELLED,
        text="The rendering was stopped; no picture was written.",
        remedy="Start it again.",
    )
    return converse_or_show(
        lambda listener: _render(parsed, listener), parsed.output, wire=parsed.wire, cancelled=cancelled
    )


def _render(parsed: argparse.Namespace, listener: "Listener") -> "Outcome":
    with packages_that_stay():
        from ..pipeline import Outcome  # torch may be missing, and doctor must still start
        from ..rendering import render_job
    from ..workspace import StageCost

    catch_signals()
    listener.stage_started("render", 1, 1)
    began_s = time.perf_counter()
    names = render_job(parsed.job, parsed.cameras, parsed.output, parsed.device, listener.progressed)
    listener.stage_finished(StageCost(seconds=time.perf_counter() - began_s, peak_memory_bytes=None))
    return Outcome(files=names, summary=())
