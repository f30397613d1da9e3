"""Nearest points where denormal numbers are flushed, as they are in every run."""

import subprocess
import sys

import pytest

CLOUD = """
import numpy as np, torch
from scipy.spatial import cKDTree
from backend.maths.nearest import nearest_tree
assert torch.set_flush_denormal(True)
points = np.random.default_rng(0).uniform(0, 1, (100_000, 3))
points[:, 2] *= points[:, 2] > 0.5  # half of them on a base at z = 0
distance, index = {tree}(points).query(points[:1000] + 1e-4)
nearest = np.linalg.norm(points[None, ::50] - points[:1000, None] - 1e-4, axis=2).min(axis=1)
assert (distance <= nearest + 1e-12).all() and (distance > 0).all() and (distance < 2e-4).all()
"""


@pytest.mark.parametrize(("tree", "well"), [("cKDTree", False), ("nearest_tree", True)])
def test_points_on_a_base_at_zero(tree: str, well: bool) -> None:
    """SciPy's own tree splits at the number after 0 for ever, and ends the process."""
    done = subprocess.run([sys.executable, "-c", CLOUD.format(tree=tree)], capture_output=True, text=True)
    assert (done.returncode == 0) == well, done.stderr
