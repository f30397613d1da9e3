"""Numbers too small to be held in full slow some CPUs down: a run takes them for 0, in every thread."""

import subprocess
import sys
from pathlib import Path

import pytest

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


NETWORK = """
import time
import torch
from torch import nn
from backend.machine import set_up_torch

def processor_s(work):
    times = []
    for _ in range(5):
        began_s = time.thread_time()
        work()
        times.append(time.thread_time() - began_s)
    return min(times)

def backward_s(beta):
    torch.manual_seed(0)
    hidden = [nn.Linear(64, 64), nn.Softplus(beta=beta), nn.Linear(64, 64), nn.Softplus(beta=beta)]
    network, points = nn.Sequential(*hidden, nn.Linear(64, 1)), torch.randn(16_384, 64)
    return processor_s(lambda: network(points).sum().backward())

torch.set_num_threads(1)
gentle, kept = backward_s(1), backward_s(100)
set_up_torch(torch.device("cpu"))
torch.set_num_threads(1)
print(kept / gentle, kept / backward_s(100))
"""


@pytest.mark.slow
def test_denormal_numbers_cost_a_network_of_softplus_nothing() -> None:
    """NeuS's, whose softplus is so steep (100) that derivatives of many of its units are denormal.

    How much they cost where they are kept is told beside a gentle softplus, which has none. Some processors
    hardly mind.
    """
    command = [sys.executable, "-c", NETWORK]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=True)
    slower, regained = map(float, result.stdout.split())
    if slower < 2:
        pytest.skip(f"this processor is not slow with denormal numbers: {slower:.1f} times as long")
    assert regained > slower / 2
