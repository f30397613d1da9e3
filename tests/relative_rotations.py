"""How far off the turns between each two cameras are: no alignment enters."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation


def rotation_errors_deg(ours: Sequence[np.ndarray], true: Sequence[np.ndarray]) -> np.ndarray:
    """For each two cameras; poses are camera_from_world, of which the rotation counts."""
    turns = [
        ours[i][:3, :3] @ ours[j][:3, :3].T @ true[j][:3, :3] @ true[i][:3, :3].T
        for i, j in combinations(range(len(ours)), 2)
    ]
    return np.asarray(np.degrees(Rotation.from_matrix(np.array(turns)).magnitude()))
