"""Where random walks over a picture end: with which known pixels an unknown one belongs.

Grady, "Random Walks for Image Segmentation", PAMI 2006. A walker steps to one of the eight neighbours, the
more readily the more alike the two look, and stays at a pixel of known value the more readily the surer that
is. What it finds on average is a harmonic function: one sparse system, and the same one tells how far apart
the values are that it may end at, and how far away.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64
from scipy.sparse import coo_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

_LEAST = 1e-4
"""Of what an edge conducts, beside 1 between equal pixels: no contrast parts two pixels altogether."""


@dataclass(frozen=True, kw_only=True)
class WalkEnds:
    """Of each pixel's walks; not a number where none is begun, or none can end."""

    mean: Float64[np.ndarray, "height width"]
    """Of the values where they end."""
    spread: Float64[np.ndarray, "height width"]
    """Standard deviation of these values."""
    distance_px: Float64[np.ndarray, "height width"]
    """Root mean square of how far away they end, as the crow flies."""


def walk_ends(
    picture: Float[np.ndarray, "height width channels"],
    inside: Bool[np.ndarray, "height width"],
    value: Float[np.ndarray, "height width"],
    sureness: Float[np.ndarray, "height width"],
    *,
    contrast: float,
) -> WalkEnds:
    """Ends of the walks from all pixels that are inside, which they do not leave.

    A difference of colour of `contrast` (> 0, in the picture's units, Euclidean) counts as one standard
    deviation. `sureness` is >= 0, beside the 1 that an edge between equal pixels conducts; where it is 0 the
    value is not looked at.
    """
    one, other, apart2 = _pairs(inside)
    colours = picture.reshape(-1, picture.shape[2]).astype(np.float64)
    unlike = ((colours[one] - colours[other]) ** 2).sum(axis=1) / (2 * contrast**2 * apart2)
    conducts = (np.exp(-unlike) + _LEAST) / apart2
    size = inside.size
    edges = coo_array((conducts, (one, other)), shape=(size, size))
    sure = np.where(inside, sureness, 0.0).ravel().astype(np.float64)
    pixels = _answered(edges, sure)
    if not len(pixels):
        nothing = np.full(inside.shape, np.nan)
        return WalkEnds(mean=nothing, spread=nothing, distance_px=nothing)
    edges = (edges + edges.T).tocsr()[pixels][:, pixels]
    sure = sure[pixels]
    place = np.stack(np.divmod(pixels, inside.shape[1]), axis=1).astype(np.float64)
    known = np.where(sure > 0, value.ravel()[pixels], 0.0)
    middle = float(known @ sure / sure.sum())
    known, place = known - middle, place - place.mean(axis=0)
    system = diags_array(sure + edges.sum(axis=1)) - edges
    asked = np.column_stack([known, known**2, place, (place**2).sum(axis=1)])
    solver = splu(system.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    found = solver.solve(sure[:, None] * asked)
    mean, square, ends, ends2 = found[:, 0], found[:, 1], found[:, 2:4], found[:, 4]
    distance2 = ends2 - 2 * (place * ends).sum(axis=1) + (place**2).sum(axis=1)

    def as_picture(values: Float64[np.ndarray, "pixels"]) -> Float64[np.ndarray, "height width"]:
        out = np.full(size, np.nan)
        out[pixels] = values
        return out.reshape(inside.shape)

    return WalkEnds(
        mean=as_picture(middle + mean),
        spread=as_picture(np.sqrt(np.clip(square - mean**2, 0, None))),
        distance_px=as_picture(np.sqrt(np.clip(distance2, 0, None))),
    )


def _pairs(
    inside: Bool[np.ndarray, "height width"],
) -> tuple[Int64[np.ndarray, "pairs"], Int64[np.ndarray, "pairs"], Float64[np.ndarray, "pairs"]]:
    """Numbers of neighbouring pixels that are both inside, each pair once, and their distance squared."""
    number = np.arange(inside.size, dtype=np.int64).reshape(inside.shape)
    sides = (
        (number[:, :-1], number[:, 1:], 1.0),
        (number[:-1], number[1:], 1.0),
        (number[:-1, :-1], number[1:, 1:], 2.0),
        (number[:-1, 1:], number[1:, :-1], 2.0),
    )
    one = np.concatenate([a.ravel() for a, _, _ in sides])
    other = np.concatenate([b.ravel() for _, b, _ in sides])
    apart2 = np.concatenate([np.full(a.size, square) for a, _, square in sides])
    flat = inside.ravel()
    both = flat[one] & flat[other]
    return one[both], other[both], apart2[both]


def _answered(edges: coo_array, sure: Float64[np.ndarray, "pixels"]) -> Int64[np.ndarray, "answered"]:
    """Numbers of the pixels from which some known one can be reached."""
    _, piece = connected_components(edges, directed=False)
    return np.flatnonzero(np.bincount(piece, weights=sure)[piece] > 0)
