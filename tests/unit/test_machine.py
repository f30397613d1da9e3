"""Torch as a run sets it up, in a process of its own: what is set lasts. And which device a run takes."""

import subprocess
import sys
from pathlib import Path

import pytest

from backend import machine
from backend.errors import ReconstructionError

ROOT = Path(__file__).resolve().parents[2]

PROGRAM = """
import sys

import torch
from backend.machine import set_up_torch

set_up_torch(torch.device("cpu"))
print(torch.are_deterministic_algorithms_enabled(), "torch._inductor" in sys.modules)
"""


def test_a_run_is_repeatable_and_does_not_load_the_compiler() -> None:
    """Loading it takes as long as loading all the rest of torch."""
    command = [sys.executable, "-c", PROGRAM]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=True)
    assert result.stdout.split() == ["True", "False"]


@pytest.mark.parametrize(
    ("there", "taken"),
    [(("cuda", "cpu"), "cuda"), (("mps", "cpu"), "cpu"), (("cuda", "mps", "cpu"), "cuda"), (("cpu",), "cpu")],
)
def test_apples_gpu_is_taken_only_where_it_is_asked_for(
    monkeypatch: pytest.MonkeyPatch, there: tuple[str, ...], taken: str
) -> None:
    monkeypatch.setattr(machine, "available_devices", lambda: dict.fromkeys(there, "a name"))
    assert machine.choose_device("auto").type == taken
    assert [machine.choose_device(kind).type for kind in there] == list(there)
    with pytest.raises(ReconstructionError, match="not available"):
        machine.choose_device("xpu")
