"""Shifts of patches against shifts that were put in, and epipolar lines against points that are known."""

import numpy as np
import pytest
import torch
from torch import Tensor

from backend.maths.geometry import pinhole_in_object, project
from backend.maths.patch_alignment import align, beside_epipolar_lines_px, on_planes, patch_pixels
from backend.scene import Camera
from tests.synthetic_scene import arc_cameras, surface_points, true_region

SHIFTS_PX = torch.tensor([[0.0, 0.0], [0.37, -0.21], [-1.4, 0.8], [2.3, 2.6]])
CENTRES = torch.tensor([[20.3, 18.0], [30.0, 33.4], [24.1, 24.9], [35.5, 28.2]])


def waves(places: Tensor) -> Tensor:
    """A texture that is known everywhere: waves of 11 to 25 pixels."""
    x, y = places[..., 0], places[..., 1]
    return (0.45 * x + 0.2 * y).sin() + (0.1 * x - 0.5 * y + 1).sin() + (0.3 * x + 0.35 * y + 2).cos()


def picture(size: int = 56) -> Tensor:
    rows, columns = torch.meshgrid(torch.arange(size) + 0.5, torch.arange(size) + 0.5, indexing="ij")
    return waves(torch.stack([columns, rows], dim=-1))


def test_shifts_are_found_whatever_the_exposure() -> None:
    places = patch_pixels(CENTRES, 5)
    reference = 0.4 * waves(places + SHIFTS_PX[:, None]) - 3.0
    found = align(reference, picture(), places, rounds=8, reach_px=4.0)
    torch.testing.assert_close(found.shift_px, SHIFTS_PX, rtol=0, atol=0.02)
    assert (found.correlation > 0.999).all()
    assert (found.sigma_px < 0.02).all()


def test_no_shift_is_longer_than_the_reach() -> None:
    places = patch_pixels(CENTRES, 5)
    found = align(waves(places + 3.0), picture(), places, rounds=8, reach_px=1.5)
    assert (found.shift_px.abs() <= 1.5).all()
    assert found.shift_px.abs().amax() == 1.5


def test_along_an_edge_nothing_is_sure() -> None:
    """Stripes tell one direction alone, a grey patch none."""
    random = torch.Generator().manual_seed(0)
    noise = 0.01 * torch.randn(56, 56, generator=random)
    stripes = (0.5 * (torch.arange(56) + 0.5)).sin().expand(56, 56)
    places = patch_pixels(CENTRES[:1], 5)
    for image, reference in (
        (stripes, (0.5 * places[..., 0]).sin()),
        (torch.full((56, 56), 0.5), torch.full(places.shape[:2], 0.5)),
    ):
        found = align(reference + 0.01, image + noise, places, rounds=8, reach_px=4.0)
        assert torch.isfinite(found.shift_px).all()
        assert (found.sigma_px > 0.1).all()


def test_patches_lie_on_their_planes_and_on_their_rays() -> None:
    camera = pinhole_in_object(arc_cameras(1, 0, 160)[0], true_region(), torch.device("cpu"))
    positions = torch.tensor([[0.1, -0.3, 0.2], [-0.2, -0.1, 0.0]])
    normals = torch.nn.functional.normalize(torch.tensor([[0.2, -1.0, 0.3], [0.5, -0.8, 0.1]]), dim=-1)
    square = patch_pixels(project(camera, positions)[0], 3)
    surface = on_planes(camera, square, positions, normals)
    heights = ((surface - positions[:, None]) * normals[:, None]).sum(dim=-1)
    torch.testing.assert_close(heights, torch.zeros_like(heights), rtol=0, atol=1e-5)
    torch.testing.assert_close(project(camera, surface)[0], square, rtol=0, atol=1e-3)
    middle = square.shape[1] // 2
    torch.testing.assert_close(surface[:, middle], positions, rtol=0, atol=1e-5)


def seen_from(camera: Camera, points: np.ndarray) -> np.ndarray:
    homogeneous = (points @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]) @ (
        camera.intrinsics.T
    )
    return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:])


@pytest.mark.parametrize("off_px", [0.0, 0.5, -2.0])
def test_distances_from_epipolar_lines(off_px: float) -> None:
    """Points lie on their lines wherever on their rays they are, and as far off as they are moved across."""
    a, b = arc_cameras(2, 20, 160)
    random = np.random.default_rng(0).normal(size=(50, 3))
    points = surface_points(random / np.linalg.norm(random, axis=1, keepdims=True))
    pixels, seen_at = seen_from(a, points), seen_from(b, points)
    nearer = seen_from(b, a.position + 0.9 * (points - a.position))
    along = (nearer - seen_at) / np.linalg.norm(nearer - seen_at, axis=1, keepdims=True)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    for places in (seen_at, nearer):
        found = beside_epipolar_lines_px(a, b, pixels, places + off_px * across)
        np.testing.assert_allclose(np.abs(found), abs(off_px), atol=1e-8)
