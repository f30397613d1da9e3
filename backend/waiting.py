"""How the threads of torch wait for each other; to be set before torch is loaded."""

import os
import statistics
import time
from collections.abc import Mapping
from pathlib import Path

_LOAD = Path("/proc/loadavg")
_SAMPLES, _APART_S = 5, 0.01
POLICIES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")
"""What threads are told by, in the environment."""
_chosen: dict[str, str] = {}
"""What this process has put into its environment."""


def set_waiting_policy() -> None:
    """Let threads spin only for a short while before they sleep, or not at all on a busy computer.

    Unless the user has chosen. By default they spin for 300 000 rounds: as soon as somebody else wants a
    core, as Blender does while its user goes on working, they keep each other from the rest (a fit of 21 s
    took 129 s). With 10 000 rounds it took 32 s, with none 20 s. Alone, 10 000 are as fast as the default,
    and none takes up to 1.7 times as long. Only Linux is asked: elsewhere nothing was measured.

    Called again, it looks again, for processes that are still to be started.
    """
    for name in _chosen:
        if os.environ.get(name) == _chosen[name]:
            del os.environ[name]
    _chosen.clear()
    if any(name in os.environ for name in POLICIES) or not _LOAD.exists():
        return
    if _others_running() >= max(1, (os.cpu_count() or 1) / 4):
        _chosen["OMP_WAIT_POLICY"] = "PASSIVE"
    else:
        _chosen["GOMP_SPINCOUNT"] = "10000"
    os.environ.update(_chosen)


def without_own_policy(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment for a process that is to look for itself: what the user has chosen stays."""
    return {name: value for name, value in environment.items() if _chosen.get(name) != value}


def _others_running() -> float:
    """Threads that want a core just now, without this one; the load average would remember the last run."""
    counts = []
    for _ in range(_SAMPLES):
        running = _LOAD.read_text(encoding="ascii").split()[3].partition("/")[0]
        counts.append(int(running) - 1)
        time.sleep(_APART_S)
    return statistics.median(counts)
