"""Which features of two pictures look alike, where a place may have several features."""

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64, UInt8
from torch import Tensor

_APART_PX = 8.0
"""A rival is another place, not the same one as it looks from elsewhere."""
_BACK_PX = 2.0
_NEAREST = 16
"""So many are looked through for a rival; a place has hardly more features than that."""
_ROWS = 1024
"""Compared with all others at a time: 40 MB for ten thousand features."""

Places = Float[np.ndarray, "features 2"]
OtherPlaces = Float[np.ndarray, "others 2"]
Descriptors = UInt8[np.ndarray, "features bytes"]
OtherDescriptors = UInt8[np.ndarray, "others bytes"]


def matched_descriptors(
    places_px: Places,
    descriptors: Descriptors,
    other_places_px: OtherPlaces,
    other_descriptors: OtherDescriptors,
    largest_ratio: float,
) -> Int64[np.ndarray, "matches 2"]:
    """Features of the one picture and of the other that are nearest to each other, the surest first.

    A match's distance is less than so many times that to its rival, the nearest feature of another place
    (Lowe's test, with rivals as by Mishkin, Matas and Perdoch, "MODS", 2015). Features of one place have the
    same position; the first of them stands for all, and is in one match at most.
    """
    if min(len(places_px), len(other_places_px)) < 2:
        return np.zeros((0, 2), np.int64)
    one, other = _unit(descriptors), _unit(other_descriptors)
    here, there = torch.tensor(places_px), torch.tensor(other_places_px)
    nearest, ratio = _nearest(one, other, there)
    likely = torch.nonzero(ratio < largest_ratio)[:, 0]
    likely = likely[ratio[likely].argsort(stable=True)]
    back, _ = _nearest(other[nearest[likely]], one, here)
    likely = likely[(here[back] - here[likely]).norm(dim=1) < _BACK_PX]
    first, other_first = _first_of_place(places_px)[likely], _first_of_place(other_places_px)[nearest[likely]]
    return _each_once(_each_once(np.stack([first, other_first], axis=1), 0), 1)


def _unit(descriptors: Descriptors) -> Float32[Tensor, "features bytes"]:
    return torch.nn.functional.normalize(torch.as_tensor(descriptors.astype(np.float32)), dim=1)


def _nearest(
    one: Float32[Tensor, "ones bytes"],
    other: Float32[Tensor, "others bytes"],
    places_px: Float[Tensor, "others 2"],
) -> tuple[Int64[Tensor, "ones"], Float32[Tensor, "ones"]]:
    """Of the others the nearest to each, and how many times the distance to its rival it is away."""
    nearest, ratios = [], []
    for rows in torch.split(one, _ROWS):
        cosine, index = (rows @ other.T).topk(min(_NEAREST, len(other)), dim=1)
        distance = (2 - 2 * cosine).clamp(min=0).sqrt()
        apart = (places_px[index] - places_px[index[:, :1]]).norm(dim=2) > _APART_PX
        # where all that were looked through are of one place, a rival is no nearer than the last of them
        rival = torch.where(apart, distance, distance[:, -1:]).amin(dim=1)
        nearest.append(index[:, 0])
        ratios.append(torch.where(rival > 0, distance[:, 0] / rival, 1.0))
    return torch.cat(nearest), torch.cat(ratios)


def _first_of_place(places_px: Places) -> Int64[np.ndarray, "features"]:
    """For each feature, the first one at its place."""
    _, first, which = np.unique(places_px, axis=0, return_index=True, return_inverse=True)
    found: Int64[np.ndarray, "features"] = first[which.ravel()]
    return found


def _each_once(matches: Int64[np.ndarray, "all 2"], side: int) -> Int64[np.ndarray, "kept 2"]:
    """The first match of each feature of one side, in their order."""
    _, first = np.unique(matches[:, side], return_index=True)
    return matches[np.sort(first)]
