"""Torch as a run sets it up, in a process of its own: what is set lasts."""

import subprocess
import sys
from pathlib import Path

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
