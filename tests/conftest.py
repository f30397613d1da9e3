"""Before torch is loaded."""

from backend.waiting import set_waiting_policy

set_waiting_policy()
