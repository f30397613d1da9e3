"""The region holds the subject, is not much larger than it, and does not depend on the world's frame."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from backend.errors import ErrorCode, ReconstructionError
from backend.maths.projection import projected
from backend.maths.raycast import RayCaster, camera_rays
from backend.scene import Camera, Region, SolvedCameras, no_progress, transform_points
from backend.stages import region as region_module
from backend.stages.region import RegionConfig, around_both, find_region, nearest_to_axes, weighted_quantile
from tests.synthetic_scene import (
    CENTRE,
    DISTANCE,
    SIZE,
    Scene,
    arc_cameras,
    camera_at,
    photographed,
    ring_cameras,
    surface_points,
    true_mesh,
)

REACH = 1.1 * SIZE
"""Of the body from its centre, along x."""


def region_of(solved: SolvedCameras, config: RegionConfig | None = None) -> Region:
    return find_region(solved, config or RegionConfig(), progress=no_progress)


def share_inside(region: Region) -> float:
    """Of the true surface."""
    in_object = transform_points(region.object_from_world, np.asarray(true_mesh().vertices))
    return float((np.linalg.norm(in_object, axis=1) < 1).mean())


def surface_samples(count: int, seed: int = 0) -> np.ndarray:
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    return surface_points(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def without_images(cameras: list[Camera], **changes: object) -> SolvedCameras:
    """Solved views of cameras whose pictures do not matter: nothing in them stands alone."""
    slope = np.broadcast_to(np.linspace(0, 1, 24, dtype=np.float32)[:, None], (18, 24, 3))
    scene: Scene = photographed([camera.resized(24, 18) for camera in cameras]).without_masks()
    views = tuple(replace(view, image_srgb=slope) for view in scene.views)
    return replace(scene.solved(), views=views, **changes)  # type: ignore[arg-type]


# from masks


def test_masks_all_around_give_the_bounding_sphere() -> None:
    region = region_of(photographed(ring_cameras(6, 160)).solved())
    assert share_inside(region) == 1.0
    assert np.linalg.norm(region.centre_world - CENTRE) < 0.1 * SIZE
    assert REACH < region.radius_world < 1.35 * REACH


@pytest.mark.parametrize("spread_deg", [20.0, 60.0])
def test_masks_from_a_narrow_arc_hold_the_subject(spread_deg: float) -> None:
    region = region_of(photographed(arc_cameras(3, spread_deg, 160)).solved())
    assert share_inside(region) > 0.999
    assert np.linalg.norm(region.centre_world - CENTRE) < 0.6 * SIZE
    assert region.radius_world < 2 * REACH


def test_masks_of_two_views_are_enough() -> None:
    assert share_inside(region_of(photographed(arc_cameras(2, 40, 160)).solved())) > 0.999


def test_a_photograph_that_cuts_the_subject_off_does_not_cut_the_region() -> None:
    """Space that a photograph does not show is not off its mask."""
    narrow = replace(camera_at(35, 0.6, 160), cx_px=-20.0)
    scene = photographed([*arc_cameras(3, 90, 160), narrow])
    assert 0.05 < scene.coverage[-1].mean() < 0.5
    assert share_inside(region_of(scene.solved())) == 1.0


def test_the_region_moves_with_the_world() -> None:
    """A similarity of the whole world carries the region with it."""
    solved = photographed(arc_cameras(4, 90, 120)).solved()
    scale, shift = 3.0, np.array([5.0, -2.0, 1.0])
    moved = []
    for view in solved.views:
        camera_from_world = view.camera.camera_from_world.copy()
        camera_from_world[:3, 3] = scale * camera_from_world[:3, 3] - camera_from_world[:3, :3] @ shift
        moved.append(replace(view, camera=replace(view.camera, camera_from_world=camera_from_world)))
    before, after = region_of(solved), region_of(replace(solved, views=tuple(moved)))
    np.testing.assert_allclose(after.centre_world, scale * before.centre_world + shift, atol=1e-6)
    np.testing.assert_allclose(after.radius_world, scale * before.radius_world, rtol=1e-6)


@pytest.mark.parametrize("num_white", [0, 1])
def test_an_empty_mask_is_told_by_name(num_white: int) -> None:
    """Also one whose subject is grey, with a white dot that it is measured against."""
    solved = photographed(arc_cameras(3, 40, 80)).solved()
    assert solved.views[1].mask is not None
    grey = np.float32(0.4) * solved.views[1].mask
    grey[30, 40 : 40 + num_white] = 1
    empty = replace(solved.views[1], mask=grey)
    with pytest.raises(ReconstructionError, match="view_01") as raised:
        region_of(replace(solved, views=(solved.views[0], empty, solved.views[2])))
    assert raised.value.code == ErrorCode.MASK_UNUSABLE


@pytest.mark.parametrize("cameras", [ring_cameras(6, 80), arc_cameras(3, 50, 160)])
def test_masks_that_have_hardly_anything_in_common_are_told(cameras: list[Camera]) -> None:
    """One of them is inverted; one that is off by a twentieth of the picture passes."""
    scene = photographed(cameras)

    def with_first_mask(change: Callable[[np.ndarray], np.ndarray]) -> SolvedCameras:
        first, *others = scene.views
        assert first.mask is not None
        changed = replace(first, mask=change(first.mask).astype(np.float32))
        return replace(scene, views=(changed, *others)).solved()

    with pytest.raises(ReconstructionError, match="The masks contradict each other") as raised:
        region_of(with_first_mask(lambda mask: 1 - mask))
    assert raised.value.code == ErrorCode.MASK_UNUSABLE
    region_of(with_first_mask(lambda mask: np.roll(mask, mask.shape[1] // 20, axis=1)))


def test_a_mask_that_lacks_a_half_is_doubted() -> None:
    """It is used, for it may be right that the others show more, but not without a word."""
    scene = photographed(arc_cameras(4, 75, 160))
    first, *others = scene.views
    assert first.mask is not None
    cut = first.mask.copy()
    cut[:, 80:] = 0
    assert region_of(scene.solved()).doubt is None
    doubt = region_of(replace(scene, views=(replace(first, mask=cut), *others)).solved()).doubt
    assert doubt is not None
    assert "The masks contradict each other" in doubt


def test_masks_of_narrow_bars_agree() -> None:
    """A picture frame, whose bars fall between the middles of the hull's cells."""
    bars = [
        trimesh.creation.box(np.array(size) * SIZE, trimesh.transformations.translation_matrix(at))
        for size, at in (
            ((1.6, 0.04, 0.04), CENTRE + np.array([0, 0, 0.7]) * SIZE),
            ((1.6, 0.04, 0.04), CENTRE - np.array([0, 0, 0.7]) * SIZE),
            ((0.04, 0.04, 1.4), CENTRE + np.array([0.8, 0, 0]) * SIZE),
            ((0.04, 0.04, 1.4), CENTRE - np.array([0.8, 0, 0]) * SIZE),
        )
    ]
    frame = trimesh.util.concatenate(bars)
    caster = RayCaster(np.asarray(frame.vertices), np.asarray(frame.faces, np.int64))
    cameras = ring_cameras(8, 320)
    masks = [caster.cast(*camera_rays(camera)).hit.reshape(camera.height, -1) for camera in cameras]
    solved = photographed(cameras).solved()
    views = zip(solved.views, masks, strict=True)
    masked = replace(solved, views=tuple(replace(view, mask=mask.astype(np.float32)) for view, mask in views))
    region = region_of(masked)
    farthest = np.linalg.norm(frame.vertices - region.centre_world, axis=1).max()
    assert 0.7 < farthest / region.radius_world <= 1


