"""Projection and its inverse, warps between views, and the pixel convention of sampling."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from backend.maths.geometry import (
    Pinhole,
    epipolar_map,
    inside,
    match_speed_px,
    pinhole_in_object,
    pixel_centres,
    project,
    ray_directions,
    sample_image,
    unproject,
    warp_pixels,
)
from backend.scene import Camera, Region, transform_points

CPU = torch.device("cpu")


def pinhole(rotation_deg: tuple[float, float, float], translation: tuple[float, float, float]) -> Pinhole:
    """A skewless camera of 40 x 30 pixels in float64, its axes unequal and its middle off centre."""
    camera_from_object = torch.eye(4, dtype=torch.float64)
    camera_from_object[:3, :3] = torch.tensor(
        Rotation.from_euler("xyz", rotation_deg, degrees=True).as_matrix()
    )
    camera_from_object[:3, 3] = torch.tensor(translation)
    intrinsics = torch.tensor([[50, 0, 19], [0, 45, 16], [0, 0, 1]], dtype=torch.float64)
    return Pinhole(intrinsics=intrinsics, camera_from_object=camera_from_object, width=40, height=30)


LEFT, RIGHT = pinhole((5, -10, 3), (0.1, -0.2, 3.0)), pinhole((-8, 12, -4), (-0.3, 0.1, 2.8))


def ball_points(num: int) -> Tensor:
    """Points within the unit cube, all before the cameras."""
    generator = torch.Generator().manual_seed(0)
    return torch.rand(num, 3, generator=generator, dtype=torch.float64) * 2 - 1


def test_unproject_is_the_inverse_of_project() -> None:
    points = ball_points(100)
    pixel, depth = project(LEFT, points)
    torch.testing.assert_close(unproject(LEFT, pixel, depth), points)


def test_project_is_the_inverse_of_unproject() -> None:
    pixels = pixel_centres(LEFT.width, LEFT.height, CPU).double()
    depth = 1 + pixels.sum(dim=-1) / 70
    again, again_depth = project(LEFT, unproject(LEFT, pixels, depth))
    torch.testing.assert_close(again, pixels)
    torch.testing.assert_close(again_depth, depth)


def test_rays_start_at_the_camera_and_have_unit_depth() -> None:
    origin = torch.cat([LEFT.position, torch.ones(1, dtype=torch.float64)])
    torch.testing.assert_close((LEFT.camera_from_object @ origin)[:3], torch.zeros(3, dtype=torch.float64))
    directions = ray_directions(LEFT, ball_points(10)[:, :2] * 20)
    forward = LEFT.camera_from_object[2, :3]
    torch.testing.assert_close(directions @ forward, torch.ones(10, dtype=torch.float64))


def test_points_behind_or_in_the_camera_give_finite_pixels_and_gradients() -> None:
    facing = pinhole((0, 0, 0), (0.0, 0.0, 3.0))
    points = torch.tensor([[0.0, 0, -3], [0.5, 0.2, -3], [0, 0, -1e4]], dtype=torch.float64).requires_grad_()
    pixel, depth = project(facing, points)
    assert depth[:2].tolist() == [0.0, 0.0]
    (gradient,) = torch.autograd.grad(pixel.sum() + depth.sum(), points)
    assert pixel.isfinite().all()
    assert gradient.isfinite().all()


def test_gradients_of_projection_agree_with_finite_differences() -> None:
    assert torch.autograd.gradcheck(lambda x: project(LEFT, x), ball_points(4).requires_grad_())


def test_the_camera_in_the_object_frame_sees_the_same_pixels() -> None:
    """Against K X of the record in float64; depths change by the region's scale."""
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = Rotation.from_euler("xyz", [20, 30, -40], degrees=True).as_matrix()
    camera_from_world[:3, 3] = [0.5, -1.0, 12.0]
    camera = Camera(
        camera_from_world=camera_from_world,
        fx_px=90.0,
        fy_px=80.0,
        cx_px=31.0,
        cy_px=23.0,
        width=64,
        height=48,
    )
    object_from_world = np.eye(4)
    object_from_world[:3, :3] = 0.4 * Rotation.from_euler("xyz", [50, -70, 10], degrees=True).as_matrix()
    object_from_world[:3, 3] = [0.1, 0.2, -0.3]
    region = Region(object_from_world=object_from_world)
    moved = pinhole_in_object(camera, region, CPU)

    in_object = ball_points(20)
    in_camera = transform_points(
        camera_from_world @ region.world_from_object, in_object.numpy().astype(np.float64)
    )
    homogeneous = in_camera @ camera.intrinsics.T
    pixel, depth = project(moved, in_object.float())
    torch.testing.assert_close(
        pixel, torch.tensor(homogeneous[:, :2] / homogeneous[:, 2:]).float(), atol=1e-3, rtol=0
    )
    torch.testing.assert_close(depth * region.radius_world, torch.tensor(in_camera[:, 2]).float())
    rotation = moved.camera_from_object[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3))
    position = transform_points(object_from_world, camera.position[None])[0]
    torch.testing.assert_close(moved.position, torch.tensor(position).float())
    np.testing.assert_array_equal(camera.camera_from_world, camera_from_world)


