"""Numbers too small to be held in full slow some CPUs down: a run takes them for 0, in every thread."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

PROGRAM = """
import torch
from backend.machine import set_up_torch

print((torch.full((100,), 1e-39) * 0.5 != 0).all().item())
set_up_torch(torch.device("cpu"))
torch.set_num_threads(4)
faint = torch.full((4_000_000,), 1e-39)  # so many that they are split over all threads
print((faint * 0.5 == 0).all().item())
"""


def test_a_run_takes_denormal_numbers_for_zero_in_all_threads() -> None:
    """A thread has the setting of the one that begins it: it must be made before torch's first long sum."""
    command = [sys.executable, "-c", PROGRAM]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=True)
    assert result.stdout.split() == ["True", "True"], "kept before, all of them 0 after"
