"""Builds the zip with Blender's own tool: python tests/blender/build_extension.py --output DIR."""

import argparse
import subprocess
import sys
from pathlib import Path

import bpy

ROOT = Path(__file__).resolve().parents[2]


def build_extension(folder: Path) -> Path:
    """The zip in the folder, made anew. Raises CalledProcessError with what the tool said."""
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("fewview-*.zip"):
        old.unlink()
    tool = Path(bpy.utils.system_resource("SCRIPTS")) / "addons_core/bl_pkg/cli/blender_ext.py"
    command = [sys.executable, str(tool), "build", "--source-dir", str(ROOT), "--output-dir", str(folder)]
    subprocess.run(command, check=True, capture_output=True, timeout=60)
    (found,) = folder.glob("fewview-*.zip")
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--output", type=Path, required=True)
    sys.stdout.write(f"{build_extension(parser.parse_args().output)}\n")
