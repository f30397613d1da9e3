"""Renders the scenes of a benchmark's suite that are not there yet; run by Blender's Python.

    python -m benchmarks.render_scenes SUITE --output build/benchmark/rendered [--data ../shared/data]
    python -m benchmarks.render_scenes --cases CASE ... --output build/benchmark/rendered

A scene is rendered again when its options or the sources of blender_scenes have changed. Without --data the
cases that start from a mesh file are left out.
"""

import argparse
import hashlib
import logging
import subprocess
import sys
from pathlib import Path

from backend.benchmark.suites import CASES, SUITES, Case

ROOT = Path(__file__).resolve().parents[1]
NOTE = "rendered_from.txt"
"""In a scene's folder, written last: the fingerprint of all it was made from."""
NO_PICTURES = "reconstruct_scene.py"
"""The one source of blender_scenes that no picture depends on."""
MESH_SUFFIXES = frozenset({".obj", ".ply", ".stl", ".glb", ".gltf"})
logger = logging.getLogger(__name__)


def render_words(case: Case, data: Path | None) -> tuple[str, ...] | None:
    """The case as words for blender_scenes.render_views, without where to; None without its mesh file."""
    assert case.rendering is not None
    scene = case.rendering.scene
    if Path(scene).suffix in MESH_SUFFIXES:
        if data is None or not (data / scene).is_file():
            return None
        scene = f"mesh:{data.absolute() / scene}"
    return ("--scene", scene, *case.rendering.words)


def fingerprint(words: tuple[str, ...]) -> str:
    """Changes with the options and with the code that renders."""
    digest = hashlib.sha256(repr(words).encode())
    scenes = {*(ROOT / "blender_scenes").glob("*.py")} - {ROOT / "blender_scenes" / NO_PICTURES}
    for path in (*sorted(scenes), ROOT / "addon" / "view_layout.py"):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def render_missing(cases: tuple[Case, ...], scenes: Path, data: Path | None) -> int:
    """Render what is missing or out of date; the first exit code that is not 0."""
    for case in cases:
        folder = scenes / case.folder
        words = render_words(case, data)
        note = folder / NOTE
        if words is None:
            logger.info("%s is left out: its mesh file is not there", case.name)
            continue
        if note.is_file() and note.read_text(encoding="utf-8") == fingerprint(words):
            continue
        logger.info("rendering %s", case.name)
        where_to = ("--output", str(folder.absolute()))
        command = [sys.executable, "-m", "blender_scenes.render_views", *words, *where_to]
        exit_code = subprocess.run(command, cwd=ROOT, check=False).returncode
        if exit_code:
            return exit_code
        note.write_text(fingerprint(words), encoding="utf-8")
    return 0


def main() -> int:
    """The exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("suite", nargs="?", choices=tuple(SUITES))
    what.add_argument("--cases", nargs="+", choices=tuple(CASES), metavar="CASE", help="these instead")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--data", type=Path, help="folder of mesh files")
    parsed = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    chosen = [CASES[name] for name in parsed.cases] if parsed.cases else SUITES[parsed.suite].cases
    cases = tuple(case for case in chosen if case.rendering is not None)
    return render_missing(cases, parsed.output, parsed.data)


if __name__ == "__main__":
    sys.exit(main())
