"""Before torch is loaded, and once it is."""

import os

from backend.waiting import set_waiting_policy

_SHARED = "PYTEST_XDIST_WORKER" in os.environ
"""Whether other tests run at the same time, one to a core."""

if _SHARED:
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # also for the programs that tests start
set_waiting_policy()

import torch  # noqa: E402

if _SHARED:
    torch.set_num_threads(1)
