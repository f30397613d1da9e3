"""Rendering in a second Blender, so that the first stays free: how it is started, and what it does.

It opens a copy of the .blend, removes that copy, renders, and says on the wire how far it is.
"""

import os
import platform
import sys
import threading
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import bpy

from ..backend.commands.cancelling import EXIT_CANCELLED, GRACE_S, CancelRequest, watch_stdin
from ..backend.errors import Cancelled
from ..backend.version import VERSION
from ..backend.wire.protocol import (
    CANCELLED,
    PROTOCOL_VERSION,
    Failed,
    Finished,
    Hello,
    Message,
    Progress,
    Stage,
    Warned,
)
from ..backend.wire.speaker import Speaker, speaker
from .kept_settings import changed
from .simulations import bake_folders, frames_to_play, is_in_file_alone, leave_disk
from .view_rendering import ViewRequest, decode_request, encode_request, is_ill_lit, render_views

COPY, REQUEST, LOG = "scene.blend", "request.json", "render.log"
STAGE = "render"
RENDER_FAILED = "render_failed"
"""Code of a failure."""


def needs_waiting() -> bool:
    """Whether there is no second Blender to render in, or no window to keep free."""
    return bpy.app.background or not bpy.app.binary_path


def prepare(scene: bpy.types.Scene, request: ViewRequest, folder: Path) -> None:
    """Write what the second Blender reads: the request, and the scene with all that it uses.

    Not by saving a copy of the file, which takes longer and runs the user's handlers; but where there are
    simulations or bakes, which are in nothing else.
    Raises RuntimeError or OSError where the copy cannot be written.
    """
    (folder / REQUEST).write_text(encode_request(request), encoding="utf-8")
    if bpy.ops.ed.flush_edits.poll():
        bpy.ops.ed.flush_edits()  # what is being edited or sculpted
    copy = str(folder / COPY)
    if is_in_file_alone(scene, _last_frame(scene, request)):
        with changed(bake_folders(scene)):
            bpy.ops.wm.save_as_mainfile(filepath=copy, copy=True, compress=False, check_existing=False)
        return
    blocks = {scene, *bpy.data.texts}  # drivers may call what a text defines
    bpy.data.libraries.write(copy, blocks, path_remap="ABSOLUTE", compress=False)


def not_copied() -> tuple[str, ...]:
    """What the second Blender has not as it is here, in sentences for the user."""
    painted = [image.name for image in bpy.data.images if image.is_dirty]
    return (f"Rendered as they were last saved or packed: {', '.join(painted)}",) if painted else ()


def _last_frame(scene: bpy.types.Scene, request: ViewRequest) -> int:
    return max(scene.frame_current if view.frame is None else view.frame for view in request.views)


def clean(folder: Path) -> None:
    """Remove what `prepare` wrote, if the second Blender has not come that far."""
    for name in (COPY, REQUEST):
        (folder / name).unlink(missing_ok=True)


def worker_command(folder: Path) -> tuple[str, ...]:
    """The command that renders a prepared folder, to be started with this process's environment."""
    script = f"import importlib; importlib.import_module({__name__!r}).main({str(folder)!r})"
    return (
        *(bpy.app.binary_path, "--background", str(folder / COPY)),
        *("--python-exit-code", "1", "--python-expr", script),
    )


def render_here(request: ViewRequest, folder: Path) -> tuple[str, ...]:
    """Render in this Blender, with progress on stderr; what the user should know of the pictures.

    Raises as `render_views` does.
    """
    ill_lit = 0
    with closing(render_views(request, folder)) as views:
        for index, path in views:
            sys.stderr.write(f"FewView: {_view_of(index + 1, request)}\n")
            ill_lit += is_ill_lit(path)
    return _of_light(ill_lit, request)


def main(folder: str) -> None:
    """What the second Blender does: the whole conversation."""
    asked, last_word = CancelRequest(), threading.Lock()
    with speaker() as speaking:

        def end_with(message: Message) -> bool:
            """Say the last word, unless another thread has said it."""
            if not last_word.acquire(blocking=False):
                return False
            speaking.silence()
            speaking.say(message)
            return True

        hello = Hello(
            protocol=PROTOCOL_VERSION, backend=VERSION, python=platform.python_version(), pid=os.getpid()
        )
        speaking.say(hello)
        watch_stdin(asked)
        threading.Thread(target=_end_when_asked, args=(asked, end_with), daemon=True).start()
        end_with(_render(Path(folder), asked, speaking))


