"""Laws of placing: the same scene comes out upright however it was solved."""

from dataclasses import replace

import numpy as np
import pytest

from addon.placing import (
    Array,
    region_in_solved,
    similarity_between,
    solved_from_camera,
    sphere_around,
    upright_from_solved,
    weighted_quantile,
)
from addon.view_layout import (
    LayoutKind,
    ViewLayout,
    directions_deg,
    unit_vectors,
    world_from_camera_looking_at,
)
from backend.maths.upright import up_direction

CENTRE = np.array([0.3, -0.2, 0.9])
ARC = ViewLayout(kind=LayoutKind.ARC, num_views=6, arc_deg=120.0, elevation_deg=25.0, jitter=0.0)


def level_cameras(layout: ViewLayout, *, roll_deg: Array | None = None, distance: float = 3.0) -> Array:
    """(views, 4, 4): around CENTRE, in a world where z is up."""
    towards = unit_vectors(directions_deg(layout))
    rolls = np.zeros(layout.num_views) if roll_deg is None else roll_deg
    return np.stack(
        [
            world_from_camera_looking_at(CENTRE + distance * unit, CENTRE, roll_deg=roll)
            for unit, roll in zip(towards, rolls, strict=True)
        ]
    )


def up_of(poses: Array) -> Array:
    """(3,): of cameras with Blender's axes."""
    return up_direction(*np.moveaxis(poses[:, :3, :3], 2, 0))


def placed_upright(poses: Array, centre: Array, radius: float, *, points: Array | None = None) -> Array:
    return upright_from_solved(poses, centre, radius, up=up_of(poses), points=points)


def random_rotation(rng: np.random.Generator) -> Array:
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return rotation * np.sign(np.linalg.det(rotation))


def random_similarity(rng: np.random.Generator) -> Array:
    similarity = np.eye(4)
    similarity[:3, :3] = np.exp(rng.uniform(-3, 3)) * random_rotation(rng)
    similarity[:3, 3] = rng.normal(size=3) * 10
    return similarity


def solved(solved_from_world: Array, cameras: Array) -> tuple[Array, float]:
    """The cameras as a solver would give them (rigid), and the scale."""
    scale = float(np.cbrt(np.linalg.det(solved_from_world[:3, :3])))
    poses = solved_from_world @ cameras
    poses[:, :3, :3] /= scale
    return poses, scale


def angle_deg(a: Array, b: Array) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


