"""Planes in maps of inverse depth, their normals, holes filled, and costs refined between planes."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from backend.kernels import side_by_side
from backend.maths.geometry import Pinhole, pixel_centres, ray_directions
from backend.maths.inverse_depth import (
    distance_from_edges_px,
    fit_planes,
    lowest_with_neighbours,
    normals_from_planes,
    parabola_offset,
    piece_sizes,
    planes_in_torch,
)

CPU = torch.device("cpu")
PRIOR_PX2 = 1e-2
"""Variance of pixels, in square pixels, that the fit adds so that lonely pixels have a slope at all."""


def plane_map(height: int = 16, width: int = 20) -> Tensor:
    """An inverse depth that is affine in the pixel, with slopes 0.004 in u and -0.003 in v."""
    u, v = pixel_centres(width, height, CPU).unbind(-1)
    return 0.5 + 0.004 * u - 0.003 * v


def random_weight(height: int = 16, width: int = 20) -> Tensor:
    return torch.rand(height, width, generator=torch.Generator().manual_seed(0))


def fit_one_by_one(values: Tensor, weight: Tensor, radius: int) -> Tensor:
    """Ridge regression in numpy, window by window."""
    result = np.zeros((3, *values.shape))
    for row, column in np.ndindex(*values.shape):
        rows = slice(max(row - radius, 0), row + radius + 1)
        columns = slice(max(column - radius, 0), column + radius + 1)
        share = weight[rows, columns].double().numpy()
        share = share / share.sum()
        v, u = np.mgrid[rows, columns][:, : share.shape[0], : share.shape[1]].astype(float)
        w = values[rows, columns].double().numpy()
        middle = [(share * x).sum() for x in (u, v, w)]
        away = np.stack([u - middle[0], v - middle[1]], axis=-1).reshape(-1, 2)
        scatter = away.T @ (share.reshape(-1, 1) * away) + PRIOR_PX2 * np.eye(2)
        slope = np.linalg.solve(scatter, away.T @ (share * (w - middle[2])).ravel())
        at_pixel = middle[2] + slope @ [column - middle[0], row - middle[1]]
        result[:, row, column] = at_pixel, *slope
    return torch.tensor(result).float()


def test_fit_matches_regression_window_by_window() -> None:
    values = plane_map() + 0.1 * random_weight().flip(0)
    torch.testing.assert_close(
        fit_planes(values, random_weight(), 2), fit_one_by_one(values, random_weight(), 2), atol=1e-5, rtol=0
    )


@pytest.mark.parametrize("radius", [1, 2, 3, 5])
@pytest.mark.parametrize("threads", [1, 3])
def test_compiled_as_in_torch(radius: int, threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bands of rows on threads of their own, the last one shorter, are the reference's planes."""
    monkeypatch.setattr(side_by_side, "BAND", 5)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    values, weight = plane_map() + 0.1 * random_weight().flip(0), random_weight()
    weight[:6, :7] = 0
    usual = (weight * values).sum() / weight.sum()
    reference = planes_in_torch(weight, weight * (values - usual), usual, radius)
    torch.testing.assert_close(fit_planes(values, weight, radius), reference, atol=3e-5, rtol=0)


@pytest.mark.parametrize("radius", [2, 4])
@pytest.mark.parametrize("weighted", [False, True])
def test_a_plane_is_found_again_up_to_the_borders(radius: int, weighted: bool) -> None:
    """The slope up to the share that the prior takes, the value up to what this does at a border."""
    weight = random_weight() + 0.2 if weighted else torch.ones(16, 20)
    value, slope_u, slope_v = fit_planes(plane_map(), weight, radius)
    narrowest = 0.4 * (((radius + 1) ** 2 - 1) / 12)  # a corner's window, its weights uneven
    share = PRIOR_PX2 / narrowest
    torch.testing.assert_close(slope_u, torch.full_like(value, 0.004), atol=0.005 * share, rtol=0)
    torch.testing.assert_close(slope_v, torch.full_like(value, -0.003), atol=0.005 * share, rtol=0)
    torch.testing.assert_close(value, plane_map(), atol=0.01 * share * radius, rtol=0)
    if not weighted:
        inner = slice(radius, -radius)
        torch.testing.assert_close(
            value[inner, inner], plane_map()[inner, inner], atol=1e-6, rtol=0
        )  # there the prior changes nothing


