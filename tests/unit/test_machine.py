"""Torch as a run sets it up, in a process of its own: what is set lasts. And which device a run takes."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from backend import machine
from backend.errors import ReconstructionError
from backend.machine import covers

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
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (8_000_000_000, 8_000_000_000))
    assert machine.choose_device("auto").type == taken
    assert [machine.choose_device(kind).type for kind in there] == list(there)
    with pytest.raises(ReconstructionError, match="not available"):
        machine.choose_device("xpu")


@pytest.mark.parametrize(
    ("architectures", "capability", "expected"),
    [
        ("sm_75 sm_80 sm_86 sm_90 sm_100 sm_120", (6, 1), False),
        ("sm_75 sm_80 sm_86 sm_90 sm_100 sm_120", (8, 9), True),  # as 8.6
        ("sm_75 sm_80 sm_86 sm_90 sm_100 sm_120", (12, 1), True),
        ("sm_75 sm_80 sm_86 sm_90 sm_100 sm_120", (7, 0), False),  # not an earlier one
        ("sm_80", (9, 0), False),  # not another major one
        ("sm_80 compute_80", (9, 0), True),  # compiled on the spot
        ("compute_80", (7, 5), False),
        ("sm_90a compute_90a", (9, 0), True),
        ("sm_100a compute_100a", (10, 3), False),
        ("sm_100f", (10, 3), True),
        ("compute_100f", (12, 0), False),
        ("gfx90a gfx1100", (9, 0), True),  # of AMD: nothing is known
        ("", (9, 0), True),
    ],
)
def test_a_gpu_runs_code_for_its_version_and_some_earlier_ones(
    architectures: str, capability: tuple[int, int], expected: bool
) -> None:
    assert covers(architectures.split(), capability) == expected


@pytest.fixture
def gtx_1080(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """It, and a torch for later ones."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "NVIDIA GeForce GTX 1080")
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (6, 1))
    monkeypatch.setattr(torch.cuda, "get_arch_list", lambda: ["sm_75", "sm_80", "sm_86", "sm_90"])
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (8_000_000_000, 8_000_000_000))
    return monkeypatch


def test_a_gpu_that_torch_has_no_code_for_is_not_taken(gtx_1080: pytest.MonkeyPatch) -> None:
    assert "cuda" not in machine.available_devices()
    assert machine.choose_device("auto").type == "cpu"
    with pytest.raises(ReconstructionError, match=r"GTX 1080: .* no code for its compute capability 6\.1"):
        machine.choose_device("cuda")
    gtx_1080.setattr(torch.cuda, "get_device_capability", lambda: (8, 6))
    assert machine.available_devices()["cuda"] == "NVIDIA GeForce GTX 1080"
    assert machine.choose_device("auto").type == "cuda"


def test_a_driver_that_fails_leaves_the_cpu(gtx_1080: pytest.MonkeyPatch) -> None:
    def fail() -> str:
        raise RuntimeError("CUDA error: unknown error\nCompile with TORCH_USE_CUDA_DSA")

    gtx_1080.setattr(torch.cuda, "get_device_name", fail)
    assert machine.choose_device("auto").type == "cpu"
    with pytest.raises(ReconstructionError, match=r"\(GPU: CUDA error: unknown error\)"):
        machine.choose_device("cuda")


@pytest.mark.parametrize(("free_bytes", "told_gb"), [(1_400_000_000, "1.4"), (None, "0.0")])
def test_a_gpu_whose_memory_others_hold_is_taken_only_where_it_is_asked_for(
    gtx_1080: pytest.MonkeyPatch, free_bytes: int | None, told_gb: str
) -> None:
    def memory() -> tuple[int, int]:
        if free_bytes is None:
            raise torch.OutOfMemoryError("CUDA error: out of memory")
        return free_bytes, 8_000_000_000

    gtx_1080.setattr(torch.cuda, "get_device_capability", lambda: (8, 6))
    gtx_1080.setattr(torch.cuda, "mem_get_info", memory)
    told: list[str] = []
    assert machine.choose_device("auto", told.append).type == "cpu"
    (text,) = told
    assert f"only {told_gb} GB are free" in text
    assert machine.choose_device("cuda", told.append).type == "cuda"
    assert told == [text]
