"""A point cloud from a file, and what is wrong with it said at once."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float64

from ...errors import ErrorCode, ReconstructionError
from ...maths.metrics import READ_FAILURES
from ...point_methods import FEWEST_POINTS
from ...scene import Decision

_FLATTEST = 1e-6
"""Thickness over width; below, all points lie in one plane, to the precision of files."""
_LARGEST = 1e100
"""Of a coordinate: with larger ones areas and volumes are not finite."""


@dataclass(frozen=True, kw_only=True)
class PointCloud:
    """Points to be met by a surface: finite, all different, not in one plane; world frame."""

    positions: Float64[np.ndarray, "points 3"]
    normals: Float64[np.ndarray, "points 3"] | None
    """Unit, or 0 where a point has none; None where the file has none."""
    decisions: tuple[Decision, ...] = ()


def read_cloud(path: Path) -> PointCloud:
    """The points of a PLY file, or of a text file with the columns x y z [nx ny nz].

    Raises ReconstructionError(CLOUD_UNUSABLE) as `clean_cloud` does, or if the file cannot be read.
    """
    if not path.is_file():
        raise _unusable(f"The cloud {path.name} does not exist.")
    try:
        positions, normals = _read_ply(path) if path.suffix.lower() == ".ply" else _read_text(path)
    except READ_FAILURES as error:
        raise _unusable(f"The cloud {path.name} cannot be read ({error}).") from error
    return clean_cloud(positions, normals)


def clean_cloud(
    positions: Float64[np.ndarray, "points 3"], normals: Float64[np.ndarray, "points 3"] | None
) -> PointCloud:
    """The cloud without points that are not finite, or too large to reckon with, and without repeated ones.

    A normal that is not finite is none. Raises ReconstructionError(CLOUD_UNUSABLE) if fewer than
    FEWEST_POINTS points are left or all lie in a plane.
    """
    finite = (np.abs(positions) <= _LARGEST).all(axis=1)  # false for NaN
    _, first = np.unique(positions[finite], axis=0, return_index=True)
    kept = np.flatnonzero(finite)[np.sort(first)]
    decisions = []
    for number, what in ((int((~finite).sum()), "not finite"), (int(finite.sum()) - len(kept), "repeated")):
        if number:
            choice = f"{number} of {len(positions)} left out"
            decisions.append(
                Decision(what=f"points that are {what}", choice=choice, because="they say nothing")
            )
    if len(kept) < FEWEST_POINTS:
        raise _unusable(
            f"The cloud has {len(kept)} different points with finite coordinates; {FEWEST_POINTS} are needed."
        )
    positions = positions[kept]
    if _flatness(positions) <= _FLATTEST:
        raise _unusable("All points of the cloud lie in one plane: nothing tells what they enclose.")
    if normals is not None:
        normals = normals[kept]
        known = np.isfinite(normals).all(axis=1)
        if not known.all():
            choice = f"{int((~known).sum())} of {len(known)} left out"
            decisions.append(
                Decision(what="normals that are not finite", choice=choice, because="their points are kept")
            )
        normals = _unit(np.where(known[:, None], normals, 0.0))
    return PointCloud(positions=positions, normals=normals, decisions=tuple(decisions))


def _flatness(positions: Float64[np.ndarray, "points 3"]) -> float:
    """Thickness over width of a cloud in which a few points may be strays, however far away.

    A point weighs less the farther it is from the middle, beyond half of the points: in the sum of squares a
    single one, such as a scanner's mark for "nothing seen", makes a line of any cloud.
    """
    far = np.abs(positions - np.median(positions, axis=0)).max(axis=1)
    usual = np.median(far)
    weight = (usual / np.clip(far, usual, None))[:, None]
    middle = (weight * positions).sum(axis=0) / weight.sum()
    sizes = np.linalg.svd(weight * (positions - middle), compute_uv=False)
    return float(sizes[2] / sizes[0])


def _unit(vectors: Float64[np.ndarray, "vectors 3"]) -> Float64[np.ndarray, "vectors 3"]:
    """Of length one, or 0 as they were; a plain norm squares large and small numbers out of range."""
    largest = np.abs(vectors).max(axis=1, keepdims=True)
    scaled = vectors / np.where(largest > 0, largest, 1.0)
    return np.asarray(scaled / np.where(largest > 0, np.linalg.norm(scaled, axis=1, keepdims=True), 1.0))


def _read_ply(
    path: Path,
) -> tuple[Float64[np.ndarray, "points 3"], Float64[np.ndarray, "points 3"] | None]:
    """Of a mesh the vertices."""
    loaded: Any = trimesh.load(path, process=False, file_type="ply")
    table = loaded.metadata["_ply_raw"]["vertex"]["data"]

    def columns(*names: str) -> Float64[np.ndarray, "points 3"]:
        return np.stack([np.asarray(table[name], np.float64).ravel() for name in names], axis=1)

    names = table.dtype.names if isinstance(table, np.ndarray) else tuple(table)
    has_normals = {"nx", "ny", "nz"} <= set(names)
    return columns("x", "y", "z"), columns("nx", "ny", "nz") if has_normals else None


def _read_text(
    path: Path,
) -> tuple[Float64[np.ndarray, "points 3"], Float64[np.ndarray, "points 3"] | None]:
    """Numbers apart by blanks or commas; lines that begin with # say nothing. Raises ValueError."""
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    first = next((line.split() for line in lines if line.strip() and not line.lstrip().startswith("#")), None)
    if first is None:
        raise ValueError("it is empty")
    if len(first) > 1 and all(re.fullmatch(r"[^,]+,[^,]+", number) for number in first):
        raise ValueError("it has commas where its numbers need points, such as 0,5 for 0.5")
    table = np.loadtxt([line.replace(",", " ") for line in lines], ndmin=2)
    if table.shape[1] not in (3, 6):
        raise ValueError(f"it has {table.shape[1]} columns, not x y z or x y z nx ny nz")
    return table[:, :3], table[:, 3:] if table.shape[1] == 6 else None


def _unusable(text: str) -> ReconstructionError:
    remedy = "Give points all over a surface, as PLY or as a text file with the columns x y z [nx ny nz]."
    return ReconstructionError(ErrorCode.CLOUD_UNUSABLE, text, remedy)
