"""Before torch is loaded: as the command line sets it, for machines that do something else meanwhile."""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
