"""How far a result is from the object that its views were rendered from.

The distance of each vertex of the result to the nearest point of the true surface, in percent of the
diagonal of the true bounding box, as everywhere in FewView (docs/conventions.md).
"""

import time
from collections.abc import Generator, Sequence
from dataclasses import dataclass

import bpy
import numpy as np
from mathutils.bvhtree import BVHTree
from numpy.typing import NDArray

from . import colours
from .heat_map import ERROR
from .true_mesh import TrueMesh, subject_of, true_mesh

NUMBERS = "fewview_error_percent"
"""Custom property of a measured object: median, mean and 90 % quantile."""
_FACES_PER_TREE = 16_384
"""A search tree of more takes longer to build than Blender may be kept from its user."""
_QUERIES_PER_LOOK = 32
_STEP_S = 0.006


@dataclass(frozen=True, kw_only=True)
class ErrorNumbers:
    """Distances over all vertices, in percent of the diagonal of the true bounding box."""

    median_percent: float
    mean_percent: float
    p90_percent: float
    """Nine tenths of the vertices are nearer than this."""

    @property
    def text(self) -> str:
        """In a line for the user."""
        return (
            f"Distance from the original: median {self.median_percent:.2f} %, mean "
            f"{self.mean_percent:.2f} %, 90 % within {self.p90_percent:.2f} % of its size"
        )


def numbers_of(result: bpy.types.Object) -> ErrorNumbers | None:
    """What was measured last on this object."""
    found = result.get(NUMBERS)
    try:
        median, mean, p90 = (float(value) for value in found)
    except (TypeError, ValueError):  # nothing there, or something of another's making
        return None
    return ErrorNumbers(median_percent=median, mean_percent=mean, p90_percent=p90)


def measure_steps(result_uid: int, truth_uids: Sequence[int]) -> Generator[float, None, ErrorNumbers]:
    """Measure and show the error of an object, in short steps that say how much is done, 0 to 1.

    Objects are given by `session_uid`; the truth's children belong to it. The first step is as long as
    Blender takes to evaluate them. Writes the attribute `error` and the numbers, and shows the heat map;
    the caller pushes the undo step. Raises ValueError, in a sentence for the user, where something is
    missing or has no surface.
    """
    truth = _truth(result_uid, truth_uids)
    vertices = _vertices_world(_object(result_uid))
    diagonal = float(np.linalg.norm(np.ptp(truth.vertices, axis=0)))
    if not len(vertices) or not diagonal > 0:
        raise ValueError("The result or the original has no extent")
    yield 0.0
    trees = []
    for tree in _trees(truth):
        trees.append(tree)
        yield 0.0
    distances = np.empty(len(vertices))
    yield from _query(trees, vertices, distances)
    percent = 100 * distances / diagonal
    _write(_object(result_uid), percent)
    return _numbers(percent)


def _truth(result_uid: int, truth_uids: Sequence[int]) -> TrueMesh:
    """The true surface; ValueError where there is none, or where it is the result itself."""
    result = _object(result_uid)
    subjects = [made for uid in truth_uids for made in subject_of(_object(uid)) if made != result]
    if not subjects:
        raise ValueError("Choose the original: an object other than the result")
    try:
        return true_mesh(tuple(dict.fromkeys(subjects)))
    except ValueError as error:
        names = ", ".join(made.name for made in subjects)
        raise ValueError(f"{names} cannot be measured against: {error}") from error


def _object(uid: int) -> bpy.types.Object:
    found = next((made for made in bpy.data.objects if made.session_uid == uid), None)
    if found is None:
        raise ValueError("The result or the original is no longer there")
    return found


def _vertices_world(made: bpy.types.Object) -> NDArray[np.float64]:
    """(vertices, 3) of a mesh object, without its modifiers."""
    flat = np.empty(3 * len(made.data.vertices), np.float32)
    made.data.attributes["position"].data.foreach_get("vector", flat)
    world_from_object = np.array(made.matrix_world, np.float64)
    return flat.reshape(-1, 3) @ world_from_object[:3, :3].T + world_from_object[:3, 3]


def _trees(truth: TrueMesh) -> Generator[BVHTree, None, None]:
    """Search trees of the surface in slices, which lie apart so that far ones are passed over quickly."""
    middles = truth.vertices[truth.faces].mean(axis=1)
    axis = int(np.argmax(np.ptp(truth.vertices, axis=0)))
    order = np.argsort(middles[:, axis])
    for start in range(0, len(order), _FACES_PER_TREE):
        used, corners = np.unique(truth.faces[order[start : start + _FACES_PER_TREE]], return_inverse=True)
        yield BVHTree.FromPolygons(
            truth.vertices[used].tolist(), corners.reshape(-1, 3).tolist(), all_triangles=True
        )


def _query(
    trees: Sequence[BVHTree], vertices: NDArray[np.float64], distances: NDArray[np.float64]
) -> Generator[float, None, None]:
    """Fill in the distances; the share that is done after each step."""
    deadline = time.perf_counter() + _STEP_S
    last = 0
    for index, vertex in enumerate(vertices.tolist()):
        # The tree that was nearest before is the best to begin with: others then only look this far.
        found = trees[last].find_nearest(vertex)[3]
        nearest = np.inf if found is None else found
        for number, tree in enumerate(trees):
            if number != last:
                found = tree.find_nearest(vertex, nearest)[3]
                if found is not None and found < nearest:
                    nearest, last = found, number
        distances[index] = nearest
        if index % _QUERIES_PER_LOOK == 0 and time.perf_counter() > deadline:
            yield index / len(vertices)
            deadline = time.perf_counter() + _STEP_S


def _write(result: bpy.types.Object, percent: NDArray[np.float64]) -> None:
    mesh = result.data
    if mesh.is_editmode or len(mesh.vertices) != len(percent):
        raise ValueError("The result changed while it was measured: measure again")
    found = mesh.attributes.get(ERROR.attribute)
    if found is not None and (found.data_type != "FLOAT" or found.domain != "POINT"):
        raise ValueError(f"The mesh has an attribute {ERROR.attribute} of another kind: rename it")
    if found is None:
        found = mesh.attributes.new(ERROR.attribute, "FLOAT", "POINT")
    found.data.foreach_set("value", percent.astype(np.float32))
    numbers = _numbers(percent)
    result[NUMBERS] = [numbers.median_percent, numbers.mean_percent, numbers.p90_percent]
    colours.show(mesh, "ERROR")


def _numbers(percent: NDArray[np.float64]) -> ErrorNumbers:
    return ErrorNumbers(
        median_percent=float(np.median(percent)),
        mean_percent=float(percent.mean()),
        p90_percent=float(np.quantile(percent, 0.9)),
    )
