"""Laws of camera placement: poses are rigid, spacing is even, and nothing leaves the picture."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from addon.view_layout import (
    Array,
    LayoutKind,
    Lens,
    ViewLayout,
    directions_deg,
    framing_distance,
    place_cameras,
    unit_vectors,
    world_from_camera_looking_at,
)

LENS = Lens(width=800, height=600, focal_px=1111.0)
PORTRAIT = Lens(width=300, height=500, focal_px=420.0)
KINDS = tuple(LayoutKind)


def layout(kind: LayoutKind, **changes: Any) -> ViewLayout:
    return replace(ViewLayout(kind=kind, num_views=7), **changes)


def some_points(seed: int = 0) -> Array:
    """An uneven cloud far from the origin."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(200, 3)) * (1.5, 0.4, 0.9) + (10.0, -4.0, 3.0)


def pixels(points: Array, pose: Array, lens: Lens) -> Array:
    """(points, 2) column and row, by the definition of a pinhole; every point must be in front."""
    in_camera = np.array([np.linalg.inv(pose) @ np.append(point, 1.0) for point in points])[:, :3]
    assert (in_camera[:, 2] < 0).all()
    columns = lens.width / 2 + lens.focal_px * in_camera[:, 0] / -in_camera[:, 2]
    rows = lens.height / 2 - lens.focal_px * in_camera[:, 1] / -in_camera[:, 2]
    return np.stack([columns, rows], axis=-1)


def angle_deg(a: Array, b: Array) -> float:
    return float(np.rad2deg(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b))))


@pytest.mark.parametrize("roll_deg", [0.0, 7.0, -90.0])
def test_looking_at_is_a_rigid_motion_that_centres_the_target(roll_deg: float) -> None:
    rng = np.random.default_rng(1)
    for position, target in rng.normal(size=(50, 2, 3)):
        pose = world_from_camera_looking_at(position, target, roll_deg=roll_deg)
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
        distance = float(np.linalg.norm(position - target))
        np.testing.assert_allclose(
            np.linalg.inv(pose) @ np.append(target, 1.0), [0.0, 0.0, -distance, 1.0], atol=1e-12
        )


def test_without_roll_the_horizon_is_level_and_up_is_up() -> None:
    pose = world_from_camera_looking_at(np.array([3.0, -2.0, 1.0]), np.zeros(3))
    assert pose[2, 0] == pytest.approx(0.0)
    assert pose[2, 1] > 0.9


