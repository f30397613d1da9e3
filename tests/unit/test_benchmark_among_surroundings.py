"""A ball above a floor: what is measured of the mesh is the ball alone."""

import numpy as np
import pytest
import trimesh

from backend.benchmark.among_surroundings import error_of_subject
from backend.maths.metrics import TrueSurface, surface_error
from backend.scene import Camera, SurfaceMesh

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


def test_what_stands_on_a_large_floor_has_no_ring_of_it() -> None:
    """A box on a floor a hundred times as wide, whose samples are farther apart than the box is wide."""
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    plate = trimesh.creation.box((100.0, 100.0, 0.2))
    plate.apply_translation((0.0, 0.0, -0.6))
    around = trimesh.creation.annulus(1.2, 3.0, 0.1)
    around.apply_translation((0.0, 0.0, -0.55))  # its top is the floor's
    for _ in range(3):
        around = around.subdivide()
    error = error_of_subject(mesh(box, around), truth(box), truth(plate), **CHANCE)
    alone = surface_error(mesh(box), truth(box), **CHANCE)
    assert error is not None
    assert error.whole.accuracy_percent == pytest.approx(alone.whole.accuracy_percent, rel=0.05)


def from_above(height: float) -> Camera:
    """At (0, 0, height), looking down; sees 45 degrees to every side."""
    down = np.diag([1.0, -1.0, -1.0, 1.0])
    down[2, 3] = height
    return Camera(
        camera_from_world=down, fx_px=100.0, fy_px=100.0, cx_px=100.0, cy_px=100.0, width=200, height=200
    )


def test_what_surroundings_hide_is_not_visible() -> None:
    """A strip above the ball hides a part of it from the camera, of the mesh as of the truth."""
    strip = trimesh.creation.box((0.6, 4.0, 0.1))
    strip.apply_translation((0.0, 0.0, 2.0))
    chance = {**CHANCE, "cameras": (from_above(6.0),)}
    error = error_of_subject(mesh(ball(1.0), strip), truth(ball(1.0)), truth(strip), **chance)
    free = surface_error(mesh(ball(1.0)), truth(ball(1.0)), **chance)
    assert error is not None
    shares = error.visible_share_of_mesh, error.visible_share_of_truth
    assert free.visible_share_of_mesh is not None
    assert shares == pytest.approx((0.6 * free.visible_share_of_mesh,) * 2, rel=0.3)
    assert shares[0] == pytest.approx(shares[1], abs=0.02)