def test_masks_in_conflict_are_told() -> None:
    """At the same height, rays through the top rows of one and the bottom rows of the other never meet."""
    first, _, second = photographed(arc_cameras(3, 30, 80)).views
    top, bottom = np.zeros((2, 60, 80), np.float32)
    top[:8], bottom[-8:] = 1, 1
    solved = photographed(arc_cameras(2, 30, 80)).solved()
    views = (replace(first, mask=top), replace(second, mask=bottom))
    with pytest.raises(ReconstructionError) as raised:
        region_of(replace(solved, views=views))
    assert raised.value.code == ErrorCode.NO_SURFACE


# from points


def test_points_on_the_subject_give_its_sphere() -> None:
    region = region_of(without_images(arc_cameras(3, 40, 80), **sparse(surface_samples(400))))
    assert share_inside(region) > 0.93
    assert np.linalg.norm(region.centre_world - CENTRE) < 0.25 * SIZE
    assert region.radius_world < 1.3 * REACH


def test_few_outliers_hardly_change_the_region() -> None:
    points = surface_samples(400)
    far = CENTRE + np.random.default_rng(1).normal(size=(20, 3)) * 40 * SIZE
    clean = region_of(without_images(arc_cameras(3, 40, 80), **sparse(points)))
    noisy = region_of(without_images(arc_cameras(3, 40, 80), **sparse(np.vstack([points, far]))))
    assert np.linalg.norm(noisy.centre_world - clean.centre_world) < 0.1 * SIZE
    assert noisy.radius_world / clean.radius_world == pytest.approx(1.0, abs=0.15)


