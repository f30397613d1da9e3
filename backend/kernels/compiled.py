"""How kernels are compiled, and the arrays they take."""

import numpy as np
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Ints = NDArray[np.int32]

ZERO, HALF, ONE = np.float32(0), np.float32(0.5), np.float32(1)

_rounding_alone = {"contract", "arcp", "nsz"}
# what changes a result by rounding only: not a number stays what it is
compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath=_rounding_alone)
summing = njit(cache=True, nogil=True, error_model="numpy", fastmath=_rounding_alone | {"reassoc"})
# sums in any order, so that they are made of vectors


def floats(values: Tensor) -> Floats:
    """A tensor of the CPU as kernels take it: single precision, without gaps in memory."""
    return values.float().contiguous().numpy()