LAYOUTS = {
    "arc": ARC,
    "narrow arc": replace(ARC, arc_deg=30.0, elevation_deg=40.0),
    "low arc": replace(ARC, elevation_deg=-20.0),
    "ring": replace(ARC, kind=LayoutKind.RING),
    "hemisphere": replace(ARC, kind=LayoutKind.HEMISPHERE, num_views=9),
    "from above": replace(ARC, kind=LayoutKind.RING, elevation_deg=84.0),
    "three": replace(ARC, num_views=3, arc_deg=60.0),
    "parallel": replace(ARC, num_views=3, arc_deg=1.0, elevation_deg=0.0),
}


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
@pytest.mark.parametrize("seed", range(5))
def test_level_cameras_come_out_level(layout: ViewLayout, seed: int) -> None:
    solved_from_world = random_similarity(np.random.default_rng(seed))
    cameras = level_cameras(layout)
    poses, scale = solved(solved_from_world, cameras)
    centre = solved_from_world[:3, :3] @ CENTRE + solved_from_world[:3, 3]
    upright = placed_upright(poses, centre, 0.7 * scale)

    upright_from_world = upright @ solved_from_world
    linear = upright_from_world[:3, :3] * 0.7
    tolerance = 2e-3 if layout is LAYOUTS["parallel"] else 1e-9  # one y axis's own elevation decides there
    np.testing.assert_allclose(linear @ linear.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(linear) == pytest.approx(1.0)
    np.testing.assert_allclose(linear @ [0, 0, 1], [0, 0, 1], atol=tolerance)
    np.testing.assert_allclose(upright_from_world @ [*CENTRE, 1.0], [0, 0, 1, 1], atol=1e-9)


@pytest.mark.parametrize("azimuth_deg", [0.0, 77.0, 200.0])
def test_the_mean_view_looks_along_y(azimuth_deg: float) -> None:
    cameras = level_cameras(replace(ARC, azimuth_deg=azimuth_deg))
    upright = placed_upright(cameras, CENTRE, 1.0)
    mean = -(upright[:3, :3] @ cameras[:, :3, 2].mean(axis=0))
    assert mean[0] == pytest.approx(0.0, abs=1e-9)
    assert mean[1] > 0.5


def test_the_placing_follows_the_solved_frame() -> None:
    rng = np.random.default_rng(3)
    poses = level_cameras(ARC, roll_deg=rng.normal(size=6))
    direct = placed_upright(poses, CENTRE, 0.5)
    for _ in range(5):
        solved_from_world = random_similarity(rng)
        moved, scale = solved(solved_from_world, poses)
        centre = solved_from_world[:3, :3] @ CENTRE + solved_from_world[:3, 3]
        again = placed_upright(moved, centre, 0.5 * scale)
        np.testing.assert_allclose(again @ solved_from_world, direct, atol=1e-8)


@pytest.mark.parametrize("rolled_deg", [90.0, -90.0, 180.0, 45.0])
@pytest.mark.parametrize("arc_deg", [15.0, 60.0, 120.0])
def test_one_camera_on_its_side_changes_nothing(rolled_deg: float, arc_deg: float) -> None:
    rolls = np.array([0.0, 0.0, rolled_deg, 0.0, 0.0, 0.0])
    layout = replace(ARC, arc_deg=arc_deg, elevation_deg=20.0)
    rolled = up_of(level_cameras(layout, roll_deg=rolls))
    others = up_of(np.delete(level_cameras(layout), 2, axis=0))
    assert angle_deg(rolled, others) < (2.5 if arc_deg < 30 else 0.5)


def test_a_hand_that_shakes_moves_up_little() -> None:
    rng = np.random.default_rng(0)
    errors = [
        angle_deg(up_of(level_cameras(ARC, roll_deg=rng.normal(scale=2.0, size=6))), np.array([0, 0, 1]))
        for _ in range(50)
    ]
    assert np.median(errors) < 2.0
    assert max(errors) < 6.0


def test_one_camera_alone_is_taken_as_level() -> None:
    (pose,) = level_cameras(replace(ARC, num_views=1, elevation_deg=0.0))
    np.testing.assert_allclose(up_of(pose[None]), [0, 0, 1], atol=2e-3)


def test_straight_down_is_from_above() -> None:
    poses = np.stack([np.eye(4)] * 4)
    for pose, turn in zip(poses, np.radians([0, 90, 180, 270]), strict=True):
        pose[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    np.testing.assert_allclose(up_of(poses), [0, 0, 1], atol=1e-9)
    assert np.isfinite(placed_upright(poses, np.zeros(3), 1.0)).all()


def test_the_lowest_points_stand_on_the_floor() -> None:
    rng = np.random.default_rng(0)
    points = CENTRE + rng.uniform(-0.5, 0.5, size=(5000, 3))
    far = CENTRE - [0, 0, 50.0] + rng.normal(size=(500, 3))
    upright = placed_upright(level_cameras(ARC), CENTRE, 1.0, points=np.concatenate([points, far]))
    heights = points @ upright[2, :3] + upright[2, 3]
    assert np.quantile(heights, 0.02) == pytest.approx(0.0, abs=1e-9)
    few = placed_upright(level_cameras(ARC), CENTRE, 1.0, points=points[:10])
    np.testing.assert_allclose(few, placed_upright(level_cameras(ARC), CENTRE, 1.0))


def test_unusable_cameras_are_refused() -> None:
    poses, up = level_cameras(ARC), np.array([0.0, 0.0, 1.0])
    with pytest.raises(ValueError, match="no usable cameras"):
        upright_from_solved(poses[:0], CENTRE, 1.0, up=up)
    with pytest.raises(ValueError, match="no usable cameras"):
        upright_from_solved(np.full((2, 4, 4), np.nan), CENTRE, 1.0, up=up)
    for radius in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="not usable"):
            upright_from_solved(poses, CENTRE, radius, up=up)


def placed_empty(rng: np.random.Generator, scale: tuple[float, float, float]) -> Array:
    world_from_empty = np.eye(4)
    world_from_empty[:3, :3] = random_rotation(rng) * scale
    world_from_empty[:3, 3] = rng.normal(size=3)
    return world_from_empty


@pytest.mark.parametrize("scale", [(1.0, 1.0, 1.0), (0.5, 2.0, 1.0), (-3.0, 0.1, 0.2)])
def test_the_region_holds_the_empty_s_sphere(scale: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(1)
    world_from_solved, world_from_empty = random_similarity(rng), placed_empty(rng, scale)
    centre, radius = region_in_solved(world_from_solved, world_from_empty, 0.7)
    factor = float(np.cbrt(np.linalg.det(world_from_solved[:3, :3])))
    assert radius * factor == pytest.approx(0.7 * max(map(abs, scale)))
    placed = world_from_solved[:3, :3] @ centre + world_from_solved[:3, 3]
    np.testing.assert_allclose(placed, world_from_empty[:3, 3])


def test_a_sheared_empty_is_held_whole() -> None:
    rng = np.random.default_rng(2)
    sheared = placed_empty(rng, (1.0, 3.0, 0.5)) @ placed_empty(rng, (2.0, 0.3, 1.0))
    centre, radius = region_in_solved(np.eye(4), sheared, 1.0)
    sphere = rng.normal(size=(20_000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    reach = np.linalg.norm(sphere @ sheared[:3, :3].T + sheared[:3, 3] - centre, axis=1)
    assert 0.99 * radius < reach.max() <= radius * (1 + 1e-12)


def test_a_region_without_size_is_refused() -> None:
    with pytest.raises(ValueError, match="no size"):
        region_in_solved(np.eye(4), np.diag([0.0, 0.0, 0.0, 1.0]), 1.0)
    with pytest.raises(ValueError, match="nowhere"):
        region_in_solved(np.eye(4), np.full((4, 4), np.nan), 1.0)
    with pytest.raises(ValueError, match="turned back"):
        region_in_solved(np.diag([1.0, 0.0, 1.0, 1.0]), np.eye(4), 1.0)


def test_the_fitted_sphere_leaves_the_background_out() -> None:
    rng = np.random.default_rng(0)
    sphere = rng.normal(size=(4000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    background = rng.normal(size=(1000, 3)) * 60 + [0, 100, 0]
    centre, radius = sphere_around(np.concatenate([sphere * 2 + 5, background]))
    np.testing.assert_allclose(centre, 5, atol=0.1)
    assert 2.0 < radius < 2.25


def test_weights_say_what_counts() -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.normal(size=(100, 3)), rng.normal(size=(300, 3)) + 50])
    centre, radius = sphere_around(points, np.repeat([100.0, 1.0], [100, 300]))
    assert np.linalg.norm(centre) < 1.0
    assert radius < 6
    whole = sphere_around(points, np.repeat([3.0, 0.0], [100, 300]))
    np.testing.assert_allclose(whole[0], sphere_around(points[:100])[0])


def test_too_few_points_and_points_in_one_place_are_refused() -> None:
    with pytest.raises(ValueError, match="too few"):
        sphere_around(np.full((50, 3), np.nan))
    with pytest.raises(ValueError, match="one place"):
        sphere_around(np.ones((50, 3)))


def test_a_weighted_quantile_counts_repeated_values() -> None:
    rng = np.random.default_rng(0)
    values, counts = rng.normal(size=40), rng.integers(1, 6, size=40)
    repeated = np.repeat(values, counts)
    for share in (0.01, 0.3, 0.5, 0.98, 1.0):
        expected = np.quantile(repeated, share, method="inverted_cdf")
        assert weighted_quantile(values, counts.astype(float), share) == expected


# Cameras of the world in the frame that was solved


@pytest.mark.parametrize("seed", range(4))
def test_a_camera_sees_in_the_solved_frame_what_it_sees_in_the_world(seed: int) -> None:
    """In its own axes each point lies in the same direction, and is nearer by the scale."""
    rng = np.random.default_rng(seed)
    world_from_solved = random_similarity(rng)
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3], world_from_camera[:3, 3] = random_rotation(rng), rng.normal(size=3) * 10
    pose = solved_from_camera(world_from_solved, world_from_camera)
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) > 0
    points = np.append(rng.normal(size=(5, 3)), np.ones((5, 1)), axis=1)
    in_camera = points @ (np.linalg.inv(world_from_camera) @ world_from_solved).T
    scale = np.cbrt(np.linalg.det(world_from_solved[:3, :3]))
    in_solved_camera = points @ np.linalg.inv(pose).T
    np.testing.assert_allclose(
        scale * in_solved_camera[:, :3], in_camera[:, :3], rtol=1e-9, atol=1e-9 * scale
    )


@pytest.mark.parametrize(
    "scales", [(1, 1, 1.01), (1, 1, -1), (-1, -1, -1), (1, 1, 0), (0, 0, 0), (np.nan, 1, 1), (np.inf, 1, 1)]
)
def test_no_camera_sees_what_is_stretched_or_mirrored(scales: tuple[float, float, float]) -> None:
    world_from_solved = random_similarity(np.random.default_rng(0))
    world_from_solved[:3, :3] *= scales
    with pytest.raises(ValueError, match=r"one positive scale|one of its scales is 0"):
        solved_from_camera(world_from_solved, np.eye(4))


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_a_similarity_is_found_again(seed: int, flat: bool) -> None:
    """Also where the points lie in a plane, which a mirror image fits as well; outliers do not undo it."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(30, 3)) * (1, 2, 0 if flat else 3)
    b_from_a = random_similarity(rng)
    moved = points @ b_from_a[:3, :3].T + b_from_a[:3, 3]
    np.testing.assert_allclose(
        similarity_between(points, moved), b_from_a, atol=1e-12 * np.abs(b_from_a).max()
    )
    size = np.ptp(moved, axis=0).max()
    noisy = moved + 3e-4 * size * rng.normal(size=moved.shape)
    found = similarity_between(points, noisy)
    np.testing.assert_allclose(found, b_from_a, atol=5e-3 * max(size, np.abs(b_from_a).max()))
    assert np.linalg.det(found[:3, :3]) > 0


def test_points_of_another_shape_are_refused() -> None:
    points = np.random.default_rng(0).normal(size=(30, 3))
    for other in (points * (1, 1, 1.2), points * (1, 1, -1), points[::-1], 0 * points):
        with pytest.raises(ValueError, match="same shape"):
            similarity_between(points, other)
    with pytest.raises(ValueError, match="all in one place"):
        similarity_between(0 * points, points)
