"""What this computer offers: devices, cores, memory; and torch set up for them."""

import os
import sys
from pathlib import Path

import torch

from .errors import ErrorCode, ReconstructionError


def available_devices() -> dict[str, str]:
    """Kinds of devices torch can use here, best first, with their names."""
    found = {}
    if torch.cuda.is_available():
        found["cuda"] = torch.cuda.get_device_name()
    if torch.backends.mps.is_available():
        found["mps"] = "Apple GPU"
    return {**found, "cpu": f"{usable_cores()} cores"}


def choose_device(kind: str) -> torch.device:
    """The device of the kind; ReconstructionError where it is not there.

    For "auto" CUDA where it is, else the CPU. Apple's GPU is for those who ask for it: nothing has been run
    on it yet, while the CPU's compiled steps are measured.
    """
    available = available_devices()
    if kind == "auto":
        return torch.device("cuda" if "cuda" in available else "cpu")
    if kind not in available:
        raise ReconstructionError(
            ErrorCode.DEVICE_UNAVAILABLE,
            f"The device {kind} is not available here (there is {', '.join(available)}).",
            "Choose the device automatically (auto), or install a torch that supports your GPU.",
        )
    return torch.device(kind)


def set_up_torch(device: torch.device) -> None:
    """Make runs on the device repeatable and quick."""
    torch.set_num_threads(min(torch.get_num_threads(), usable_cores()))
    if device.type == "cpu":
        torch.set_flush_denormal(True)  # weights near 0 are many and slow the CPU down tenfold
        # What use_deterministic_algorithms does for code that is not compiled; that one loads the compiler,
        # which takes as long as all of torch.
        torch.set_deterministic_debug_mode("error")
        # Filling memory before it is written costs time and changes nothing.
        torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]


def usable_cores() -> int:
    """Physical cores this process may use, at least 1: affinity, twin threads and quota considered."""
    if not sys.platform.startswith("linux"):
        return os.cpu_count() or 1
    twins = set()
    for cpu in os.sched_getaffinity(0):
        path = Path(f"/sys/devices/system/cpu/cpu{cpu}/topology/thread_siblings_list")
        twins.add(path.read_text() if path.is_file() else str(cpu))
    return max(1, min(len(twins), _quota_cores()))


def _quota_cores() -> int:
    """Cores that a container's quota allows (cgroup v2), rounded up; many where there is no quota."""
    path = Path("/sys/fs/cgroup/cpu.max")
    quota, _, period = (path.read_text() if path.is_file() else "max").partition(" ")
    return 1024 if quota.strip() == "max" else -(-int(quota) // int(period))


def peak_memory_bytes() -> int | None:
    """The most memory this process has held so far; None where the system does not tell."""
    status = Path("/proc/self/status")
    if status.is_file():  # before getrusage: that one also counts the program that started this one
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    if sys.platform == "win32":
        return None
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