def test_what_has_no_weight_has_no_say() -> None:
    weight = (random_weight() > 0.3).float()
    spoilt = torch.where(weight > 0, plane_map(), torch.nan)
    torch.testing.assert_close(fit_planes(spoilt, weight, 3), fit_planes(plane_map(), weight, 3))


def test_empty_and_lonely_windows_stay_finite() -> None:
    weight = torch.zeros(16, 20)
    weight[8, 9] = 1e-6
    planes = fit_planes(plane_map(), weight, 2)
    assert planes.isfinite().all()
    assert planes[0, 8, 9].item() == pytest.approx(plane_map()[8, 9].item(), rel=1e-2)
    torch.testing.assert_close(planes[1:, 8, 9], torch.zeros(2))


def tilted_camera() -> Pinhole:
    camera_from_object = torch.eye(4)
    camera_from_object[:3, :3] = torch.tensor(Rotation.from_rotvec([0.4, -0.7, 0.2]).as_matrix())
    camera_from_object[:3, 3] = torch.tensor([0.1, -0.2, 3.0])
    intrinsics = torch.tensor([[30.0, 0, 9], [0, 25, 7], [0, 0, 1]])
    return Pinhole(intrinsics=intrinsics, camera_from_object=camera_from_object, width=20, height=16)


def test_normals_of_a_tilted_plane_are_exact() -> None:
    """Inverse depth of n . X = distance, by cutting rays with it; its slopes by differences."""
    camera = tilted_camera()
    towards = camera.position / camera.position.norm()
    normal = torch.nn.functional.normalize(towards + torch.tensor([0.3, -0.2, 0.25]), dim=0)
    directions = ray_directions(camera, pixel_centres(20, 16, CPU))
    inverse = (directions @ normal) / (0.1 - camera.position @ normal)
    assert (inverse > 0).all()
    slope_u = (inverse[:, 1:] - inverse[:, :-1]).mean().expand(16, 20)
    slope_v = (inverse[1:] - inverse[:-1]).mean().expand(16, 20)
    found = normals_from_planes(torch.stack([inverse, slope_u, slope_v]), camera)
    torch.testing.assert_close(found, normal.expand(16, 20, 3), atol=2e-5, rtol=0)
    assert ((found * directions).sum(dim=-1) < 0).all()


def test_normals_from_a_fitted_map_are_those_of_the_plane() -> None:
    camera = tilted_camera()
    normal = camera.position / camera.position.norm()
    inverse = (ray_directions(camera, pixel_centres(20, 16, CPU)) @ normal) / -(camera.position @ normal)
    found = normals_from_planes(fit_planes(inverse, torch.ones(16, 20), 3), camera)
    assert (found @ normal).min() > 0.9995


def test_normals_where_nothing_is_known_are_finite() -> None:
    assert normals_from_planes(torch.zeros(3, 16, 20), tilted_camera()).isfinite().all()


def test_parabola_finds_the_lowest_place() -> None:
    lowest = torch.linspace(-0.49, 0.49, 11)
    before, best, after = (2.0 * (step - lowest) ** 2 + 1 for step in (-1, 0, 1))
    torch.testing.assert_close(parabola_offset(before, best, after), lowest, atol=1e-5, rtol=0)


