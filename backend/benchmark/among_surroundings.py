"""The error of a subject among other things, which its photographs show and its true mesh lacks."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from ..maths.metrics import ErrorAgainstTruth, TrueSurface, surface_error, vertex_error_percent
from ..scene import Camera, SurfaceMesh


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

    All are in one frame. None where no face of the mesh does.
    """

    def distance_from(truth: TrueSurface) -> Float64[np.ndarray, "vertices"]:
        percent = vertex_error_percent(mesh, truth, seed=seed, num_samples=num_samples)
        return percent.astype(np.float64) * truth.diagonal

    of_subject = distance_from(subject) < distance_from(surroundings)
    faces = mesh.faces[of_subject[mesh.faces].all(axis=1)]
    if not len(faces):
        return None
    part = replace(mesh, faces=faces)
    return surface_error(part, subject, cameras=cameras, seed=seed, num_samples=num_samples)
