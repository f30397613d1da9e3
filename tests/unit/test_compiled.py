"""Compiled code: where it is kept, and that it is the same when it comes from there."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from backend.kernels.compiled import cache_folder
from backend.wire.client import ROOT, clean_environment

COMPILE = "from backend.kernels.bending import error_of_a_constant; error_of_a_constant()"

HOLD_A_MAP_AGAINST_ITSELF = (
    "from backend.kernels.cross_check import error_of_a_map_with_itself as error; print(error())"
)
SOLVE = """
from hashlib import sha256
import numpy as np
from backend.kernels.bending import conjugate_gradients

rng = np.random.default_rng(0)
field, weight = rng.normal(size=(2, 32, 32, 32)).astype(np.float32)
weight *= weight
found = conjugate_gradients(weight, 0.1, weight * field, field, steps=10, threads=1)
print(sha256(found).hexdigest())
"""


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


def test_a_kernel_is_compiled_anew_when_what_it_calls_in_another_file_has_changed(tmp_path: Path) -> None:
    """As after an update: numba looks at the file of the kernel alone."""
    code = tmp_path / "code"
    shutil.copytree(ROOT / "backend", code / "backend", ignore=shutil.ignore_patterns("__pycache__"))
    environment = {**clean_environment(os.environ), "PYTHONPATH": str(code), "NUMBA_CACHE_DIR": str(tmp_path)}

    def share_that_disagrees() -> float:
        command = [sys.executable, "-c", HOLD_A_MAP_AGAINST_ITSELF]
        done = subprocess.run(
            command, env=environment, cwd=tmp_path, check=True, timeout=120, capture_output=True
        )
        return float(done.stdout)

    assert share_that_disagrees() == 0
    called = code / "backend" / "kernels" / "patch_correlation.py"
    source = called.read_text(encoding="utf-8")
    changed = source.replace("values[u] = upper + ", "values[u] = 2 + upper + ")
    assert changed != source
    called.write_text(changed, encoding="utf-8")
    assert share_that_disagrees() == 1


def test_a_folder_that_the_user_chose_is_taken(tmp_path: Path) -> None:
    chosen = tmp_path / "chosen"
    environment = {**clean_environment(os.environ), "NUMBA_CACHE_DIR": str(chosen)}
    subprocess.run([sys.executable, "-c", COMPILE], env=environment, cwd=tmp_path, check=True, timeout=120)
    assert list(chosen.rglob("*.nbi"))


def test_the_run_that_compiles_finds_the_same_to_the_bit_as_the_next(tmp_path: Path) -> None:
    environment = {**clean_environment(os.environ), "NUMBA_CACHE_DIR": str(tmp_path)}
    first, next_one = (
        subprocess.run(
            [sys.executable, "-c", SOLVE],
            env=environment,
            cwd=ROOT,
            check=True,
            timeout=120,
            capture_output=True,
        ).stdout
        for _ in range(2)
    )
    assert first == next_one


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