def test_a_scaled_camera_scales_pixels() -> None:
    pixel, depth = project(LEFT, ball_points(10))
    half, same_depth = project(LEFT.scaled(20, 10), ball_points(10))
    torch.testing.assert_close(half, pixel * torch.tensor([20 / 40, 10 / 30], dtype=torch.float64))
    torch.testing.assert_close(same_depth, depth)


def test_a_cropped_camera_shifts_pixels() -> None:
    pixel, _ = project(LEFT, ball_points(10))
    window = LEFT.cropped(7, 4, 12, 9)
    torch.testing.assert_close(
        project(window, ball_points(10))[0], pixel - torch.tensor([7, 4], dtype=torch.float64)
    )
    assert (window.width, window.height) == (12, 9)


def test_pixel_centres_are_column_and_row_plus_a_half() -> None:
    pixels = pixel_centres(4, 3, CPU)
    assert pixels.shape == (3, 4, 2)
    assert pixels[0, 0].tolist() == [0.5, 0.5]
    assert pixels[2, 1].tolist() == [1.5, 2.5]


def test_warping_equals_unprojecting_and_projecting() -> None:
    pixels = pixel_centres(LEFT.width, LEFT.height, CPU).double()
    inverse_depth = 1 / torch.stack([2.0 + pixels[..., 0] / 20, 4.0 - pixels[..., 1] / 30])
    a, b = epipolar_map(RIGHT, LEFT)
    expected, depth = project(RIGHT, unproject(LEFT, pixels.expand(2, -1, -1, -1), 1 / inverse_depth))
    assert (depth > 0).all()
    torch.testing.assert_close(warp_pixels(a, b, pixels, inverse_depth), expected)


def test_the_speed_of_a_match_is_the_derivative_of_its_place() -> None:
    pixels = pixel_centres(LEFT.width, LEFT.height, CPU).double()
    inverse_depth, step = 1 / (2.0 + pixels[..., 0] / 20), 1e-6
    a, b = epipolar_map(RIGHT, LEFT)
    before, after = warp_pixels(a, b, pixels, torch.stack([inverse_depth - step, inverse_depth + step]))
    expected = (after - before).norm(dim=-1) / (2 * step)
    torch.testing.assert_close(match_speed_px(a, b, pixels, inverse_depth), expected)


def test_a_view_into_itself_is_the_identity() -> None:
    pixels = pixel_centres(LEFT.width, LEFT.height, CPU).double()
    a, b = epipolar_map(LEFT, LEFT)
    inverse_depth = torch.full((1, LEFT.height, LEFT.width), 0.3, dtype=torch.float64)
    torch.testing.assert_close(warp_pixels(a, b, pixels, inverse_depth)[0], pixels)


def test_what_lies_behind_the_source_lands_outside_its_image() -> None:
    behind = pinhole((0, 180, 0), (0.1, 0.0, -6.0))
    facing = pinhole((0, 0, 0), (0.0, 0.0, 3.0))
    pixels = pixel_centres(40, 30, CPU).double()
    inverse_depth = torch.full((1, 30, 40), 0.3, dtype=torch.float64)
    _, depth = project(behind, unproject(facing, pixels, 1 / inverse_depth[0]))
    assert (depth < 0).all()
    where = warp_pixels(*epipolar_map(behind, facing), pixels, inverse_depth)
    assert where.isfinite().all()
    assert not inside(where, 40, 30).any()


def test_the_image_holds_its_first_edge_and_not_its_last() -> None:
    pixels = torch.tensor([[0.0, 0.0], [4.0, 1.0], [1.0, 3.0], [3.9, 2.9], [-0.1, 1.0], [1.0, torch.nan]])
    assert inside(pixels, 4, 3).tolist() == [True, False, False, True, False, False]


@pytest.mark.parametrize("mode", ["bilinear", "nearest"])
def test_sampling_at_pixel_centres_gives_the_image(mode: str) -> None:
    image = torch.randn(2, 25, 37, generator=torch.Generator().manual_seed(0))
    sampled = sample_image(image, pixel_centres(37, 25, CPU).expand(3, -1, -1, -1), mode)
    torch.testing.assert_close(sampled, image.expand(3, -1, -1, -1), atol=1e-4, rtol=0)


def test_sampling_a_linear_image_is_exact_between_pixels() -> None:
    pixels = pixel_centres(9, 6, CPU)
    image = (2 * pixels[..., 0] - 3 * pixels[..., 1])[None]
    where = torch.tensor([[[[3.2, 2.7], [0.5, 5.5], [8.1, 1.0]]]])
    expected = 2 * where[..., 0] - 3 * where[..., 1]
    torch.testing.assert_close(sample_image(image, where)[:, 0], expected)


def test_sampling_outside_gives_the_border() -> None:
    image = torch.arange(12.0).reshape(1, 3, 4)
    where = torch.tensor([[[[-1e9, 0.5], [1e9, 1e9], [1.5, -3.0]]]])
    torch.testing.assert_close(sample_image(image, where)[0, 0, 0], torch.tensor([0.0, 11.0, 1.0]))
