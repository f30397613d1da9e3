"""`blender --command fewview ...`: the add-on without a window.

    blender --command fewview reconstruct photos --output jobs --save mesh.blend
    blender scene.blend --command fewview render --object Suzanne --views 6 --output views

Exit codes: 0 fine, 1 a fault of the program, 2 something the user can mend, 130 stopped.
"""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import bpy

from ..backend.wire.protocol import CANCELLED, CRASHED, DEVICES, PRESETS, PROTOCOL_BROKEN
from . import jobs
from .api import ReconstructionFailed, reconstruct
from .job_folder import RESULT
from .properties import FEWVIEW_PG_settings

NAME = "fewview"
EXIT_FINE, EXIT_FAULT, EXIT_USER_ERROR, EXIT_CANCELLED = 0, 1, 2, 130
_FAULTS = frozenset({CRASHED, PROTOCOL_BROKEN, "internal", "result_refused"})
_EXCEPTION = "Error: Python: "
"""How the error of an operator begins that did not expect it."""


def main(words: Sequence[str]) -> int:
    """Run a command; its exit code. The last line on stdout is a JSON object with what came of it."""
    parser = _parser()
    try:
        asked = parser.parse_args(list(words))
    except SystemExit as ending:  # argparse has said why
        return int(ending.code or 0)
    jobs.forget()
    try:
        summary = asked.run(asked)
    except KeyboardInterrupt:
        return _failed("Stopped", EXIT_CANCELLED)
    except ReconstructionFailed as error:
        return _failed(str(error), _exit_code(error.failure.code))
    except RuntimeError as error:  # what an operator reports, or a job that cannot be started
        return _failed(str(error).removeprefix("Error: ").rstrip(), _exit_code_of_operator(str(error)))
    except (ValueError, OSError) as error:
        return _failed(str(error), EXIT_USER_ERROR)
    sys.stdout.write(json.dumps(summary) + "\n")
    sys.stdout.flush()
    return EXIT_FINE


def _reconstruct(asked: argparse.Namespace) -> dict[str, object]:
    done = reconstruct(
        asked.images,
        output=asked.output,
        cameras=asked.cameras,
        masks=asked.masks,
        truth=asked.truth,
        preset=asked.preset,
        cut_out=asked.cut_out,
        without_ground=asked.without_ground,
        device=asked.device,
        seed=asked.seed,
    )
    if asked.save is not None:
        bpy.ops.wm.save_as_mainfile(filepath=str(asked.save.absolute()), check_existing=False)
    return {
        "mesh": done.mesh.name,
        "triangles": len(done.mesh.data.polygons),
        "result": str(done.folder / RESULT),
        "warnings": list(done.warnings),
    }


def _render(asked: argparse.Namespace) -> dict[str, object]:
    target = bpy.data.objects.get(asked.object)
    if target is None:
        known = ", ".join(o.name for o in bpy.context.scene.objects if o.type == "MESH")
        raise ValueError(f"There is no object {asked.object!r} in the scene; meshes: {known or 'none'}")
    placed = _given(asked, "arrangement", "view_count", "view_seed", "resolution_x", "resolution_y")
    rendered = _given(asked, "samples", "engine", "resolution_x", "resolution_y")
    bpy.ops.fewview.generate_views(target=target.name, **placed)
    bpy.ops.fewview.render_views(target=target.name, output=str(asked.output.absolute()), **rendered)
    settings = bpy.context.scene.fewview
    return {"transforms": settings.cameras_path, "images": [image.path for image in settings.images]}


def _given(asked: argparse.Namespace, *names: str) -> dict[str, object]:
    """The arguments that were given; operators know what to do without the others."""
    return {name: value for name in names if (value := getattr(asked, name)) is not None}


def _check(_asked: argparse.Namespace) -> dict[str, object]:
    bpy.ops.fewview.check_backend()
    end = jobs.ended()
    assert end is not None
    return {check.name: check.found for check in end.checks}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"blender --command {NAME}", description="From photographs to a mesh."
    )
    commands = parser.add_subparsers(required=True)
    making = commands.add_parser("reconstruct", help="make a mesh from photographs")
    making.set_defaults(run=_reconstruct)
    add = making.add_argument
    add("images", nargs="+", type=Path, help="image files or folders")
    add("--output", type=Path, required=True, help="folder in which the job gets its own")
    add("--cameras", type=Path, help="transforms.json or COLMAP model; else they are estimated")
    add("--masks", type=Path, help="folder with an image per photograph, white on the subject")
    add("--truth", type=Path, help="mesh file to measure the result against")
    add("--preset", choices=PRESETS, default="balanced", help="speed against detail (balanced)")
    add("--cut-out", action="store_true", help="cut the subject out of photographs without masks")
    add("--without-ground", action="store_true", help="leave out the flat ground that the subject stands on")
    add("--device", choices=DEVICES, default="auto", help="where to compute (auto)")
    add("--seed", type=int, default=0, help="random seed (0)")
    add("--save", type=Path, metavar="FILE.blend", help="save the scene with the mesh; replaces that file")
    rendering = commands.add_parser("render", help="render sparse views of an object of the .blend")
    rendering.epilog = "What is left out is as in the scene's settings."
    rendering.set_defaults(run=_render)
    add = rendering.add_argument
    add("--object", required=True, help="name of the object")
    add("--output", type=Path, required=True, help="folder in which the views get their own")
    add("--views", type=_limited("view_count"), dest="view_count", help="number of pictures")
    add(
        "--layout",
        type=str.upper,
        dest="arrangement",
        choices=("ARC", "RING", "HEMISPHERE"),
        help="of the cameras",
    )
    add("--seed", type=_limited("view_seed"), dest="view_seed", help="of their irregularity")
    add("--width", type=_limited("resolution_x"), dest="resolution_x", help="of the pictures, in pixels")
    add("--height", type=_limited("resolution_y"), dest="resolution_y", help="of the pictures, in pixels")
    add("--samples", type=_limited("samples"), help="light paths per pixel in Cycles")
    add("--engine", type=str.upper, choices=("CYCLES", "WORKBENCH", "SCENE"), help="what renders")
    commands.add_parser("check", help="check that FewView is set up").set_defaults(run=_check)
    return parser


def _limited(setting: str) -> Callable[[str], int]:
    """The type of an argument with the limits of the setting, to which Blender cuts without a word."""
    limits = FEWVIEW_PG_settings.bl_rna.properties[setting]

    def number(text: str) -> int:
        found = int(text)
        if not limits.hard_min <= found <= limits.hard_max:
            raise argparse.ArgumentTypeError(f"must be from {limits.hard_min} to {limits.hard_max}")
        return found

    return number


def _exit_code(code: str) -> int:
    if code == CANCELLED:
        return EXIT_CANCELLED
    return EXIT_FAULT if code in _FAULTS else EXIT_USER_ERROR


def _exit_code_of_operator(text: str) -> int:
    """An operator's error has no code, but the job that it waited for has."""
    if text.startswith(_EXCEPTION):
        return EXIT_FAULT
    end = jobs.ended()
    return EXIT_USER_ERROR if end is None or end.failure is None else _exit_code(end.failure.code)


def _failed(text: str, exit_code: int) -> int:
    sys.stderr.write(f"Error: {text}\n")
    return exit_code


_command: Callable[..., object] | None = None


def register() -> None:
    """Make the command known."""
    global _command
    _command = bpy.utils.register_cli_command(NAME, main)


def unregister() -> None:
    """Take it back."""
    bpy.utils.unregister_cli_command(_command)
