"""Connected pieces: of a mesh by its edges, of a depth map by neighbouring pixels."""

import numpy as np
from jaxtyping import Int, Int64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def connected_pieces(pairs: Int[np.ndarray, "2 pairs"], count: int) -> Int64[np.ndarray, "count"]:
    """Number of the piece that each of `count` things belongs to, joined by pairs of their numbers."""
    links = coo_array((np.ones(pairs.shape[1], bool), pairs), shape=(count, count))
    _, piece = connected_components(links, directed=False)
    return np.asarray(piece, np.int64)
