"""How much brighter one photograph is than another, from surface that both show."""

from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float64


def log_exposures(
    log_light: Float64[np.ndarray, "views points"], shown: Bool[np.ndarray, "views points"]
) -> Float64[np.ndarray, "views"]:
    """Natural logarithm of each photograph's exposure: log light is log exposure and log colour together.

    Two photographs differ by the median over what both show: a highlight in one of them, or surface that is
    not where it is thought to be, is a minority. All pairs together are solved by least squares, each
    weighing as much as it shows in common. Photographs that nothing joins have a mean of 0 each for
    themselves: what is common to all is no exposure but the brightness of the subject.
    """
    differences = _differences(log_light, shown)
    rows, wanted = np.zeros((len(differences), len(log_light))), np.zeros(len(differences))
    for row, (one, other, apart) in enumerate(differences):
        trust = np.sqrt(len(apart))
        rows[row, [one, other]] = trust, -trust
        wanted[row] = trust * np.median(apart)
    # Of all solutions the shortest: that whose mean is 0.
    solution: Float64[np.ndarray, "views"] = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    return solution


def disagreement(
    log_light: Float64[np.ndarray, "views points"], shown: Bool[np.ndarray, "views points"]
) -> float:
    """Median difference between two photographs, over all that any two show; 0 if there is nothing."""
    apart = [np.abs(values) for _, _, values in _differences(log_light, shown)]
    return float(np.median(np.concatenate(apart))) if apart else 0.0


def _differences(
    log_light: Float64[np.ndarray, "views points"], shown: Bool[np.ndarray, "views points"]
) -> list[tuple[int, int, Float64[np.ndarray, "shared"]]]:
    """For each two photographs that show something in common, by how much they differ there."""
    pairs = ((i, j, shown[i] & shown[j]) for i, j in combinations(range(len(log_light)), 2))
    return [(i, j, log_light[i, both] - log_light[j, both]) for i, j, both in pairs if both.any()]
