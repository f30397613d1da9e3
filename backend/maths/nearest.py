"""Nearest points: a k-d tree that can be built wherever the backend computes."""

from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import cKDTree


def nearest_tree(points: Float[ndarray, "points dimensions"]) -> cKDTree:
    """SciPy's tree, split in the middle of ranges rather than at medians.

    Where a median is the least of its values, SciPy goes on with the next number above it. Above 0 that is
    a denormal number, which a processor that flushes them, as ours is told to, takes for 0: the same split
    again, until the stack is full. Some points with a coordinate of exactly 0 suffice, such as a base at
    z = 0. The middle of a range is never its lower end.
    """
    return cKDTree(points, balanced_tree=False)
