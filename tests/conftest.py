"""Before torch is loaded. The add-on's tests come by here too, in a Python that has no torch."""

import os

from backend.waiting import set_waiting_policy

_SHARED = "PYTEST_XDIST_WORKER" in os.environ
"""Whether other tests run at the same time, one to a core."""

if _SHARED:
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # also for the programs that tests start
set_waiting_policy()
if _SHARED:
    import torch

    torch.set_num_threads(1)
