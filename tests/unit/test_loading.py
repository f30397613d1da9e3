"""Loading packages: what Python's collector of rubbish does meanwhile and afterwards."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def said_by(code: str) -> str:
    """What a new Python says."""
    command = [sys.executable, "-c", f"import gc\nfrom backend.loading import packages_that_stay\n{code}"]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def test_what_is_loaded_is_looked_through_neither_meanwhile_nor_later() -> None:
    code = (
        "with packages_that_stay():\n"
        "    inside = gc.isenabled()\n"
        "    kept = [[] for _ in range(1000)]\n"
        "print(inside, gc.isenabled(), gc.get_freeze_count() >= 1000)"
    )
    assert said_by(code) == "False True True"


def test_a_package_that_is_missing_leaves_all_as_it_was() -> None:
    code = (
        "try:\n"
        "    with packages_that_stay():\n"
        "        import there_is_no_such_package\n"
        "except ImportError:\n"
        "    print(gc.isenabled(), gc.get_freeze_count())"
    )
    assert said_by(code) == "True 0"


def test_where_torch_is_there_rubbish_of_others_is_not_kept() -> None:
    pytest.importorskip("torch")
    code = (
        "import torch\n"
        "with packages_that_stay():\n"
        "    inside = gc.isenabled()\n"
        "print(inside, gc.get_freeze_count())"
    )
    assert said_by(code) == "True 0"
