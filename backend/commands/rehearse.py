"""A rehearsal: the whole conversation of a run and files like its results, without doing or needing anything.

It lets the add-on, and its tests, go through start, progress, previews, a warning, cancel, failure, crash and
result where neither torch nor photographs are. Standard library only.
"""

import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from ..errors import ErrorCode, ReconstructionError
from ..failures import output_unusable
from ..held_files import written_whole
from ..wire import protocol
from ..wire.speaker import Speaker
from . import rehearsed_files as files
from .cancelling import CancelRequest
from .reconstruct import cancelled_message, converse, say_last

ENDS = ("finished", "failed", "crashed")
"""How a rehearsal can end."""

_STAGES = ("photos", "cameras", "region", "stereo", "train", "mesh", "report")
_FEWEST_STEPS = 10
"""Of a stage."""
_LONGEST_STEP_S = 0.1
"""The time in which a request to stop is heard."""
_PREVIEW, _CAMERAS_PREVIEW = "preview.ply", "preview.json"


def rehearse(output: Path | None, seconds: float = 1.0, *, end: str = "finished") -> int:
    """Play a run on the wire for about so long; the exit code, where it does not crash.

    With an output folder, which must be new, it gets previews and results. `end` is one of ENDS: "failed"
    runs out of memory, "crashed" aborts without a last word, both amid the stage that fits the surface.
    """
    return converse(
        lambda request, speaking: _play(output, seconds, end, request, speaking), cancelled_message()
    )


def _make(output: Path) -> None:
    """The new folder; ReconstructionError(OUTPUT_UNUSABLE) where it is there already or cannot be."""
    try:
        output.mkdir(parents=True)
    except OSError as error:
        text = f"{output} cannot be made ({error.strerror or error})."
        raise output_unusable(error, text, "Choose a new output folder.") from error


def _play(output: Path | None, seconds: float, end: str, request: CancelRequest, speaking: Speaker) -> None:
    if output is not None:
        _make(output)
    stage_s = max(0.0, seconds) / len(_STAGES)
    for index, name in enumerate(_STAGES):
        speaking.say(protocol.Stage(name=name, index=index + 1, count=len(_STAGES)))
        _play_stage(name, stage_s, request, speaking)
        if name == "cameras":
            speaking.say(protocol.Warned(text="This is a rehearsal: no photograph is read."))
            if output is not None:
                path = _put(output / _CAMERAS_PREVIEW, files.write_cameras)
                speaking.say(protocol.Preview(path=str(path)))
        if name == "train":
            _make_trouble(end)
        if name in ("stereo", "train") and output is not None:
            size = 0.5 if name == "stereo" else 0.75
            path = _put(output / _PREVIEW, partial(files.write_mesh, size=size))
            speaking.say(protocol.Preview(path=str(path)))
    names = () if output is None else _write_results(output)
    speaking.say(protocol.Heartbeat(elapsed_s=seconds))
    say_last(speaking, protocol.Finished(output=str(output or ""), files=names))


def _play_stage(name: str, stage_s: float, request: CancelRequest, speaking: Speaker) -> None:
    steps = max(_FEWEST_STEPS, round(stage_s / _LONGEST_STEP_S))
    for step in range(steps + 1):
        request.check()
        time.sleep(stage_s / (steps + 1))
        fraction = step / steps
        text = f"rehearsing, step {step}"
        remaining_s = (1 - fraction) * stage_s
        speaking.say(protocol.Progress(stage=name, fraction=fraction, text=text, remaining_s=remaining_s))


def _make_trouble(end: str) -> None:
    """End the rehearsal as a run may end that nobody wished for."""
    if end == "failed":
        raise ReconstructionError(
            ErrorCode.OUT_OF_MEMORY,
            "This is a rehearsal of a computer that ran out of memory.",
            "Use a faster preset or fewer photographs, or close other programs.",
        )
    if end == "crashed":
        os.abort()


def _write_results(output: Path) -> tuple[str, ...]:
    """Write what a run of the add-on leaves; the names."""
    for name, write in files.RESULTS.items():
        _put(output / name, write)
    return tuple(files.RESULTS)


def _put(path: Path, write: Callable[[Path], object]) -> Path:
    """Write so that nobody reads half a file; the path."""
    with written_whole(path) as part:
        write(part)
    return path
