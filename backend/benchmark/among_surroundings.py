"""The error of a subject among other things, which its photographs show and its true mesh lacks."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import trimesh
from jaxtyping import Float64

from ..maths.metrics import ErrorAgainstTruth, TrueSurface, surface_error
from ..maths.nearest import nearest_tree
from ..maths.raycast import RayCaster
from ..scene import Camera, SurfaceMesh

_FACES_TRIED = 8
"""Of each surface, for each vertex."""


def error_of_subject(
    mesh: SurfaceMesh,
    subject: TrueSurface,
    surroundings: TrueSurface,
    *,
    cameras: Sequence[Camera],
    seed: int,
    num_samples: int,
) -> ErrorAgainstTruth | None:
    """Error of the part of a mesh that lies nearer to the true subject than to what is true around it.

    All are in one frame. What hides the part, or the subject, from a camera may be anything there. None
    where no face of the mesh is nearer to the subject.
    """

    to_subject, to_surroundings = (
        _distance(mesh.vertices, truth, seed=seed, num_samples=num_samples)
        for truth in (subject, surroundings)
    )
    of_subject = to_subject < to_surroundings
    faces = mesh.faces[of_subject[mesh.faces].all(axis=1)]
    if not len(faces):
        return None
    return surface_error(
        replace(mesh, faces=faces),
        subject,
        cameras=cameras,
        seed=seed,
        num_samples=num_samples,
        mesh_among=RayCaster(mesh.vertices, mesh.faces),
        truth_among=_all_of(subject, surroundings),
    )


def _all_of(subject: TrueSurface, surroundings: TrueSurface) -> RayCaster | None:
    """Both as one thing to look at; None where either is a cloud, which hides nothing."""
    if subject.faces is None or surroundings.faces is None:
        return None
    vertices = np.concatenate([subject.vertices, surroundings.vertices])
    return RayCaster(vertices, np.concatenate([subject.faces, surroundings.faces + len(subject.vertices)]))


def _distance(
    points: Float64[np.ndarray, "points 3"], truth: TrueSurface, *, seed: int, num_samples: int
) -> Float64[np.ndarray, "points"]:
    """To the nearest of the faces on which the nearest samples lie; to the nearest point of a cloud.

    A room is so large that between its samples there is room for a ring of it around what stands there.
    """
    if truth.faces is None:
        to_points: Float64[np.ndarray, "points"] = nearest_tree(truth.vertices).query(points, workers=-1)[0]
        return to_points
    surface = trimesh.Trimesh(truth.vertices, truth.faces, process=False)
    samples, face = trimesh.sample.sample_surface(surface, num_samples, seed=seed)
    _, nearest = nearest_tree(np.asarray(samples)).query(points, k=_FACES_TRIED, workers=-1)
    distance = np.full(len(points), np.inf)
    for index in nearest.T:
        corners = surface.triangles[face[index]]
        closest = trimesh.triangles.closest_point(corners, points)  # type: ignore[no-untyped-call]
        distance = np.minimum(distance, np.linalg.norm(closest - points, axis=1))
    return distance
