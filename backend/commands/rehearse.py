"""A rehearsal: the whole conversation of a run in about a second, without doing or needing anything.

It lets the add-on, and its tests, go through start, progress, preview, warning, cancel and result where
neither torch nor photographs are. Standard library only.
"""

import time
from pathlib import Path

from ..wire import protocol
from ..wire.speaker import Speaker, speaker
from .cancelling import CancelRequest, watch_signals, watch_stdin
from .reconstruct import cancelled_message, failed_message, hello, say_last, settle

_STAGES = ("photos", "cameras", "region", "stereo", "train", "mesh", "report")
_STEPS = 10
_STEP_S = 0.012

_TETRAHEDRON = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
element face 4
property list uchar int vertex_indices
end_header
1 1 1
1 -1 -1
-1 1 -1
-1 -1 1
3 0 1 2
3 0 3 1
3 0 2 3
3 1 3 2
"""


def rehearse(output: Path | None) -> int:
    """Play a run on the wire; with an output folder, which must be new, it gets a preview and a mesh."""
    request = CancelRequest()
    with speaker() as speaking:
        speaking.say(hello())
        watch_signals(request, lambda: None)
        watch_stdin(request)
        return settle(
            lambda: _play(output, request, speaking),
            failed=lambda error: say_last(speaking, failed_message(error)),
            cancelled=lambda: say_last(speaking, cancelled_message()),
        )


def _play(output: Path | None, request: CancelRequest, speaking: Speaker) -> None:
    if output is not None:
        output.mkdir(parents=True)
    for index, name in enumerate(_STAGES):
        speaking.say(protocol.Stage(name=name, index=index + 1, count=len(_STAGES)))
        for step in range(_STEPS + 1):
            request.check()
            time.sleep(_STEP_S)
            remaining_s = (_STEPS - step) * _STEP_S
            fraction = step / _STEPS
            text = f"rehearsing, step {step}"
            speaking.say(protocol.Progress(stage=name, fraction=fraction, text=text, remaining_s=remaining_s))
        if name == "cameras":
            speaking.say(protocol.Warned(text="This is a rehearsal: no photograph is read."))
        if name == "stereo" and output is not None:
            speaking.say(protocol.Preview(path=str(_write_tetrahedron(output / "preview.ply"))))
    files: tuple[str, ...] = ()
    if output is not None:
        files = (_write_tetrahedron(output / "mesh.ply").name,)
    speaking.say(protocol.Heartbeat(elapsed_s=_STEP_S * _STEPS * len(_STAGES)))
    say_last(speaking, protocol.Finished(output=str(output or ""), files=files))


def _write_tetrahedron(path: Path) -> Path:
    path.write_text(_TETRAHEDRON, encoding="ascii")
    return path
