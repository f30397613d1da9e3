"""Projection of world points: against the analytic camera, torch's projection, and at the picture's edges."""

import numpy as np
import torch

from backend.maths.geometry import pinhole_in_object, project
from backend.maths.projection import in_picture, projected
from backend.scene import Camera, Region, to_unit_sphere


def camera_beside(angle: float) -> Camera:
    """Four units from the origin, turned about y by an angle in radians."""
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = [
        [np.cos(angle), 0, -np.sin(angle)],
        [0, 1, 0],
        [np.sin(angle), 0, np.cos(angle)],
    ]
    camera_from_world[2, 3] = 4.0
    return Camera(
        camera_from_world=camera_from_world,
        fx_px=80.0,
        fy_px=70.0,
        cx_px=33.0,
        cy_px=25.0,
        width=64,
        height=48,
    )


def through(camera: Camera, pixels: np.ndarray, depth: float) -> np.ndarray:
    """World points at pixels and a depth."""
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], 1) @ np.linalg.inv(camera.intrinsics).T
    world_from_camera = np.linalg.inv(camera.camera_from_world)
    points: np.ndarray = depth * rays @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]
    return points


def test_points_made_from_pixels_come_back_to_them() -> None:
    camera = camera_beside(0.7)
    pixels = np.random.default_rng(0).uniform(-20, 80, (50, 2))
    back, depth = projected(through(camera, pixels, 2.5), camera)
    np.testing.assert_allclose(back, pixels, atol=1e-10)
    np.testing.assert_allclose(depth, 2.5, rtol=1e-12)


def test_it_agrees_with_the_projection_of_fitting() -> None:
    camera = camera_beside(-0.4)
    region = Region(object_from_world=to_unit_sphere(np.array([0.2, -0.1, 0.3]), 1.5))
    points = np.random.default_rng(1).normal(size=(50, 3)).clip(-1, 1)
    in_object = torch.tensor((points - [0.2, -0.1, 0.3]) / 1.5, dtype=torch.float64)
    pinhole = pinhole_in_object(camera, region, torch.device("cpu"))
    pixels, depth = projected(points, camera)
    other, other_depth = project(pinhole, in_object.float())
    np.testing.assert_allclose(pixels, other, atol=1e-3)
    np.testing.assert_allclose(depth, 1.5 * other_depth, rtol=1e-5)


def test_in_picture_ends_at_the_pixels_outer_edges() -> None:
    camera = camera_beside(0.3)
    edges = np.array(
        [[-0.01, 5], [0.01, 5], [63.99, 5], [64.01, 5], [5, -0.01], [5, 0.01], [5, 47.99], [5, 48.01]]
    )
    points = through(camera, edges, 3.0)
    assert in_picture(points, camera).tolist() == [False, True, True, False, False, True, True, False]
    assert not in_picture(2 * camera.position - points, camera).any()


def test_points_in_the_camera_or_behind_it_are_no_division_by_zero() -> None:
    camera = camera_beside(0.0)
    points = np.stack([camera.position, camera.position - [0, 0, 1.0]])
    pixels, depth = projected(points, camera)
    assert np.isfinite(pixels).all()
    assert (depth <= 0).all()
    assert not in_picture(points, camera).any()