def test_a_background_that_two_views_see_yields_to_a_subject_that_all_see() -> None:
    """A fifth of the points lie on a wall behind; each is seen by two of five photographs."""
    points = surface_samples(400)
    wall = (
        CENTRE + np.array([0.0, 12 * SIZE, 0.0]) + np.random.default_rng(2).normal(size=(100, 3)) * 4 * SIZE
    )
    visibility = np.ones((500, 5), bool)
    visibility[400:, 2:] = False
    found = sparse(np.vstack([points, wall]))
    region = region_of(without_images(arc_cameras(5, 60, 80), **{**found, "sparse_visibility": visibility}))
    assert np.linalg.norm(region.centre_world - CENTRE) < 0.3 * SIZE
    assert region.radius_world < 1.6 * REACH


def test_what_stands_behind_the_subject_for_one_camera_is_left_out() -> None:
    """A wall behind the subject, seen by two cameras of a ring, with more points than the subject has."""
    cameras = ring_cameras(6, 160)
    rng = np.random.default_rng(3)
    away = -cameras[0].position / np.linalg.norm(cameras[0].position)
    wall = cameras[0].position * -3 + rng.normal(size=(3000, 3)) * 0.3 + away
    subject = surface_samples(800)
    alone, both = (
        region_of(without_images(cameras, **sparse(p))) for p in (subject, np.vstack([subject, wall]))
    )
    np.testing.assert_allclose(both.centre_world, alone.centre_world, atol=0.02 * alone.radius_world)
    assert both.radius_world == pytest.approx(alone.radius_world, rel=0.02)


def closer(camera: Camera, times: float, at: np.ndarray) -> Camera:
    """The same picture of the place `at` alone, taken from as far away by a longer lens."""
    (middle,), _ = projected(at[None], camera)
    lens = {"fx_px": times * camera.fx_px, "fy_px": times * camera.fy_px}
    aside = (np.array([camera.cx_px, camera.cy_px]) - middle) * times
    centre = np.array([camera.width, camera.height]) / 2 + aside
    return replace(camera, **lens, cx_px=float(centre[0]), cy_px=float(centre[1]))


