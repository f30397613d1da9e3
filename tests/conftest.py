"""Before torch is loaded. The add-on's tests come by here too, in a Python that has no torch."""

import os

from backend.waiting import set_waiting_policy

if "PYTEST_XDIST_WORKER" in os.environ:  # other tests run at the same time, one to a core
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # also for the programs that tests start
    import torch

    torch.set_num_threads(1)
else:
    set_waiting_policy()
