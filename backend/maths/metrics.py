"""How far a mesh is from the truth, and a picture from a photograph.

Distances run between points drawn evenly over both surfaces, from each point to the nearest of the
other side, in percent of the diagonal of the truth's bounding box. Two surfaces that agree exactly
are still half a sample spacing apart: 0.1 % for 200,000 points on a sphere.

  accuracy      mean distance from the mesh to the truth: what is there, is it right?
  completeness  mean distance from the truth to the mesh: what should be there, is it?
  chamfer       mean of both
  f_score       harmonic mean of the shares of both sides that lie nearer than a threshold
  normals       mean |cosine| between the normals of nearest points, both ways

Definitions of the F-score after Knapitsch et al., "Tanks and Temples" (2017), section 4.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Float32, Float64, Int64

from ..errors import ErrorCode, ReconstructionError
from ..scene import Camera, SurfaceMesh
from .calibration import Calibration, calibration
from .nearest import nearest_tree
from .raycast import RayCaster, interpolate, intersect_planes, visible_from

READ_FAILURES = (
    OSError,
    ValueError,
    LookupError,
    NotImplementedError,
    ImportError,
    TypeError,
)
"""What trimesh's readers raise for files that are not what their name says."""

_WORLD_FROM_GLTF = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], np.float64)
"""glTF has y up, the world of rendered views z up: as Blender's importer and our own mesh.glb have it."""

_FEW_SAMPLES = 2000
"""On either surface, where one does not lie where the other does."""

_SCALE = 1.7
"""Times as large as the truth, or as small, what is no part of it and no hull around it any more."""


@dataclass(frozen=True, kw_only=True)
class TrueSurface:
    """What the mesh should have been, world frame: triangles, or only points."""

    vertices: Float64[np.ndarray, "vertices 3"]
    faces: Int64[np.ndarray, "faces 3"] | None
    """None for a point cloud, of which every vertex is a measurement."""

    @property
    def diagonal(self) -> float:
        """Of the bounding box, world units."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))


@dataclass(frozen=True, kw_only=True)
class SurfaceError:
    """Difference between two surfaces; lengths in percent of the truth's diagonal, shares from 0 to 1."""

    accuracy_percent: float
    completeness_percent: float
    f_score_at_half_percent: float
    f_score_at_one_percent: float
    normal_consistency: float | None
    """None where the truth is a cloud."""

    @property
    def chamfer_percent(self) -> float:
        """Mean of accuracy and completeness."""
        return (self.accuracy_percent + self.completeness_percent) / 2


@dataclass(frozen=True, kw_only=True)
class ErrorAgainstTruth:
    """The error of a whole surface and of the part that some camera sees."""

    whole: SurfaceError
    visible: SurfaceError | None
    """Samples that some camera sees; None without cameras or true faces, or if none is seen."""
    visible_share_of_truth: float | None
    visible_share_of_mesh: float | None
    truth_diagonal_world: float
    support: Calibration
    """How well the mesh's support foretells the error, over the whole surface."""


@dataclass(frozen=True, kw_only=True)
class _Samples:
    positions: Float64[np.ndarray, "samples 3"]
    normals: Float64[np.ndarray, "samples 3"] | None

    def where(self, kept: Bool[np.ndarray, "samples"]) -> "_Samples":
        normals = None if self.normals is None else self.normals[kept]
        return _Samples(positions=self.positions[kept], normals=normals)


def surface_error(
    mesh: SurfaceMesh,
    truth: TrueSurface,
    *,
    cameras: Sequence[Camera] | None,
    seed: int,
    num_samples: int = 200_000,
    mesh_among: RayCaster | None = None,
    truth_among: RayCaster | None = None,
) -> ErrorAgainstTruth:
    """Error of a mesh with at least one face; repeats to the bit with the same seed.

    Where mesh and truth are parts of something, `mesh_among` and `truth_among` are all of it: what hides
    them from the cameras.
    """
    rng = np.random.default_rng(seed)
    of_mesh, face = _sample(mesh.vertices, mesh.faces, num_samples, rng)
    of_truth = _sample_truth(truth, num_samples, rng)
    visible, share_of_truth, share_of_mesh = None, None, None
    if cameras and truth.faces is not None:
        seen_mesh = _seen(of_mesh, cameras, mesh_among or RayCaster(mesh.vertices, mesh.faces))
        seen_truth = _seen(of_truth, cameras, truth_among or RayCaster(truth.vertices, truth.faces))
        share_of_mesh, share_of_truth = float(seen_mesh.mean()), float(seen_truth.mean())
        if seen_mesh.any() and seen_truth.any():
            visible, _ = _compare(of_mesh.where(seen_mesh), of_truth.where(seen_truth), truth.diagonal)
    whole, to_truth = _compare(of_mesh, of_truth, truth.diagonal)
    return ErrorAgainstTruth(
        whole=whole,
        visible=visible,
        visible_share_of_truth=share_of_truth,
        visible_share_of_mesh=share_of_mesh,
        truth_diagonal_world=truth.diagonal,
        support=calibration(_support_at(mesh, of_mesh, face), to_truth * (100 / truth.diagonal)),
    )