def test_close_ups_of_a_detail_do_not_shrink_the_region_to_it() -> None:
    points = surface_samples(600)
    detail = surface_points(np.array([[0.9, -0.42, 0.12]]) / np.linalg.norm([0.9, -0.42, 0.12]))[0]
    overviews = arc_cameras(6, 120, 80)
    close_ups = [closer(camera_at(azimuth, 0.6, 80), 6.0, detail) for azimuth in (25.0, 45.0, 65.0)]
    found = {}
    for cameras in (overviews, [*overviews, *close_ups]):
        visibility = np.ones((len(points), len(cameras)), bool)
        changes = {"sparse_positions": points, "sparse_visibility": visibility}
        found[len(cameras)] = region_of(without_images(cameras, **changes))
    assert found[9].radius_world == pytest.approx(found[6].radius_world, rel=0.05)
    assert share_inside(found[9]) > 0.9


def in_a_room(num_subject: int, num_room: int) -> SolvedCameras:
    """Points on the subject and far behind it, where all of the cameras see them."""
    behind = CENTRE + np.random.default_rng(4).uniform([-3, 8, -3], [3, 30, 3], (num_room, 3)) * SIZE
    points = np.vstack([surface_samples(num_subject), behind])
    return without_images(arc_cameras(3, 20, 80), **sparse(points))


def test_a_subject_in_a_room_is_what_all_photographs_have_in_their_middle() -> None:
    solved = in_a_room(900, 400)
    region = region_of(solved)
    np.testing.assert_allclose(region.centre_world, CENTRE, atol=0.01 * SIZE)
    alone = region_of(without_images([view.camera for view in solved.views]))
    assert region.radius_world == pytest.approx(alone.radius_world)
    assert region.decisions[0].choice == "what all photographs have in their middle"
    assert "60%" in region.decisions[0].because


def test_a_room_with_few_points_in_the_middle_is_taken_whole() -> None:
    region = region_of(in_a_room(200, 600))
    assert region.radius_world > 5 * SIZE


def sparse(points: np.ndarray) -> dict[str, np.ndarray]:
    return {"sparse_positions": points, "sparse_visibility": np.ones((len(points), 3), bool)}


# before an even backdrop


def in_the_middle(count: int = 200) -> np.ndarray:
    """Samples of the surface between its two lobes, where alone there may be texture."""
    points = surface_samples(20 * count)
    return points[np.abs(points - CENTRE)[:, 0] < 0.4 * REACH][:count]


def test_what_stands_alone_before_a_backdrop_is_not_cut_off_where_it_has_no_texture() -> None:
    scene = photographed(arc_cameras(3, 40, 160))
    bare = scene.without_masks().solved()
    cut = region_of(without_images(scene.cameras, **sparse(in_the_middle())))
    assert share_inside(cut) < 0.9
    for points in (in_the_middle(), surface_samples(0)):
        region = region_of(replace(bare, **sparse(points)))  # type: ignore[arg-type]
        assert share_inside(region) > 0.99
        assert region.radius_world < 1.1 * region_of(scene.solved()).radius_world
        assert "stands alone before an even backdrop" in region.decisions[0].choice


def test_a_region_that_leaves_nothing_out_stays() -> None:
    scene = photographed(arc_cameras(3, 40, 160))
    points = surface_samples(400)
    before_black = region_of(replace(scene.without_masks().solved(), **sparse(points)))  # type: ignore[arg-type]
    before_wall = region_of(without_images(scene.cameras, **sparse(points)))
    np.testing.assert_array_equal(before_black.object_from_world, before_wall.object_from_world)


def test_what_the_border_cuts_does_not_stand_alone() -> None:
    scene = photographed(arc_cameras(3, 40, 160)).without_masks()
    tables = [view.image_srgb.copy() for view in scene.views]
    for table in tables:
        table[80:, 60:100] = 0.7
    views = tuple(replace(v, image_srgb=image) for v, image in zip(scene.views, tables, strict=True))
    points = in_the_middle()
    region = region_of(replace(scene.solved(), views=views, **sparse(points)))  # type: ignore[arg-type]
    of_points = region_of(without_images(scene.cameras, **sparse(points)))
    np.testing.assert_array_equal(region.object_from_world, of_points.object_from_world)


