"""How the threads of torch wait for each other; to be set before torch is loaded."""

import os
import statistics
import time
from pathlib import Path

_LOAD = Path("/proc/loadavg")
_SAMPLES, _APART_S = 5, 0.01


def set_waiting_policy() -> None:
    """Let waiting threads sleep on a busy computer, unless the user has chosen.

    They spin while they wait. On an idle computer that is best (sleeping makes a run 1.7 times as long). On a
    busy one they keep each other from the cores, and a fit took five times as long as with sleeping threads.
    Only Linux is asked: elsewhere nothing was measured.
    """
    if "OMP_WAIT_POLICY" in os.environ or not _LOAD.exists():
        return
    if _others_running() >= max(1, (os.cpu_count() or 1) / 4):
        os.environ["OMP_WAIT_POLICY"] = "PASSIVE"


def _others_running() -> float:
    """Threads that want a core just now, without this one; the load average would remember the last run."""
    counts = []
    for _ in range(_SAMPLES):
        running = _LOAD.read_text(encoding="ascii").split()[3].partition("/")[0]
        counts.append(int(running) - 1)
        time.sleep(_APART_S)
    return statistics.median(counts)
