"""How kernels are compiled, where the code is kept, and the arrays they take."""

import os
import sys
from collections.abc import Mapping
from pathlib import Path

import numba
import numpy as np
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Ints = NDArray[np.int32]


def cache_folder(platform: str, environment: Mapping[str, str], home: Path) -> Path:
    """The folder of a user of this system in which programs keep what they can make again."""
    if platform == "win32":
        return Path(environment.get("LOCALAPPDATA") or home / "AppData" / "Local") / "fewview" / "cache"
    if platform == "darwin":
        return home / "Library" / "Caches" / "fewview"
    chosen = Path(environment.get("XDG_CACHE_HOME", ""))
    return (chosen if chosen.is_absolute() else home / ".cache") / "fewview"


# Before anything is compiled. By itself numba writes beside the code, in a folder that may be Blender's.
if not numba.config.CACHE_DIR:  # type: ignore[attr-defined]
    _folder = cache_folder(sys.platform, os.environ, Path.home()) / "numba"
    numba.config.CACHE_DIR = str(_folder)  # type: ignore[attr-defined]

ZERO, HALF, ONE = np.float32(0), np.float32(0.5), np.float32(1)

_rounding_alone = {"contract", "arcp", "nsz"}
# what changes a result by rounding only: not a number stays what it is
compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath=_rounding_alone)
summing = njit(cache=True, nogil=True, error_model="numpy", fastmath=_rounding_alone | {"reassoc"})
# sums in any order, so that they are made of vectors


def floats(values: Tensor) -> Floats:
    """A tensor of the CPU as kernels take it: single precision, without gaps in memory."""
    return values.float().contiguous().numpy()