def test_things_that_are_not_one_leave_the_region_to_the_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each photograph shows another patch alone before black: they have no part of space in common.

    That is no fault of anyone's, and not worth cells three times as fine: ten seconds, of the temple.
    """
    asked: list[int] = []
    of_hull = region_module._of_hull
    monkeypatch.setattr(
        region_module,
        "_of_hull",
        lambda views, config: asked.append(config.hull_cells) or of_hull(views, config),
    )
    scene = photographed(arc_cameras(3, 40, 160)).without_masks()
    pictures = [np.zeros_like(view.image_srgb) for view in scene.views]
    for index, picture in enumerate(pictures):
        picture[20 + 30 * index : 40 + 30 * index, 20 + 40 * index : 50 + 40 * index] = 0.8
    views = tuple(replace(v, image_srgb=image) for v, image in zip(scene.views, pictures, strict=True))
    points = in_the_middle()
    region = region_of(replace(scene.solved(), views=views, **sparse(points)))  # type: ignore[arg-type]
    of_points = region_of(without_images(scene.cameras, **sparse(points)))
    np.testing.assert_array_equal(region.object_from_world, of_points.object_from_world)
    assert asked == [RegionConfig().hull_cells]


@pytest.mark.parametrize(
    ("apart", "radii", "expected_x", "expected_radius"),
    [(3.0, (1.0, 2.0), 2.0, 3.0), (0.5, (2.0, 1.0), 0.0, 2.0), (0.0, (1.0, 1.0), 0.0, 1.0)],
)
def test_the_sphere_around_two_touches_both_or_is_one_of_them(
    apart: float, radii: tuple[float, float], expected_x: float, expected_radius: float
) -> None:
    """From -1 to 5 along x, for the first."""
    along_x = np.array([1.0, 0.0, 0.0])
    other = CENTRE + apart * along_x
    for spheres in (((CENTRE, radii[0]), (other, radii[1])), ((other, radii[1]), (CENTRE, radii[0]))):
        centre, radius = around_both(*spheres)
        np.testing.assert_allclose(centre, CENTRE + expected_x * along_x, atol=1e-12)
        assert radius == pytest.approx(expected_radius)


# from cameras alone


def test_cameras_alone_give_what_all_of_them_show() -> None:
    cameras = arc_cameras(4, 90, 80)
    region = region_of(without_images(cameras))
    np.testing.assert_allclose(region.centre_world, CENTRE, atol=1e-9)
    # from the centre to the nearest side of the frustum: top or bottom of a 4:3 picture
    slope = min((0.49 * 60) / (1.44 * 80), (0.51 * 60) / (1.44 * 80))
    expected = DISTANCE * SIZE * np.sin(np.arctan(slope))
    assert region.radius_world == pytest.approx(expected, rel=0.02)


def test_cameras_that_look_apart_are_told() -> None:
    looking_in = camera_at(0, 0.6, 80)
    turned = np.diag([-1.0, 1.0, -1.0, 1.0]) @ camera_at(90, 0.6, 80).camera_from_world
    away = replace(camera_at(90, 0.6, 80), camera_from_world=turned)
    with pytest.raises(ReconstructionError, match="common place") as raised:
        region_of(without_images([looking_in, away]))
    assert raised.value.code == ErrorCode.CAMERAS_UNUSABLE


@pytest.mark.parametrize("masked", [True, False])
@pytest.mark.parametrize("change", ["world to camera", "camera axes of OpenCV"])
def test_cameras_in_other_conventions_are_told_what_is_expected(change: str, masked: bool) -> None:
    scene = photographed(arc_cameras(4, 75, 80))
    half_turn = np.diag([1.0, -1.0, -1.0, 1.0])

    def changed(camera: Camera) -> Camera:
        if change == "camera axes of OpenCV":
            return replace(camera, camera_from_world=half_turn @ camera.camera_from_world)
        world_from_camera = np.linalg.inv(camera.camera_from_world) @ half_turn
        return replace(camera, camera_from_world=half_turn @ world_from_camera)

    views = tuple(replace(view, camera=changed(view.camera)) for view in scene.views)
    scene = replace(scene, views=views)
    with pytest.raises(ReconstructionError, match="common place") as raised:
        region_of((scene if masked else scene.without_masks()).solved())
    assert raised.value.code == ErrorCode.CAMERAS_UNUSABLE
    assert "camera-to-world" in raised.value.remedy


def test_cameras_that_all_stand_in_one_place_are_told() -> None:
    """Turned on the spot, far from the origin, where positions have few digits left."""
    cameras = []
    for camera in arc_cameras(4, 75, 80):
        pose = camera.camera_from_world.copy()
        pose[:3, 3] = -pose[:3, :3] @ [1e5, -2e5, 1e5]
        cameras.append(replace(camera, camera_from_world=pose))
    with pytest.raises(ReconstructionError, match="stand in one place") as raised:
        region_of(without_images(cameras))
    assert raised.value.code == ErrorCode.CAMERAS_UNUSABLE


def test_axes_that_meet_meet_there() -> None:
    np.testing.assert_allclose(nearest_to_axes(arc_cameras(5, 120, 80)), CENTRE, atol=1e-9)


def test_skew_axes_are_nearest_in_the_middle() -> None:
    """One axis along x at z = 0, one along y at z = 2: (0, 0, 1) is one away from both."""

    def looking(axis: list[float], up: list[float], position: list[float]) -> Camera:
        rotation = np.stack([np.cross(up, axis), up, axis])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ np.array(position)
        return replace(camera_at(0, 0, 80), camera_from_world=pose)

    cameras = [looking([1, 0, 0], [0, 0, 1], [-3, 0, 0]), looking([0, 1, 0], [0, 0, 1], [0, -5, 2])]
    np.testing.assert_allclose(nearest_to_axes(cameras), [0, 0, 1], atol=1e-12)


# given


def test_a_given_sphere_is_taken() -> None:
    config = RegionConfig(centre_world=(1.0, 2.0, 3.0), radius_world=4.0)
    region = region_of(photographed(arc_cameras(2, 40, 80)).solved(), config)
    np.testing.assert_allclose(region.centre_world, [1, 2, 3])
    assert region.radius_world == pytest.approx(4.0)
    assert region.decisions[0].because == "set by the user"
    assert region.given


def test_a_given_sphere_that_no_photograph_shows_is_told() -> None:
    config = RegionConfig(centre_world=tuple(CENTRE + np.array([0, 0, 200])), radius_world=3.0)
    with pytest.raises(ReconstructionError, match="0 of 3 photographs") as raised:
        region_of(photographed(arc_cameras(3, 40, 80)).solved(), config)
    assert raised.value.code == ErrorCode.SETTINGS_INVALID
    around = RegionConfig(centre_world=tuple(CENTRE), radius_world=30 * SIZE)  # all cameras stand in it
    assert region_of(photographed(arc_cameras(3, 40, 80)).solved(), around).radius_world == pytest.approx(
        30 * SIZE
    )


# the weighted quantile

quantities = arrays(np.float64, 12, elements=st.floats(-100, 100))
whole_weights = arrays(np.int64, 12, elements=st.integers(1, 5))


@settings(max_examples=50, deadline=None)
@given(quantities, whole_weights, st.floats(0.01, 1.0))
def test_a_weight_counts_as_so_many_copies(values: np.ndarray, weights: np.ndarray, share: float) -> None:
    copies = np.sort(np.repeat(values, weights))
    rank = int(np.ceil(share * len(copies) - 1e-9)) - 1
    assert weighted_quantile(values, weights.astype(np.float64), share) == copies[max(rank, 0)]
