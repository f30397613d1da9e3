"""How much brighter one photograph is than another, from surface that both show."""

import numpy as np
from jaxtyping import Bool, Float64
from scipy.sparse.csgraph import minimum_spanning_tree

from .srgb import linear_from_srgb, srgb_from_linear

_NEAREST = 3
"""Photographs that each one is compared with, beside those that join all that can be joined."""


def log_exposures(
    log_light: Float64[np.ndarray, "views points"], shown: Bool[np.ndarray, "views points"]
) -> Float64[np.ndarray, "views"]:
    """Natural logarithm of each photograph's exposure: log light is log exposure and log colour together.

    Two photographs differ by the median over what both show: a highlight in one of them, or surface that is
    not where it is thought to be, is a minority. All `compared_pairs` together are solved by least squares,
    each weighing as much as it shows in common. Photographs that nothing joins have a mean of 0 each for
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


def evened(
    srgb: Float64[np.ndarray, "*views points 3"], log_exposure: Float64[np.ndarray, "*views 3"]
) -> Float64[np.ndarray, "*views points 3"]:
    """Colours of photographs as they were without their exposures; the same where these are 0."""
    if not log_exposure.any():
        return srgb
    return srgb_from_linear(linear_from_srgb(srgb) * np.exp(-log_exposure)[..., None, :])


def disagreement(
    log_light: Float64[np.ndarray, "views points"], shown: Bool[np.ndarray, "views points"]
) -> float:
    """Median difference between two photographs over all `compared_pairs`; 0 where there are none."""
    apart = [np.abs(values) for _, _, values in _differences(log_light, shown)]
    return float(np.median(np.concatenate(apart))) if apart else 0.0


def compared_pairs(shown: Bool[np.ndarray, "views points"]) -> list[tuple[int, int]]:
    """Each photograph with the few that share most of what it shows; their number grows with the photographs.

    The tree of the pairs that share most is among them, so that whatever all pairs would join is joined.
    """
    seen = shown.astype(np.float32)
    shared = seen @ seen.T
    np.fill_diagonal(shared, 0)
    most = np.argsort(-shared, axis=1, kind="stable")[:, :_NEAREST]
    chosen = np.zeros(shared.shape, bool)
    np.put_along_axis(chosen, most, True, axis=1)
    # of weights below 0 the least tree is the greatest; where nothing is shared there is no edge
    chosen |= minimum_spanning_tree(-shared).toarray() != 0
    one, other = np.nonzero(np.triu((chosen | chosen.T) & (shared > 0)))
    return list(zip(one.tolist(), other.tolist(), strict=True))


def _differences(
    log_light: Float64[np.ndarray, "views points"], shown: Bool[np.ndarray, "views points"]
) -> list[tuple[int, int, Float64[np.ndarray, "shared"]]]:
    """For each two photographs that are compared, by how much they differ in what both show."""
    both = [(i, j, shown[i] & shown[j]) for i, j in compared_pairs(shown)]
    return [(i, j, log_light[i, common] - log_light[j, common]) for i, j, common in both]