def test_parabola_stays_within_half_a_step_and_finite() -> None:
    before, best, after = torch.tensor([[1.0, 5.0, 1.0, 0.0], [1.0, 4.9, 2.0, 0.0], [1.0, 0.0, 1.0, 1e-20]])
    offset = parabola_offset(before, best, after)
    torch.testing.assert_close(offset, torch.tensor([0.0, 0.0, 0.0, 0.0]))
    assert parabola_offset(torch.tensor(5.0), torch.tensor(1.0), torch.tensor(0.9)).item() == 0.5


def test_the_lowest_cost_and_its_offset() -> None:
    planes = torch.arange(8.0)
    lowest = torch.tensor([[2.3, 4.8], [0.2, 6.9], [-1.0, 9.0]])
    index, offset = lowest_with_neighbours((planes - lowest[..., None]) ** 2)
    assert index.tolist() == [[2, 5], [0, 7], [0, 7]]
    torch.testing.assert_close(offset[0], torch.tensor([0.3, -0.2]))
    assert (offset[1:] == 0).all()  # the first and the last plane have one neighbour


# pieces


def test_a_piece_ends_where_nothing_is_measured_and_where_depth_jumps() -> None:
    measured = np.ones((6, 10), bool)
    measured[:, 3] = False
    inverse_depth = np.ones((6, 10), np.float32)
    inverse_depth[:, 8:] = 1.05
    sizes = piece_sizes(measured, inverse_depth, largest_jump=0.01)
    np.testing.assert_array_equal(sizes[:, :3], 18)
    np.testing.assert_array_equal(sizes[:, 3], 1)
    np.testing.assert_array_equal(sizes[:, 4:8], 24)
    np.testing.assert_array_equal(sizes[:, 8:], 12)


def test_a_slope_is_one_piece() -> None:
    """Its ends are far apart, its neighbours are not."""
    slope = np.linspace(1, 2, 200, dtype=np.float32)[None].repeat(4, axis=0)
    assert (piece_sizes(np.ones_like(slope, bool), slope, largest_jump=0.01) == 800).all()


def test_corners_that_touch_are_not_connected() -> None:
    checkers = np.indices((4, 4)).sum(axis=0) % 2 == 0
    sizes = piece_sizes(checkers, np.ones((4, 4), np.float32), largest_jump=0.01)
    assert (sizes == 1).all()


# edges


def test_a_map_without_edges_is_far_from_them() -> None:
    smooth = plane_map()
    far = distance_from_edges_px(smooth, torch.ones(16, 20, dtype=torch.bool), torch.full_like(smooth, 0.01))
    assert (far >= 36).all()


def test_a_jump_is_an_edge_and_a_slope_is_none() -> None:
    """Both sides of the jump are beside it; columns count from there."""
    jumping = plane_map()
    jumping[:, 8:] += 0.02
    all_of_it = torch.ones(16, 20, dtype=torch.bool)
    for largest, edges in ((0.01, (7, 8)), (0.03, ())):
        apart = distance_from_edges_px(jumping, all_of_it, torch.full_like(jumping, largest))
        expected = [min((abs(column - edge) for edge in edges), default=36) for column in range(20)]
        np.testing.assert_allclose(apart, np.tile(expected, (16, 1)))


def test_the_smaller_of_two_steps_decides() -> None:
    jumping = plane_map()
    jumping[:, 8:] += 0.02
    largest = torch.full_like(jumping, 0.03)
    largest[:, 8:] = 0.01
    apart = distance_from_edges_px(jumping, torch.ones(16, 20, dtype=torch.bool), largest)
    assert (apart[:, 7:9] == 0).all()


def test_what_is_off_the_subject_is_an_edge() -> None:
    subject = torch.ones(16, 20, dtype=torch.bool)
    subject[4, 5] = False
    smooth = plane_map()
    apart = distance_from_edges_px(smooth, subject, torch.full_like(smooth, 0.01))
    rows, columns = np.indices((16, 20))
    np.testing.assert_allclose(apart, np.hypot(rows - 4, columns - 5), rtol=1e-6)