def test_roll_turns_counter_clockwise_about_the_backward_axis() -> None:
    position, target = np.array([0.0, -5.0, 0.0]), np.zeros(3)
    pose = world_from_camera_looking_at(position, target, roll_deg=90.0)
    np.testing.assert_allclose(pose[:3, 0], [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(pose[:3, 1], [-1.0, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("offset", [(0.0, 0.0, 2.0), (0.0, 0.0, 0.0)])
def test_a_vertical_or_empty_view_is_refused(offset: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="vertical or empty"):
        world_from_camera_looking_at(np.array(offset), np.zeros(3))


def test_directions_have_their_documented_meaning() -> None:
    directions = np.array([[0.0, 0.0], [90.0, 0.0], [0.0, 90.0], [180.0, 0.0]])
    expected = [[0, -1, 0], [1, 0, 0], [0, 0, 1], [0, 1, 0]]
    np.testing.assert_allclose(unit_vectors(directions), expected, atol=1e-12)


@pytest.mark.parametrize("num_views", [1, 2, 5, 12])
def test_a_ring_closes_with_equal_steps(num_views: int) -> None:
    azimuth, elevation = directions_deg(layout(LayoutKind.RING, num_views=num_views)).T
    steps = np.diff([*azimuth, azimuth[0] + 360.0])
    np.testing.assert_allclose(steps, 360.0 / num_views)
    np.testing.assert_allclose(elevation, 20.0)


def test_an_arc_spans_its_angle_evenly_about_its_middle() -> None:
    azimuth = directions_deg(layout(LayoutKind.ARC, num_views=5, arc_deg=80.0, azimuth_deg=30.0))[:, 0]
    np.testing.assert_allclose(azimuth, [-10.0, 10.0, 30.0, 50.0, 70.0])


def test_an_arc_of_one_view_is_its_middle() -> None:
    azimuth = directions_deg(layout(LayoutKind.ARC, num_views=1, azimuth_deg=30.0))[:, 0]
    np.testing.assert_allclose(azimuth, [30.0])


def test_a_hemisphere_is_covered_evenly() -> None:
    """No two views crowd: the nearest are at least half as far apart as equal areas would put them."""
    directions = directions_deg(layout(LayoutKind.HEMISPHERE, num_views=40))
    assert directions[:, 1].min() > 10.0
    assert directions[:, 1].max() < 75.0
    units = unit_vectors(directions)
    nearest = min(angle_deg(a, b) for i, a in enumerate(units) for b in units[:i])
    area_each = 2 * np.pi * (np.sin(np.deg2rad(75)) - np.sin(np.deg2rad(10))) / 40
    assert nearest > 0.5 * np.rad2deg(np.sqrt(area_each))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("lens", [LENS, PORTRAIT])
@pytest.mark.parametrize("seed", range(5))
def test_every_view_holds_the_whole_object(kind: LayoutKind, lens: Lens, seed: int) -> None:
    points = some_points(seed)
    for pose in place_cameras(layout(kind, seed=seed), lens, points=points):
        share = pixels(points, pose, lens) / (lens.width, lens.height)
        assert (share > 0.04 - 1e-9).all()
        assert (share < 0.96 + 1e-9).all()


@pytest.mark.parametrize("kind", KINDS)
def test_the_object_fills_the_picture_up_to_the_margin(kind: LayoutKind) -> None:
    points = some_points()
    poses = place_cameras(layout(kind, jitter=0.0), LENS, points=points)
    shares = np.array([pixels(points, pose, LENS) / (LENS.width, LENS.height) for pose in poses])
    assert min(shares.min(), 1.0 - shares.max()) == pytest.approx(0.04, abs=1e-9)


def test_a_sphere_is_framed_from_the_distance_of_its_tangent_cone() -> None:
    directions = np.stack(np.meshgrid(np.linspace(0, 360, 721), np.linspace(-90, 90, 361)), axis=-1).reshape(
        -1, 2
    )
    sphere = 0.7 * unit_vectors(directions)
    rotation = world_from_camera_looking_at(np.array([0.0, -1.0, 0.0]), np.zeros(3))[:3, :3]
    expected = 0.7 / np.sin(np.arctan(0.5 * LENS.height / LENS.focal_px))
    assert framing_distance(sphere, rotation, LENS, margin=0.0) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_the_seed_decides_the_jitter_and_nothing_else(kind: LayoutKind) -> None:
    points = some_points()
    first = place_cameras(layout(kind, seed=3), LENS, points=points)
    np.testing.assert_array_equal(first, place_cameras(layout(kind, seed=3), LENS, points=points))
    assert not np.allclose(first, place_cameras(layout(kind, seed=4), LENS, points=points))
    still = [place_cameras(layout(kind, seed=seed, jitter=0.0), LENS, points=points) for seed in (3, 4)]
    np.testing.assert_array_equal(still[0], still[1])


@pytest.mark.parametrize("kind", KINDS)
def test_cameras_look_at_the_middle_of_the_bounding_box(kind: LayoutKind) -> None:
    points = some_points()
    middle = (points.min(axis=0, keepdims=True) + points.max(axis=0, keepdims=True)) / 2
    for pose in place_cameras(layout(kind), LENS, points=points):
        np.testing.assert_allclose(pixels(middle, pose, LENS), [[400.0, 300.0]], atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_a_given_distance_is_kept(kind: LayoutKind) -> None:
    points = some_points()
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    exact = place_cameras(layout(kind, jitter=0.0), LENS, points=points, distance=3.0)
    np.testing.assert_allclose(np.linalg.norm(exact[:, :3, 3] - centre, axis=1), 3.0)
    shaken = place_cameras(layout(kind), LENS, points=points, distance=3.0)
    distances = np.linalg.norm(shaken[:, :3, 3] - centre, axis=1)
    assert (distances >= 3.0 - 1e-9).all()
    assert (distances <= 3.0 * 1.06 + 1e-9).all()


@pytest.mark.parametrize("kind", KINDS)
def test_jitter_stays_small(kind: LayoutKind) -> None:
    points, centre = some_points(), (some_points().min(axis=0) + some_points().max(axis=0)) / 2
    exact = place_cameras(layout(kind, jitter=0.0), LENS, points=points)[:, :3, 3] - centre
    for seed in range(10):
        shaken = place_cameras(layout(kind, seed=seed), LENS, points=points)[:, :3, 3] - centre
        turns = [angle_deg(a, b) for a, b in zip(exact, shaken, strict=True)]
        assert 0.1 < max(turns) < 8.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_views": 0}, "num_views"),
        ({"arc_deg": 0.0}, "arc_deg"),
        ({"arc_deg": 360.0}, "arc_deg"),
        ({"elevation_deg": 86.0}, "elevation_deg"),
        ({"jitter": 1.5}, "jitter"),
    ],
)
def test_layouts_that_make_no_sense_are_refused(changes: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        layout(LayoutKind.ARC, **changes)
