"""What this computer offers: devices, cores, memory; and torch set up for them."""

import logging
import os
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from .errors import ErrorCode, ReconstructionError
from .failures import first_line

_ARCHITECTURE = re.compile(r"(sm|compute)_(\d+)(\d)([af]?)$")
_FEWEST_FREE_GB = 1.5
"""Of the GPU's memory. Six photographs take 0.45 beside what CUDA itself takes, twenty large ones more."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class SeenDevice:
    """A device that torch sees."""

    kind: str
    name: str
    fault: str = ""
    """What keeps torch from using it; empty where nothing is known to."""


def seen_devices() -> tuple[SeenDevice, ...]:
    """The devices that torch sees here, best first, with those that it cannot use."""
    cuda = (_cuda(),) if torch.cuda.is_available() else ()
    mps = (SeenDevice(kind="mps", name="Apple GPU"),) if torch.backends.mps.is_available() else ()
    return (*cuda, *mps, SeenDevice(kind="cpu", name=f"{usable_cores()} cores"))


def available_devices() -> dict[str, str]:
    """Kinds of devices torch can use here, best first, with their names."""
    return {device.kind: device.name for device in seen_devices() if not device.fault}


def _cuda() -> SeenDevice:
    try:
        name, capability = torch.cuda.get_device_name(), torch.cuda.get_device_capability()
    except RuntimeError as error:  # of the driver
        return SeenDevice(kind="cuda", name="GPU", fault=first_line(error))
    lacks = f"this torch has no code for its compute capability {'.'.join(map(str, capability))}"
    is_fine = covers(torch.cuda.get_arch_list(), capability)
    return SeenDevice(kind="cuda", name=name, fault="" if is_fine else lacks)


def covers(architectures: Sequence[str], capability: tuple[int, int]) -> bool:
    """Whether an NVIDIA GPU of this compute capability runs code for one of the architectures.

    They are written as torch.cuda.get_arch_list does. True where none is of NVIDIA: nothing is known then.
    """
    known = [match for match in map(_ARCHITECTURE.match, architectures) if match]
    return not known or any(_runs(match, capability) for match in known)


def _runs(architecture: re.Match[str], capability: tuple[int, int]) -> bool:
    """Machine code (sm) runs from its version to the next major one, what is compiled on the spot for ever.

    Unless it is for that version alone (a), or for its family, which is of one major version (f).
    """
    form, major, minor, only = architecture.groups()
    version = int(major), int(minor)
    if only == "a":
        return capability == version
    return capability >= version and (capability[0] == version[0] or (form, only) == ("compute", ""))


def choose_device(kind: str, warn: Callable[[str], object] = logger.warning) -> torch.device:
    """The device of the kind; ReconstructionError where it is not there.

    For "auto" CUDA where it is and others have left it memory, which is told by `warn` if not, else the CPU.
    Apple's GPU is for those who ask for it: nothing has been run on it yet, while the CPU's compiled steps
    are measured.
    """
    available = available_devices()
    if kind == "auto":
        if "cuda" not in available:
            return torch.device("cpu")
        free_gb = _free_gpu_bytes() / 1e9
        if free_gb < _FEWEST_FREE_GB:
            warn(
                f"The CPU is used: of the GPU's memory only {free_gb:.1f} GB are free, and a job may need "
                f"{_FEWEST_FREE_GB} GB. Close what else uses the GPU, or choose the device cuda all the same."
            )
            return torch.device("cpu")
        return torch.device("cuda")
    if kind not in available:
        faults = [f"{seen.name}: {seen.fault}" for seen in seen_devices() if seen.kind == kind and seen.fault]
        why = faults[0] if faults else f"there is {', '.join(available)}"
        raise ReconstructionError(
            ErrorCode.DEVICE_UNAVAILABLE,
            f"The device {kind} is not available here ({why}).",
            "Choose the device automatically (auto), or install a torch that supports your GPU.",
        )
    return torch.device(kind)


def _free_gpu_bytes() -> int:
    try:
        free, _ = torch.cuda.mem_get_info()
    except RuntimeError:  # there is not even room for CUDA itself
        return 0
    return free


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