def _end_when_asked(asked: CancelRequest, end_with: Callable[[Message], bool]) -> None:
    """Between two views the main thread ends by itself; a view that takes long is not waited for."""
    while not asked.is_asked:
        time.sleep(0.05)
    time.sleep(GRACE_S)
    if end_with(_cancelled()):
        os._exit(EXIT_CANCELLED)


def _render(folder: Path, asked: CancelRequest, speaking: Speaker) -> Message:
    """Render all views; the last word."""
    speaking.say(Stage(name=STAGE, index=1, count=1))
    try:
        request = _take_over(folder)
        if bpy.app.autoexec_fail:
            text = "Python in this file was not run for the views, as Auto Run Python Scripts is off"
            speaking.say(Warned(text=text))
        _play(bpy.context.scene, request, asked, speaking)
        return _say_views(request, folder, asked, speaking)
    except Cancelled:
        return _cancelled()
    except (ValueError, TypeError, KeyError, AttributeError, OSError, RuntimeError, MemoryError) as error:
        text = f"The views could not be rendered: {error}"
        return Failed(code=RENDER_FAILED, text=text, remedy="The log says more.")


def _take_over(folder: Path) -> ViewRequest:
    """What is to be rendered; from now on nothing but Blender's memory holds the copy of the file."""
    request = decode_request((folder / REQUEST).read_text(encoding="utf-8"))
    if not bpy.data.filepath or not os.path.samefile(bpy.data.filepath, folder / COPY):
        raise ValueError("Blender did not open the copy of the scene")
    clean(folder)
    scene = next((scene for scene in bpy.data.scenes if scene.name_full == request.scene), None)
    if scene is None or request.view_layer not in scene.view_layers:
        raise ValueError(f"{request.scene}, {request.view_layer} is not in the copy of the scene")
    window = bpy.context.window_manager.windows[0]
    window.scene, window.view_layer = scene, scene.view_layers[request.view_layer]
    return request


def _play(scene: bpy.types.Scene, request: ViewRequest, asked: CancelRequest, speaking: Speaker) -> None:
    """Simulate what the copy does not hold, frame by frame, up to the last that is rendered."""
    shown, last = scene.frame_current, _last_frame(scene, request)
    frames = frames_to_play(scene, last)
    leave_disk(scene)
    for frame in frames:
        asked.check()
        text = f"simulating frame {frame} of {last}"
        speaking.say(Progress(stage=STAGE, fraction=0.0, text=text, remaining_s=None))
        scene.frame_set(frame)
    scene.frame_set(shown)


def _say_views(request: ViewRequest, folder: Path, asked: CancelRequest, speaking: Speaker) -> Message:
    started_s, count = time.monotonic(), len(request.views)
    speaking.say(Progress(stage=STAGE, fraction=0.0, text=_view_of(1, request), remaining_s=None))
    files: list[str] = []
    ill_lit = 0
    with closing(render_views(request, folder)) as views:
        for index, path in views:
            asked.check()
            done = index + 1
            ill_lit += is_ill_lit(path)
            files.append(path.relative_to(folder).as_posix())
            remaining_s = (time.monotonic() - started_s) / done * (count - done)
            text = _view_of(min(done + 1, count), request)
            speaking.say(Progress(stage=STAGE, fraction=done / count, text=text, remaining_s=remaining_s))
    for sentence in _of_light(ill_lit, request):
        speaking.say(Warned(text=sentence))
    return Finished(output=str(folder), files=(*files, "transforms.json"))


def _of_light(ill_lit: int, request: ViewRequest) -> tuple[str, ...]:
    """What to say of so many views that are white or black."""
    if not ill_lit:
        return ()
    views = f"{ill_lit} of {len(request.views)} views"
    remedy = "change the lights, or Exposure in the scene's Color Management, and render again"
    return (f"Too much light, or too little, leaves white or black without texture in {views}: {remedy}",)


def _view_of(number: int, request: ViewRequest) -> str:
    return f"view {number} of {len(request.views)}"


def _cancelled() -> Failed:
    text = "The rendering was stopped; the views that were finished stay in their folder."
    return Failed(code=CANCELLED, text=text, remedy="")
