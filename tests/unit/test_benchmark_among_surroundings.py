"""A ball above a floor: what is measured of the mesh is the ball alone."""

import numpy as np
import pytest
import trimesh

from backend.benchmark.among_surroundings import error_of_subject
from backend.maths.metrics import TrueSurface, surface_error
from backend.scene import SurfaceMesh

TOO_LARGE = 0.02
"""By how much the reconstructed ball's radius is off, in radii."""
DIAGONAL = 2 * np.sqrt(3.0)
"""Of the true ball's box."""
CHANCE = {"cameras": (), "seed": 0, "num_samples": 20_000}


def ball(radius: float) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(4, radius)


def floor() -> trimesh.Trimesh:
    """Ten wide, its top half a radius below the ball."""
    plate = trimesh.creation.box((10.0, 10.0, 0.2))
    for _ in range(4):
        plate = plate.subdivide()
    plate.apply_translation((0.0, 0.0, -1.6))
    return plate


def truth(shape: trimesh.Trimesh) -> TrueSurface:
    return TrueSurface(vertices=np.asarray(shape.vertices), faces=np.asarray(shape.faces, np.int64))


def mesh(*shapes: trimesh.Trimesh) -> SurfaceMesh:
    joined = trimesh.util.concatenate(shapes)
    count = len(joined.vertices)
    return SurfaceMesh(
        vertices=np.asarray(joined.vertices),
        faces=np.asarray(joined.faces, np.int64),
        normals=np.asarray(joined.vertex_normals, np.float32),
        colours_srgb=np.zeros((count, 3), np.uint8),
        support=np.ones(count, np.float32),
    )


def test_what_lies_nearer_to_the_surroundings_is_not_an_error() -> None:
    found = mesh(ball(1 + TOO_LARGE), floor())
    error = error_of_subject(found, truth(ball(1.0)), truth(floor()), **CHANCE)
    alone = surface_error(mesh(ball(1 + TOO_LARGE)), truth(ball(1.0)), **CHANCE)
    assert error is not None
    assert error.whole.chamfer_percent == pytest.approx(alone.whole.chamfer_percent, rel=0.02)
    assert error.whole.accuracy_percent == pytest.approx(100 * TOO_LARGE / DIAGONAL, rel=0.25)  # samples
    with_floor = surface_error(found, truth(ball(1.0)), **CHANCE)
    assert with_floor.whole.accuracy_percent > 20 * error.whole.accuracy_percent


def test_surface_that_is_nowhere_near_the_subject_is_no_error_at_all() -> None:
    assert error_of_subject(mesh(floor()), truth(ball(1.0)), truth(floor()), **CHANCE) is None
