"""Runs pytest inside a real Blender, which has none of its own.

    blender --background --factory-startup --python-exit-code 1 \\
        --python tests/blender/run_in_blender.py -- FOLDER_WITH_PYTEST [pytest's arguments]
"""

import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def main(words: list[str]) -> int:
    """The exit code of pytest."""
    packages, *arguments = words
    sys.path[:0] = [str(ROOT), str(Path(packages).absolute())]
    import pytest

    chosen = arguments or [str(ROOT / "tests" / "blender")]
    options = ["-o", "addopts=--strict-markers --import-mode=importlib", "-p", "no:cacheprovider"]
    # Blender's own modules leave files open; ours are held to account where Blender is a module.
    options += ["-W", "ignore::pytest.PytestUnraisableExceptionWarning"]
    # Two Blenders tested side by side must not tidy the same folder of old runs: each would find files gone.
    with tempfile.TemporaryDirectory(prefix="fewview-", ignore_cleanup_errors=True) as folder:
        return int(pytest.main([*options, "--basetemp", f"{folder}/tests", "--rootdir", str(ROOT), *chosen]))


if __name__ == "__main__":
    sys.exit(main(sys.argv[sys.argv.index("--") + 1 :]))
