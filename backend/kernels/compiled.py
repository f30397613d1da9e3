"""How kernels are compiled, where the code is kept, and the arrays they take."""

import os
import sys
from collections.abc import Mapping
from hashlib import sha256
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


def of_this_code(sources: Path) -> str:
    """A name that changes with the code in a folder.

    What numba has kept it takes again where the file that a kernel stands in is unchanged; but a kernel holds
    what it calls in other files, and is compiled as this one says.
    """
    contents = (path.name.encode() + path.read_bytes() for path in sorted(sources.glob("*.py")))
    return sha256(b"".join(contents)).hexdigest()[:16]


# Before anything is compiled. By itself numba writes beside the code, in a folder that may be Blender's.
_chosen: str = numba.config.CACHE_DIR  # type: ignore[attr-defined]
_folder = Path(_chosen) if _chosen else cache_folder(sys.platform, os.environ, Path.home()) / "numba"
numba.config.CACHE_DIR = str(_folder / of_this_code(Path(__file__).parent))  # type: ignore[attr-defined]

ZERO, HALF, ONE = np.float32(0), np.float32(0.5), np.float32(1)

_rounding_alone = {"contract", "arcp", "nsz"}
# what changes a result by rounding only: not a number stays what it is
# A kernel holds all that it calls. Else a part stands twice, by itself and in what calls it, with sums in
# another order, and which of them runs depends on whether this process has compiled or loaded them.
compiled = njit(cache=True, nogil=True, forceinline=True, error_model="numpy", fastmath=_rounding_alone)
_in_any_order = _rounding_alone | {"reassoc"}  # so that sums are made of vectors
summing = njit(cache=True, nogil=True, forceinline=True, error_model="numpy", fastmath=_in_any_order)


def floats(values: Tensor) -> Floats:
    """A tensor of the CPU as kernels take it: single precision, without gaps in memory."""
    return values.float().contiguous().numpy()