def vertex_error_percent(
    mesh: SurfaceMesh, truth: TrueSurface, *, seed: int, num_samples: int = 200_000
) -> Float32[np.ndarray, "vertices"]:
    """Distance of each of the mesh's vertices from the truth, in percent of its diagonal."""
    samples = _sample_truth(truth, num_samples, np.random.default_rng(seed))
    distance, _ = _nearest(mesh.vertices, samples.positions)
    return (distance * (100 / truth.diagonal)).astype(np.float32)


def elsewhere_text(mesh: SurfaceMesh, truth: TrueSurface) -> str:
    """For a person: that the truth has another scale or place than the mesh; empty where it has not."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    diagonal = float(np.linalg.norm(high - low))
    larger = truth.diagonal / diagonal if diagonal > 0 else math.inf
    middle = (truth.vertices.min(axis=0) + truth.vertices.max(axis=0)) / 2
    apart = float(np.linalg.norm((low + high) / 2 - middle))
    if not 1 / _SCALE < larger < _SCALE:
        text = f"{larger:.3g} times as large as the mesh"
    elif apart > (diagonal + truth.diagonal) / 4:
        text = f"{apart / truth.diagonal:.2g} of its diagonals beside the mesh"
    else:
        return ""
    return f"The true surface is {text}: errors say so, and nothing of the shape. Give it in the same frame."


def samples_worth_it(mesh: SurfaceMesh, truth: TrueSurface, wanted: int) -> int:
    """How many samples the comparison takes: fewer than wanted where the truth lies elsewhere.

    All points of a surface far off are about equally near: each search takes a look at all of them.
    """
    return min(_FEW_SAMPLES, wanted) if elsewhere_text(mesh, truth) else wanted


def psnr(
    image: Float[np.ndarray, "height width 3"],
    rendered: Float[np.ndarray, "height width 3"],
    mask: Bool[np.ndarray, "height width"],
) -> float | None:
    """-10 log10 of the mean squared difference inside the mask, in dB; None where the mask is empty."""
    if not mask.any():
        return None
    difference = image[mask].astype(np.float64) - rendered[mask]
    mean_square = float(np.mean(difference**2))
    return float("inf") if mean_square == 0 else float(-10 * np.log10(mean_square))


def load_truth(path: Path) -> TrueSurface:
    """A mesh or cloud from PLY, OBJ, STL, OFF, glTF or GLB (the last two turned from y up to z up).

    Raises ReconstructionError(TRUTH_UNREADABLE) if the file is missing or broken, or holds no surface.
    """
    if not path.is_file():
        raise _unreadable(f"The true surface {path.name} does not exist.")
    try:
        loaded: Any = trimesh.load(path, process=False, skip_materials=True)
        geometry = loaded.to_geometry() if hasattr(loaded, "to_geometry") else loaded
        vertices = np.asarray(geometry.vertices, np.float64)
        faces = np.asarray(getattr(geometry, "faces", np.zeros((0, 3))), np.int64)
    except READ_FAILURES as error:
        raise _unreadable(f"The true surface {path.name} cannot be read ({error}).") from error
    if len(vertices) < 3 or not np.isfinite(vertices).all() or not np.ptp(vertices, axis=0).any():
        raise _unreadable(f"The true surface {path.name} holds no surface.")
    if len(faces) and not (faces.min() >= 0 and faces.max() < len(vertices)):
        raise _unreadable(f"The true surface {path.name} is cut short or broken.")
    return TrueSurface(vertices=_in_world(vertices, path), faces=faces if len(faces) else None)


def _unreadable(text: str) -> ReconstructionError:
    remedy = "Give a mesh or point cloud as PLY, OBJ, STL or GLB, in the frame of the cameras."
    return ReconstructionError(ErrorCode.TRUTH_UNREADABLE, text, remedy)


def _in_world(vertices: Float64[np.ndarray, "vertices 3"], path: Path) -> Float64[np.ndarray, "vertices 3"]:
    is_gltf = path.suffix.lower() in {".glb", ".gltf"}
    return np.asarray(vertices @ _WORLD_FROM_GLTF.T) if is_gltf else vertices


def _sample(
    vertices: Float64[np.ndarray, "vertices 3"],
    faces: Int64[np.ndarray, "faces 3"],
    num_samples: int,
    rng: np.random.Generator,
) -> tuple[_Samples, Int64[np.ndarray, "samples"]]:
    """Points drawn evenly over the area, with the normals of their faces; and which faces those are."""
    surface = trimesh.Trimesh(vertices, faces, process=False)
    # Faces without area carry no samples, but trimesh lists no normal for them.
    positions, face = trimesh.sample.sample_surface(surface, num_samples, seed=rng)
    edges = np.diff(vertices[faces[face]], axis=1)
    normals = np.cross(edges[:, 0], edges[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return _Samples(positions=np.asarray(positions), normals=normals), np.asarray(face, np.int64)


def _sample_truth(truth: TrueSurface, num_samples: int, rng: np.random.Generator) -> _Samples:
    if truth.faces is None:
        return _Samples(positions=truth.vertices, normals=None)
    samples, _ = _sample(truth.vertices, truth.faces, num_samples, rng)
    return samples


def _support_at(
    mesh: SurfaceMesh, samples: _Samples, face: Int64[np.ndarray, "samples"]
) -> Float32[np.ndarray, "samples"]:
    assert samples.normals is not None
    corners = mesh.faces[face]
    _, weights = intersect_planes(mesh.vertices[corners], samples.positions, samples.normals)
    # Single precision as at the vertices: where their support is equal, that of the samples ties.
    return interpolate(mesh.support, corners, weights).astype(np.float32)


def _seen(samples: _Samples, cameras: Sequence[Camera], caster: RayCaster) -> Bool[np.ndarray, "samples"]:
    assert samples.normals is not None
    return np.asarray(visible_from(samples.positions, samples.normals, cameras, caster).any(axis=1))


def _nearest(
    points: Float64[np.ndarray, "points 3"], others: Float64[np.ndarray, "others 3"]
) -> tuple[Float64[np.ndarray, "points"], Int64[np.ndarray, "points"]]:
    distance, index = nearest_tree(others).query(points, workers=-1)
    return distance, index


def _compare(
    of_mesh: _Samples, of_truth: _Samples, diagonal: float
) -> tuple[SurfaceError, Float64[np.ndarray, "samples"]]:
    """The error, and the distance of each of the mesh's samples from the truth (world units)."""
    to_truth, truth_index = _nearest(of_mesh.positions, of_truth.positions)
    to_mesh, mesh_index = _nearest(of_truth.positions, of_mesh.positions)
    consistency = None
    if of_mesh.normals is not None and of_truth.normals is not None:
        there = (of_mesh.normals * of_truth.normals[truth_index]).sum(1)
        back = (of_truth.normals * of_mesh.normals[mesh_index]).sum(1)
        consistency = float((np.abs(there).mean() + np.abs(back).mean()) / 2)
    error = SurfaceError(
        accuracy_percent=float(to_truth.mean() / diagonal * 100),
        completeness_percent=float(to_mesh.mean() / diagonal * 100),
        f_score_at_half_percent=_f_score(to_truth, to_mesh, 0.005 * diagonal),
        f_score_at_one_percent=_f_score(to_truth, to_mesh, 0.01 * diagonal),
        normal_consistency=consistency,
    )
    return error, to_truth


def _f_score(
    to_truth: Float64[np.ndarray, "samples"], to_mesh: Float64[np.ndarray, "others"], threshold: float
) -> float:
    precision, recall = float((to_truth < threshold).mean()), float((to_mesh < threshold).mean())
    return 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0
