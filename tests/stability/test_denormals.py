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

def seconds(work):
    times = []
    for _ in range(5):
        began_s = time.perf_counter()
        work()
        times.append(time.perf_counter() - began_s)
    return min(times)

torch.manual_seed(0)
hidden = [nn.Linear(64, 64), nn.Softplus(beta=100), nn.Linear(64, 64), nn.Softplus(beta=100)]
network, points = nn.Sequential(*hidden, nn.Linear(64, 1)), torch.randn(16_384, 64)
faint, sound = torch.full((1_000_000,), 1e-39), torch.ones(1_000_000)
torch.set_num_threads(1)
product = seconds(lambda: faint * 0.5) / seconds(lambda: sound * 0.5)
kept = seconds(lambda: network(points).sum().backward())
set_up_torch(torch.device("cpu"))
torch.set_num_threads(1)
print(product, kept / seconds(lambda: network(points).sum().backward()))
"""


@pytest.mark.slow
def test_a_network_of_softplus_is_several_times_faster() -> None:
    """NeuS's, whose softplus is so steep (100) that derivatives of many of its units are denormal."""
    command = [sys.executable, "-c", NETWORK]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=True)
    product, network = map(float, result.stdout.split())
    if product < 2:
        pytest.skip(f"this processor is not slow with denormal numbers: {product:.1f} times as long")
    assert network > 2
