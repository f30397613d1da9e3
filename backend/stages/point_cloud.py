"""A point cloud from a file, and what is wrong with it said at once."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float64

from ..errors import ErrorCode, ReconstructionError
from ..maths.metrics import READ_FAILURES
from ..scene import Decision

FEWEST_POINTS = 30
_FLATTEST = 1e-6
"""Thickness over width; below, all points lie in one plane, to the precision of files."""


@dataclass(frozen=True, kw_only=True)
class PointCloud:
    """Points to be met by a surface: finite, all different, not in one plane; world frame."""

    positions: Float64[np.ndarray, "points 3"]
    normals: Float64[np.ndarray, "points 3"] | None
    """Unit, or 0 where a point has none; None where the file has none."""
    decisions: tuple[Decision, ...] = ()


def read_cloud(path: Path) -> PointCloud:
    """The points of a PLY file, or of a text file with the columns x y z [nx ny nz].

    Raises ReconstructionError(CLOUD_UNUSABLE) as `clean_cloud` does, or if the file can not be read.
    """
    if not path.is_file():
        raise _unusable(f"The cloud {path.name} does not exist.")
    try:
        positions, normals = _read_ply(path) if path.suffix.lower() == ".ply" else _read_text(path)
    except READ_FAILURES as error:
        raise _unusable(f"The cloud {path.name} can not be read ({error}).") from error
    return clean_cloud(positions, normals)


def clean_cloud(
    positions: Float64[np.ndarray, "points 3"], normals: Float64[np.ndarray, "points 3"] | None
) -> PointCloud:
    """The cloud without points that are not finite and without repeated ones.

    Raises ReconstructionError(CLOUD_UNUSABLE) if fewer than FEWEST_POINTS are left or all lie in a plane.
    """
    finite = np.isfinite(positions).all(axis=1)
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
    sizes = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
    if sizes[2] <= _FLATTEST * sizes[0]:
        raise _unusable("All points of the cloud lie in one plane: nothing tells what they enclose.")
    if normals is not None:
        normals = np.nan_to_num(normals[kept], nan=0.0, posinf=0.0, neginf=0.0)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = normals / np.where(lengths > 0, lengths, 1.0)
    return PointCloud(positions=positions, normals=normals, decisions=tuple(decisions))


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
    lines = path.read_text(encoding="utf-8").replace(",", " ").splitlines()
    if not any(line.strip() and not line.lstrip().startswith("#") for line in lines):
        raise ValueError("it is empty")
    table = np.loadtxt(lines, ndmin=2)
    if table.shape[1] not in (3, 6):
        raise ValueError(f"it has {table.shape[1]} columns, not x y z or x y z nx ny nz")
    return table[:, :3], table[:, 3:] if table.shape[1] == 6 else None


def _unusable(text: str) -> ReconstructionError:
    remedy = "Give points all over a surface, as PLY or as a text file with the columns x y z [nx ny nz]."
    return ReconstructionError(ErrorCode.CLOUD_UNUSABLE, text, remedy)
