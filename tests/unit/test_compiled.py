"""Compiled code: where it is kept."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from backend.kernels.compiled import cache_folder
from backend.wire.client import ROOT, clean_environment

COMPILE = "from backend.kernels.bending import error_of_a_constant; error_of_a_constant()"


def test_nothing_is_written_beside_the_code(tmp_path: Path) -> None:
    code = tmp_path / "code"
    shutil.copytree(ROOT / "backend", code / "backend", ignore=shutil.ignore_patterns("__pycache__"))
    before = sorted(code.rglob("*"))
    environment = {**clean_environment(os.environ), "PYTHONPATH": str(code), "XDG_CACHE_HOME": str(tmp_path)}
    environment.pop("NUMBA_CACHE_DIR", None)
    subprocess.run([sys.executable, "-c", COMPILE], env=environment, cwd=tmp_path, check=True, timeout=120)
    assert sorted(code.rglob("*")) == before
    if sys.platform.startswith("linux"):
        assert list((tmp_path / "fewview" / "numba").rglob("*.nbi"))


def test_a_folder_that_the_user_chose_is_taken(tmp_path: Path) -> None:
    chosen = tmp_path / "chosen"
    environment = {**clean_environment(os.environ), "NUMBA_CACHE_DIR": str(chosen)}
    subprocess.run([sys.executable, "-c", COMPILE], env=environment, cwd=tmp_path, check=True, timeout=120)
    assert list(chosen.rglob("*.nbi"))


@pytest.mark.parametrize(
    ("platform", "environment", "folder"),
    [
        ("linux", {}, "home/.cache/fewview"),
        ("linux", {"XDG_CACHE_HOME": "/caches"}, "/caches/fewview"),
        ("linux", {"XDG_CACHE_HOME": "relative"}, "home/.cache/fewview"),  # to be passed over, says XDG
        ("darwin", {"XDG_CACHE_HOME": "/caches"}, "home/Library/Caches/fewview"),
        ("win32", {}, "home/AppData/Local/fewview/cache"),
        ("win32", {"LOCALAPPDATA": "/local"}, "/local/fewview/cache"),
    ],
)
def test_the_folder_is_the_systems(platform: str, environment: dict[str, str], folder: str) -> None:
    assert cache_folder(platform, environment, Path("home")) == Path(folder)
