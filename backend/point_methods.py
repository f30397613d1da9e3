"""What callers too must know of points alone; standard library only: the add-on and --help read it."""

from enum import StrEnum

FEWEST_POINTS = 30
"""Of a cloud, all different."""


class PointMethod(StrEnum):
    """How a field is found for points; the first is the default."""

    LINEAR = "linear"
    NEURAL_PULL = "neural-pull"
    NAP = "nap"
    SDRO = "sdro"
    ENTROPY = "entropy"
