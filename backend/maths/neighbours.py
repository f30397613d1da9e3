"""What the neighbours of a point in a cloud say of it: their plane, and whether it belongs to them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from .nearest import nearest_tree


class Planes(NamedTuple):
    """The least-squares plane of each point's neighbours."""

    normals: Float64[np.ndarray, "points 3"]
    """Unit; which of the two sides is chance."""
    flatness: Float64[np.ndarray, "points"]
    """1 - the smallest over the middle variance: 1 on a plane, 0 where no direction is thinnest."""


def neighbour_planes(points: Float64[np.ndarray, "points 3"], count: int = 20) -> Planes:
    """From the principal axes of `count` neighbours, the point included (Hoppe et al., SIGGRAPH 1992)."""
    _, index = nearest_tree(points).query(points, k=min(count, len(points)), workers=-1)
    around = points[index]
    around -= around.mean(axis=1, keepdims=True)
    variance, axes = np.linalg.eigh(np.einsum("pki,pkj->pij", around, around))
    middle = variance[:, 1]
    flatness = 1 - np.clip(variance[:, 0], 0, None) / np.where(middle > 0, middle, 1.0)
    return Planes(normals=axes[:, :, 0], flatness=np.where(middle > 0, flatness, 0.0))


def crowding(points: Float64[np.ndarray, "points 3"], count: int = 12) -> Float64[np.ndarray, "points"]:
    """How much a point is to be trusted, 0 to 1: 1 where neighbours are near, less the lonelier it is.

    The area that `count` neighbours take is held against that of the cloud's denser quarter: twice that is
    a half. Up to half of the cloud may be strays that lie in the open.
    """
    count = min(count, len(points) - 1)
    reach, _ = nearest_tree(points).query(points, k=[count + 1], workers=-1)
    area = reach[:, 0] ** 2
    usual = np.quantile(area, 0.25)
    return np.asarray(1 / (1 + (area / (2 * max(usual, np.finfo(float).tiny))) ** 2))


def sheetness(points: Float64[np.ndarray, "points 3"], count: int = 20) -> Float64[np.ndarray, "points"]:
    """How well a point and its neighbours lie in one plane, 0 to 1, however far they are apart.

    The mean square thickness of `count` neighbours and the square of the point's own distance from their
    plane are held against their middle variance: a quarter of it is a half.
    """
    _, index = nearest_tree(points).query(points, k=min(count + 1, len(points)), workers=-1)
    around = points[index[:, 1:]]
    middle = around.mean(axis=1, keepdims=True)
    around -= middle
    variance, axes = np.linalg.eigh(np.einsum("pki,pkj->pij", around, around) / around.shape[1])
    off = np.einsum("pi,pi->p", points - middle[:, 0], axes[:, :, 0])
    thickness2 = np.clip(variance[:, 0], 0, None) + off**2
    width2 = np.clip(variance[:, 1], np.finfo(float).tiny, None)
    return np.asarray(1 / (1 + (4 * thickness2 / width2) ** 4))


def trusts(points: Float64[np.ndarray, "points 3"]) -> Float64[np.ndarray, "points"]:
    """How much a point is to be trusted, 0 to 1: it is in a crowd, or in a sheet though lonely.

    A scanner that looks into a bore leaves few points there, but they lie on a surface; strays lie on none.
    """
    return np.asarray(1 - (1 - crowding(points)) * (1 - sheetness(points)))


def against_neighbours(
    points: Float64[np.ndarray, "points 3"], normals: Float64[np.ndarray, "points 3"], count: int = 8
) -> Bool[np.ndarray, "points"]:
    """True where a normal points away from the mean of its neighbours' normals."""
    _, index = nearest_tree(points).query(points, k=min(count, len(points)), workers=-1)
    return np.asarray((normals[index[:, 1:]].sum(axis=1) * normals).sum(axis=1) < 0)
