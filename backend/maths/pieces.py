"""Connected pieces: of a mesh by its edges, of a depth map or a picture by neighbouring pixels."""

import numpy as np
from jaxtyping import Bool, Int, Int32, Int64, Shaped
from scipy.ndimage import label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def connected_pieces(pairs: Int[np.ndarray, "2 pairs"], count: int) -> Int64[np.ndarray, "count"]:
    """Number of the piece that each of `count` things belongs to, joined by pairs of their numbers."""
    links = coo_array((np.ones(pairs.shape[1], bool), pairs), shape=(count, count))
    _, piece = connected_components(links, directed=False)
    return np.asarray(piece, np.int64)


def whole_pieces(pixels: Bool[np.ndarray, "height width"]) -> Int32[np.ndarray, "height width"]:
    """A number for each piece of the pixels that are set; 0 off them, and in pieces that the border cuts."""
    pieces, _ = label(pixels)
    whole: Int32[np.ndarray, "height width"] = np.where(np.isin(pieces, along_border(pieces)), 0, pieces)
    return whole


def along_border(pixels: Shaped[np.ndarray, "height width"]) -> Shaped[np.ndarray, "border"]:
    """Those at the picture's border, the corners twice."""
    return np.concatenate([pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]])
