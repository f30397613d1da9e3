"""How the threads of torch wait for each other; to be set before torch is loaded."""

import os

_BUSY = 0.4
"""Load of each core from which on the computer counts as busy."""


def set_waiting_policy() -> None:
    """Let waiting threads sleep on a busy computer, unless the user has chosen.

    They spin while they wait. On an idle computer that is best (sleeping makes a run 1.7 times as long). On a
    busy one they keep each other from the cores, and a fit took five times as long as with sleeping threads.
    """
    if hasattr(os, "getloadavg") and os.getloadavg()[0] > _BUSY * (os.cpu_count() or 1):
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
