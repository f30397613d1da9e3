"""Which way is up, for photographs held upright; numpy alone, because Blender's Python uses it as well."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_CERTAIN, _UNCERTAIN = 0.02, 0.002
"""Spread of the cameras' x axes (second eigenvalue of their mean outer product): that of an arc of 28
degrees, from which on they alone say what is level, and of 9 degrees, where they say nothing."""
_RESIDUALS = (0.5, 0.35, 0.25, 0.17, 0.12, 0.1, 0.1, 0.1)
"""Sines of the roll at which a camera counts a quarter, from a first look to the last."""
_TIE = 1e-3
"""Of the backwards axes beside the tops: decides for cameras that look straight down."""


def up_direction(rights: Array, tops: Array, backwards: Array) -> Array:
    """(3,): unit vector of the world that is up, for photographs held upright with a level horizon.

    `rights`, `tops` and `backwards` (cameras, 3) are the directions to the right and to the top of each
    picture and away from what it shows, in the world, unit vectors. However a level camera is tilted, its
    right is horizontal. So up is the unit vector u with the least sum of w_i (x_i . u)^2, where
    w_i = (s^2 / (s^2 + (x_i . u)^2))^2 lets a camera that was held in another way than the others count
    little (Geman and McClure's weights, s falling from 0.5 to 0.1). Its sign is that of the median of the
    tops. Where the rights are nearly parallel, which leaves u free to turn about them, this median decides
    that, too; in between both have a share.
    """
    top = _median_direction(tops)
    up = top
    for scale in _RESIDUALS:
        weights = (scale**2 / (scale**2 + (rights @ up) ** 2)) ** 2
        spread, axes = np.linalg.eigh(np.einsum("n,ni,nj->ij", weights / weights.sum(), rights, rights))
        share = np.clip((_CERTAIN - spread[1]) / (_CERTAIN - _UNCERTAIN), 0.0, 1.0)
        along = axes.T @ (top + _TIE * backwards.mean(axis=0)) * [1.0, share, 0.0]
        up = axes @ along / np.linalg.norm(along)
    return up


def _median_direction(directions: Array) -> Array:
    """(3,): unit vector to the geometric median (Weiszfeld's iteration); not moved by a few outliers."""
    median = directions.mean(axis=0)
    for _ in range(50):
        nearness = 1.0 / np.maximum(np.linalg.norm(directions - median, axis=1), 1e-6)
        median = (nearness[:, None] * directions).sum(axis=0) / nearness.sum()
    length = float(np.linalg.norm(median))
    return np.asarray(median / length) if length > 1e-6 else directions[0]
