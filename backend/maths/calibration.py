"""How well support foretells error: what is said of a mesh before the truth is known, against the truth.

A sample of the surface is right within 1 % of the diagonal of the truth's bounding box, else wrong.
Samples are drawn evenly over the mesh's area, so that shares of them are shares of its surface.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

RIGHT_WITHIN_PERCENT = 1.0
NUM_STEPS = 5


@dataclass(frozen=True, kw_only=True)
class SupportStep:
    """The surface whose support lies in one of equal steps from 0 to 1."""

    lowest_support: float
    highest_support: float
    """Excluded, but for the last step's 1."""
    share_of_mesh: float
    median_error_percent: float | None
    """None, as the next, where no surface has such support."""
    share_within_one_percent: float | None


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """What support says of the error."""

    auc: float | None
    """Chance that wrong surface has less support than right surface: 1 at best, 0.5 if support says nothing.
    None where all is right, or all wrong."""
    steps: tuple[SupportStep, ...]


def calibration(
    support: Float[np.ndarray, "samples"], error_percent: Float[np.ndarray, "samples"]
) -> Calibration:
    """From samples drawn evenly over a mesh, at least one; the errors are their distances to the truth."""
    right = error_percent <= RIGHT_WITHIN_PERCENT
    step_of = np.minimum((support * NUM_STEPS).astype(np.int64), NUM_STEPS - 1)
    steps = []
    for index in range(NUM_STEPS):
        here = step_of == index
        steps.append(
            SupportStep(
                lowest_support=index / NUM_STEPS,
                highest_support=(index + 1) / NUM_STEPS,
                share_of_mesh=float(here.mean()),
                median_error_percent=float(np.median(error_percent[here])) if here.any() else None,
                share_within_one_percent=float(right[here].mean()) if here.any() else None,
            )
        )
    return Calibration(auc=chance_of_less(support[~right], support[right]), steps=tuple(steps))


def chance_of_less(values: Float[np.ndarray, "values"], others: Float[np.ndarray, "others"]) -> float | None:
    """Chance that one of the values is less than one of the others, ties counting half.

    None if there are no values, or no others. It is U / (n m) of Mann and Whitney, "On a test of whether one
    of two random variables is stochastically larger than the other" (1947), and the area under the ROC curve
    of telling the two apart by a threshold: Hanley and McNeil, "The meaning and use of the area under a
    receiver operating characteristic (ROC) curve" (1982).
    """
    if not (len(values) and len(others)):
        return None
    ordered = np.sort(others)
    less, not_more = (ordered.searchsorted(values, side) for side in ("left", "right"))
    return float(1 - (less + not_more).mean() / (2 * len(others)))
