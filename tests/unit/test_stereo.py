"""Depth maps and points against the truth they were drawn from; no points where nothing can be measured."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
import torch
from jaxtyping import Float64
from scipy.ndimage import distance_transform_edt, gaussian_filter

from backend.errors import Cancelled, ErrorCode, ReconstructionError
from backend.maths.geometry import Pinhole, pinhole_in_object
from backend.maths.raycast import camera_rays
from backend.scene import Camera, Region, StereoResult, View, no_progress, to_unit_sphere, transform_points
from backend.stages.stereo.config import StereoConfig
from backend.stages.stereo.depth_maps import depth_maps
from backend.stages.stereo.multi_view_stereo import match_views
from backend.stages.stereo.outlines_alone import hollows_filled
from backend.stages.stereo.windows import neighbours, pyramid, views_between
from tests.synthetic_scene import (
    CENTRE,
    OBJECT_UNIT,
    SIZE,
    Scene,
    arc_cameras,
    camera_at,
    diagonal,
    photographed,
    surface_distance,
    surface_points,
    texture_srgb,
    true_normals,
    true_region,
)

PLATE = CENTRE - [0, 0.8 * SIZE, 0]
"""The middle of a square across y, nearer to the cameras than the body."""


def match(views: tuple[View, ...]) -> StereoResult:
    return match_views(views, true_region(), StereoConfig(), device=torch.device("cpu"), progress=no_progress)


@cache
def scene() -> Scene:
    return photographed(arc_cameras(3, 30, 160))


@cache
def matched() -> StereoResult:
    return match(scene().views)


def world_points(result: StereoResult) -> np.ndarray:
    return transform_points(true_region().world_from_object, result.points.positions.astype(np.float64))


def errors_percent(result: StereoResult) -> np.ndarray:
    """Distance of the points from the true surface, in percent of the body's diagonal."""
    return np.asarray(100 * np.abs(surface_distance(world_points(result))) / diagonal())


def noise(view: View, seed: int, deviation: float = 1 / 255) -> View:
    random = np.random.default_rng(seed).normal(size=view.image_srgb.shape) * deviation
    return replace(view, image_srgb=np.clip(view.image_srgb + random, 0, 1).astype(np.float32))


# accuracy


def test_depth_maps_are_true() -> None:
    """Median and 95 % in percent of the diagonal; a pixel here is 0.7 % wide."""
    for found, truth in zip(matched().depth_maps, scene().depths, strict=True):
        measured = (found.depth > 0) & np.isfinite(truth)
        apart = 100 * np.abs(found.depth[measured] * OBJECT_UNIT - truth[measured]) / diagonal()
        assert np.median(apart) < 0.12
        assert np.quantile(apart, 0.95) < 0.9


def test_most_of_what_two_photographs_show_is_measured() -> None:
    for found, covered in zip(matched().depth_maps, scene().coverage, strict=True):
        assert (found.depth > 0)[covered].mean() > 0.75


def test_surface_that_turns_away_is_grown_from_its_neighbour() -> None:
    """Wide apart, a sweep of planes that face the camera misses a fifth of what two photographs show."""
    wide = photographed(arc_cameras(3, 40, 320))
    swept, grown = (
        match_views(wide.views, true_region(), config, device=torch.device("cpu"), progress=no_progress)
        for config in (
            StereoConfig(sweep_again=False, lean=0.0, growth_rounds=(0, 0, 0)),
            StereoConfig(sweep_again=False, lean=0.0),
        )
    )
    missed = [
        np.mean([1 - (m.depth > 0)[on].mean() for m, on in zip(found.depth_maps, wide.coverage, strict=True)])
        for found in (swept, grown)
    ]
    assert missed[1] < 0.4 * missed[0]
    assert missed[1] < 0.08
    assert np.quantile(errors_percent(grown), 0.95) < 1.1 * np.quantile(errors_percent(swept), 0.95)


@cache
def blurred() -> Scene:
    """Until a patch shows next to nothing."""
    wide = photographed(arc_cameras(3, 30, 320))
    faint = (gaussian_filter(view.image_srgb, (6, 6, 0)) * 0.5 for view in wide.views)
    views = tuple(replace(view, image_srgb=image) for view, image in zip(wide.views, faint, strict=True))
    return replace(wide, views=views)


@cache
def matched_blurred(trust: float, if_textured: float) -> StereoResult:
    config = StereoConfig(coarse_pixels=10_000, trust_of_half_size=trust, trust_if_textured=if_textured)
    return match_views(
        blurred().views, true_region(), config, device=torch.device("cpu"), progress=no_progress
    )


def test_weak_texture_is_measured_on_smaller_photographs() -> None:
    """What larger patches add is right, and trusted less."""
    results = (matched_blurred(0.0, 0.0), matched_blurred(0.4, 0.1))
    depths = (result.depth_maps for result in results)
    maps = list(zip(*depths, blurred().depths, blurred().coverage, strict=True))
    full, both = (np.mean([(m[i].depth > 0)[m[3]].mean() for m in maps]) for i in (0, 1))
    assert both > full + 0.1
    for fine, all_sizes, truth, covered in maps:
        added = (all_sizes.depth > 0) & (fine.depth == 0) & covered
        apart = 100 * np.abs(all_sizes.depth[added] * OBJECT_UNIT - truth[added]) / diagonal()
        assert np.median(apart) < 1
        assert all_sizes.confidence[added].max() <= 0.4
        np.testing.assert_array_equal(all_sizes.depth[fine.depth > 0], fine.depth[fine.depth > 0])


def test_smaller_photographs_are_trusted_least_where_the_first_size_has_texture() -> None:
    """Grain that is another in each photograph looks like texture there, and like nothing on smaller ones."""
    config = StereoConfig(coarse_pixels=10_000, trust_of_half_size=0.9, trust_if_textured=0.05)
    grainy = tuple(noise(view, seed, 20 / 255) for seed, view in enumerate(blurred().views))
    for views, is_textured, least, most in ((blurred().views, 0, 0.3, 1.0), (grainy, 1, 0.0, 0.05)):
        result = match_views(views, true_region(), config, device=torch.device("cpu"), progress=no_progress)
        sizes = [pyramid(view, true_region(), config, torch.device("cpu")) for view in views]
        assert np.mean([size[0].textured[size[0].subject].float().mean() for size in sizes]) == (
            pytest.approx(is_textured, abs=0.2)
        )
        confidence = np.concatenate([map_.confidence[map_.depth > 0] for map_ in result.depth_maps])
        assert least < np.quantile(confidence, 0.99) <= most
        assert len(confidence) > 10_000


def test_photographs_may_be_compared_at_half_their_size() -> None:
    """A quarter of the points; the depth map is as large as the photograph and as full as before."""
    wide = photographed(arc_cameras(3, 30, 320))
    whole, half = (
        match_views(
            wide.views,
            true_region(),
            StereoConfig(coarse_pixels=10_000, first_pixel_size=size),
            device=torch.device("cpu"),
            progress=no_progress,
        )
        for size in (1, 2)
    )
    assert len(half.points.positions) == pytest.approx(len(whole.points.positions) / 4, rel=0.1)
    assert np.median(errors_percent(half)) < 0.15
    assert half.points.confidence.mean() == pytest.approx(whole.points.confidence.mean(), rel=0.15)
    for found, truth, covered in zip(half.depth_maps, wide.depths, wide.coverage, strict=True):
        measured = (found.depth > 0) & covered
        assert found.depth.shape == truth.shape
        assert measured.sum() > 0.85 * covered.sum()
        apart = 100 * np.abs(found.depth[measured] * OBJECT_UNIT - truth[measured]) / diagonal()
        assert np.median(apart) < 0.15


def test_points_lie_on_the_surface() -> None:
    apart = errors_percent(matched())
    assert len(apart) > 15_000
    assert np.median(apart) < 0.12
    assert np.quantile(apart, 0.95) < 0.5


def test_normals_are_the_surface_s() -> None:
    points = matched().points
    cosine = (points.normals * true_normals(world_points(matched()))).sum(axis=1)
    angles_deg = np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))
    assert np.median(angles_deg) < 6
    assert np.quantile(angles_deg, 0.95) < 20
    np.testing.assert_allclose(np.linalg.norm(points.normals, axis=1), 1, atol=1e-5)


def test_colours_are_the_texture_s() -> None:
    apart = np.abs(matched().points.colours_srgb - texture_srgb(world_points(matched())))
    assert np.median(apart) < 0.03


def test_points_are_their_depth_maps() -> None:
    """Every point lies on its photograph's depth map, at that photograph's pixel."""
    points, result = world_points(matched()), matched()
    for index, (view, found) in enumerate(zip(scene().views, result.depth_maps, strict=True)):
        mine = points[result.points.view_index == index]
        in_camera = transform_points(view.camera.camera_from_world, mine)
        at = np.floor((in_camera @ view.camera.intrinsics.T)[:, :2] / in_camera[:, 2:]).astype(int)
        np.testing.assert_allclose(found.depth[at[:, 1], at[:, 0]] * OBJECT_UNIT, in_camera[:, 2], rtol=1e-4)


def test_a_photograph_that_looks_away_takes_nothing_from_the_others() -> None:
    first, second, third = scene().views
    pose = np.diag([-1.0, 1.0, -1.0, 1.0]) @ second.camera.camera_from_world
    away = replace(second, name="away", camera=replace(second.camera, camera_from_world=pose), mask=None)
    with_it = match((first, second, away, third))
    np.testing.assert_array_equal(with_it.points.positions, matched().points.positions)
    assert not with_it.depth_maps[2].depth.any()


def test_two_views_are_enough_and_are_trusted_less() -> None:
    pair = match(photographed(arc_cameras(2, 15, 160)).views)
    apart = errors_percent(pair)
    assert len(apart) > 10_000
    assert np.median(apart) < 0.15
    assert np.quantile(apart, 0.95) < 0.6
    assert set(pair.points.num_views) == {2}
    assert pair.points.confidence.mean() < 0.8 * matched().points.confidence.mean()


def test_confidence_tells_good_points_from_bad_ones() -> None:
    confidence, apart = matched().points.confidence, errors_percent(matched())
    assert confidence.min() >= 0
    assert confidence.max() <= 1
    sure = confidence > np.median(confidence)
    assert apart[sure].mean() < 0.75 * apart[~sure].mean()


# what must not matter


def test_points_beside_the_outline_are_trusted_less() -> None:
    """There the surface turns away, and each photograph's outline is another place of it."""
    points, confidence = world_points(matched()), matched().points.confidence
    inside_px = np.empty(len(points))
    for index, view in enumerate(scene().views):
        mine = matched().points.view_index == index
        assert view.mask is not None
        inside = distance_transform_edt(view.mask > 0.5)
        in_camera = transform_points(view.camera.camera_from_world, points[mine])
        at = np.floor((in_camera @ view.camera.intrinsics.T)[:, :2] / in_camera[:, 2:]).astype(int)
        inside_px[mine] = inside[at[:, 1], at[:, 0]]
    beside, within = inside_px < 4, inside_px > 20
    assert np.median(errors_percent(matched())[beside]) > 2 * np.median(errors_percent(matched())[within])
    assert confidence[beside].mean() < 0.5 * confidence[within].mean()


def test_patches_whose_texture_lies_to_one_side_are_trusted_less_where_asked() -> None:
    """Of blotches only the borders tell depth; no point is trusted more, and wrong ones less than others."""
    wide = photographed(arc_cameras(3, 30, 320))
    blotches = tuple(
        replace(view, image_srgb=(0.4 + 0.2 * (view.image_srgb > 0.6)).astype(np.float32))
        for view in wide.views
    )
    usual, asked = (
        match_views(
            blotches,
            true_region(),
            StereoConfig(free_leverage=free),
            device=torch.device("cpu"),
            progress=no_progress,
        )
        for free in (None, 1.2)
    )
    np.testing.assert_array_equal(usual.points.positions, asked.points.positions)
    share = asked.points.confidence / usual.points.confidence
    assert share.max() < 1 + 1e-6
    apart = errors_percent(usual)
    before, after = (np.average(apart, weights=found.points.confidence**3.0) for found in (usual, asked))
    assert after < 0.95 * before


def test_stripes_along_the_epipolar_lines_tell_nothing() -> None:
    """Their patches agree as well as those of any other stripes, but they do so at every depth."""
    assert striped_wall_confidence(axis=0).mean() > 0.3
    with pytest.raises(ReconstructionError, match="agree on only"):
        striped_wall_confidence(axis=1)


def striped_wall_confidence(axis: int) -> np.ndarray:
    """Of the points of a wall whose greys change along one axis; the cameras stand side by side along x."""
    views = []
    for x in (-0.6, 0.0, 0.6):
        camera_from_world = np.eye(4)
        camera_from_world[:3, 3] = -x, 0.0, 4.0
        lens = {"fx_px": 200.0, "fy_px": 200.0, "cx_px": 60.0, "cy_px": 45.0}
        camera = Camera(camera_from_world=camera_from_world, **lens, width=120, height=90)
        rows, columns = np.indices((90, 120)) + 0.5
        on_wall = (x + 4 * (columns - 60) / 200, 4 * (rows - 45) / 200)[axis]
        waves = np.sin(np.multiply.outer([13, 23, 37], on_wall))
        grey = (0.5 + 0.1 * waves.sum(axis=0)).astype(np.float32)
        image = np.repeat(grey[..., None], 3, axis=2)
        views.append(View(name=f"{x}.png", camera=camera, image_srgb=image, mask=None))
    unit = Region(object_from_world=np.eye(4))
    cpu = torch.device("cpu")
    return match_views(tuple(views), unit, StereoConfig(), device=cpu, progress=no_progress).points.confidence


def test_the_exposure_of_one_photograph_does_not_matter() -> None:
    first, second, third = scene().views
    brighter = replace(second, image_srgb=(second.image_srgb * 1.3 + 0.05).astype(np.float32))
    changed = match((first, brighter, third))
    for before, after in zip(matched().depth_maps, changed.depth_maps, strict=True):
        both = (before.depth > 0) & (after.depth > 0)
        assert both.sum() > 0.97 * (before.depth > 0).sum()
        apart = 100 * np.abs(before.depth - after.depth)[both] * OBJECT_UNIT / diagonal()
        assert np.quantile(apart, 0.95) < 0.05


def test_the_noise_of_a_sensor_hardly_matters() -> None:
    noisy = match(tuple(noise(view, seed) for seed, view in enumerate(scene().views)))
    assert np.median(errors_percent(noisy)) < 0.15
    assert len(noisy.points.positions) > 0.85 * len(matched().points.positions)


def test_a_run_repeats_to_the_bit() -> None:
    again = match(scene().views)
    for field in ("positions", "normals", "colours_srgb", "confidence", "num_views", "view_index"):
        np.testing.assert_array_equal(getattr(again.points, field), getattr(matched().points, field))
    for first, second in zip(matched().depth_maps, again.depth_maps, strict=True):
        np.testing.assert_array_equal(first.depth, second.depth)


# what must not be measured


@cache
def with_a_plate() -> tuple[View, ...]:
    """A square before the body, in the outer photographs only: the middle one shows what is behind it."""
    first, middle, last = photographed(arc_cameras(3, 30, 320)).views
    return plate_added(first), middle, plate_added(last)


def plate_added(view: View) -> View:
    origins, directions = camera_rays(view.camera)
    outwards = np.array([0.0, -1.0, 0.0])
    along = ((PLATE - origins) @ outwards) / (directions @ outwards)
    points = origins + along[:, None] * directions
    on_plate = (np.abs(points - PLATE).max(axis=1) < 0.3 * SIZE).reshape(view.image_srgb.shape[:2])
    image = view.image_srgb.copy()
    image[on_plate] = texture_srgb(points).reshape(image.shape)[on_plate]
    return replace(view, image_srgb=image)


def points_on_the_plate(result: StereoResult) -> int:
    return int((np.abs(world_points(result)[:, 1] - PLATE[1]) < 0.02 * SIZE).sum())


def test_what_two_views_see_past_a_third_that_sees_something_else_is_chance() -> None:
    """Two photographs alone would measure the plate."""
    first, middle, last = with_a_plate()
    chance = points_on_the_plate(match((first, last)))
    assert chance > 2000
    assert points_on_the_plate(match((first, middle, last))) < 0.02 * chance


def test_a_view_between_two_that_shows_nothing_does_not_contradict_them() -> None:
    first, middle, last = with_a_plate()
    black = replace(middle, image_srgb=np.zeros_like(middle.image_srgb))
    without, beside_it = match((first, last)), match((first, black, last))
    assert points_on_the_plate(beside_it) > 0.9 * points_on_the_plate(without)
    # but what it does not confirm is not sure: as much as a quarter of a second view says, not all of it
    usual, doubted = (np.median(found.points.confidence) for found in (without, beside_it))
    assert doubted == pytest.approx(usual * (1 - np.exp(-0.7 / 4)) / (1 - np.exp(-0.7)), rel=0.05)
    assert (beside_it.points.num_views == 2).all()


def test_what_stands_behind_the_region_does_not_hang_in_it() -> None:
    """Where only the region's depths are tried, 86 pixels of the wall find one; the body loses little."""
    scene = photographed(arc_cameras(4, 60, 160), wall=True)
    unmasked = tuple(replace(view, mask=None) for view in scene.views)
    errors = errors_percent(match(unmasked))
    assert (errors > 5).sum() < 30
    assert (errors < 1).sum() > 30_500


def test_pixels_that_show_what_is_behind_the_region_are_told() -> None:
    """Where nothing else tells what is not the subject: no mask, and no even backdrop."""
    scene = photographed(arc_cameras(4, 60, 160), wall=True)
    for map_, body in zip(match(scene.without_masks().views).depth_maps, scene.coverage, strict=True):
        assert map_.behind is not None
        assert (map_.behind & body).sum() < 0.025 * body.sum()
        assert (map_.behind & ~body).sum() > 3 * (map_.behind & body).sum()
        assert (map_.behind & ~body).sum() > 0.05 * (~body).sum()
    assert [map_.behind for map_ in match(scene.views).depth_maps] == [None] * 4
    before_black = photographed(arc_cameras(3, 40, 160)).without_masks()
    assert [map_.behind for map_ in match(before_black.views).depth_maps] == [None] * 3


def test_from_within_the_region_a_step_may_lead_beyond_all_that_moves() -> None:
    """Sixteen steps from near to far are so long there that none is left behind: no error."""
    wide = np.eye(4)
    wide[:3, :3] /= 8 * OBJECT_UNIT
    wide[:3, 3] = -CENTRE / (8 * OBJECT_UNIT)
    beside = arc_cameras(3, 1, 40)[::2]
    views = [replace(view, mask=None) for view in photographed(beside, wall=True).views]
    region, config = Region(object_from_world=wide), StereoConfig()
    windows = [pyramid(view, region, config, torch.device("cpu"))[-1:] for view in views]
    maps = depth_maps(windows, [[1], [0]], config, no_progress)
    assert [float(sizes[0].map.behind.max()) for sizes in maps] == [0, 0]


def pinholes(cameras: Sequence[Camera]) -> list[Pinhole]:
    return [pinhole_in_object(camera, true_region(), torch.device("cpu")) for camera in cameras]


def at_azimuths(*azimuths_deg: float) -> list[Pinhole]:
    """Level with the body, so that azimuths are as far apart as views are."""
    return pinholes([camera_at(azimuth, 0.0, 160) for azimuth in azimuths_deg])


def test_views_are_compared_with_those_beside_them() -> None:
    assert neighbours(at_azimuths(0, 20, 40), 3) == [[1, 2], [0, 2], [1, 0]]
    assert neighbours(at_azimuths(0, 12, 26, 38), 2) == [[1, 2], [0, 2], [3, 1], [2, 1]]


def test_what_is_seen_at_a_slant_is_compared_only_where_there_are_no_two_nearer_views() -> None:
    arc = at_azimuths(0, 24, 48, 72, 96)
    assert [sorted(near) for near in neighbours(arc, 3)] == [[1, 2], [0, 2], [1, 3], [2, 4], [2, 3]]


@pytest.mark.parametrize("num_views", [5, 6, 7, 8])
def test_a_ring_of_few_views_is_compared_all_the_way_round(num_views: int) -> None:
    ring = at_azimuths(*(360 * index / num_views for index in range(num_views)))
    for index, near in enumerate(neighbours(ring, 3)):
        assert sorted(near) == sorted({(index - 1) % num_views, (index + 1) % num_views})


def test_views_from_about_one_place_are_compared_with_wide_ones_too() -> None:
    """From 4 degrees apart alone, depth would be told badly; from the same place, not at all."""
    assert neighbours(at_azimuths(0, 4, -4, 55), 3)[0] == [1, 2, 3]
    assert neighbours(at_azimuths(0, 0.1, 55, 140), 3) == [[2], [2], [1, 0], []]


def test_views_between_are_about_on_the_way() -> None:
    cameras = pinholes(arc_cameras(5, 60, 160))
    assert views_between(cameras, 0, 2) == [1]
    assert views_between(cameras, 4, 0) == [1, 2, 3]
    assert views_between(cameras, 1, 2) == []


def test_nothing_off_the_mask_is_kept() -> None:
    """Masks of half the body: its other half has all the texture it needs, and must not come."""
    halves = []
    for view, covered in zip(scene().views, scene().coverage, strict=True):
        left = covered & (np.arange(view.camera.width) < 80)
        halves.append(replace(view, mask=left.astype(np.float32)))
    result = match(tuple(halves))
    for view, found in zip(halves, result.depth_maps, strict=True):
        assert view.mask is not None
        assert not found.depth[view.mask < 0.5].any()
        assert (found.depth > 0).sum() > 0.5 * view.mask.sum()


def test_points_lie_in_the_region() -> None:
    """The wall behind is textured and seen by all, but far outside."""
    views = photographed(arc_cameras(3, 30, 160), wall=True).without_masks().views
    result = match(views)
    assert np.linalg.norm(result.points.positions, axis=1).max() < 1
    apart = errors_percent(result)
    assert np.median(apart) < 0.12
    assert np.quantile(apart, 0.95) < 0.8


@pytest.mark.parametrize("noisy", [False, True])
def test_a_masked_subject_without_texture_has_no_points(noisy: bool) -> None:
    """So its outlines alone are left; without them there is no surface."""
    views = photographed(arc_cameras(3, 30, 160), textured=False).views
    if noisy:
        views = tuple(noise(view, seed) for seed, view in enumerate(views))
    result = match(views)
    assert not len(result.points.positions)
    assert not any(map_.depth.any() or map_.confidence.any() for map_ in result.depth_maps)
    assert "outlines" in result.decisions[0].choice
    assert "outlines" in (hollows_filled(result, true_region()) or "")
    two_masks = (*views[:2], replace(views[2], mask=None))
    of_all_else = tuple(replace(view, mask=1 - view.mask) for view in views if view.mask is not None)
    for without_outlines in (two_masks, of_all_else):
        with pytest.raises(ReconstructionError, match="agree on only") as raised:
            match(without_outlines)
        assert raised.value.code == ErrorCode.NO_SURFACE
        assert "Check that the masks" in raised.value.remedy


@pytest.mark.parametrize("centre", [surface_points(np.array([[0.0, -1.0, 0.0]]))[0], CENTRE])
def test_a_given_region_that_holds_hardly_a_point_is_to_blame(centre: Float64[np.ndarray, "3"]) -> None:
    """Not the photographs: within the true region they agree on most of the surface."""
    region = replace(true_region(), object_from_world=to_unit_sphere(centre, 0.001), given=True)
    work = partial(match_views, config=StereoConfig(), device=torch.device("cpu"), progress=no_progress)
    told = hollows_filled(work(scene().views, region), region) or ""
    assert told.startswith("In the region that was given, of radius 0.001 around (")
    assert "Give a larger region" in told
    with pytest.raises(ReconstructionError, match=r"^In the region that was given") as raised:
        work(scene().without_masks().views, region)
    assert raised.value.remedy.startswith("Give a larger region")


def test_photographs_of_nothing_are_no_surface() -> None:
    """Even and noisy from side to side, without masks."""
    views = []
    for seed, view in enumerate(scene().without_masks().views):
        even = np.full_like(view.image_srgb, 0.5)
        views.append(noise(replace(view, image_srgb=even), seed))
    with pytest.raises(ReconstructionError) as raised:
        match(tuple(views))
    assert raised.value.code == ErrorCode.NO_SURFACE


def test_photographs_of_different_things_give_next_to_nothing() -> None:
    """The same cameras; the photographs are mirrored and shifted, each otherwise."""
    random = np.random.default_rng(3)
    views = []
    for view in scene().views:
        rolled = np.roll(view.image_srgb, tuple(random.integers(30, 60, 2)), axis=(0, 1))
        views.append(replace(view, image_srgb=np.ascontiguousarray(rolled[:, ::-1])))
    try:
        found = len(match(tuple(views)).points.positions)
    except ReconstructionError:
        found = 0
    assert found < 0.1 * len(matched().points.positions)


def test_an_outline_is_not_texture() -> None:
    """An even subject before an even backdrop, no masks: whatever is measured must be right."""
    views = photographed(arc_cameras(3, 30, 160), textured=False).without_masks().views
    try:
        apart = errors_percent(match(views))
    except ReconstructionError:
        return
    assert np.median(apart) < 1


def test_asking_for_more_agreement_gives_fewer_and_better_points() -> None:
    strict = StereoConfig(min_correlation=0.95)
    few = match_views(scene().views, true_region(), strict, device=torch.device("cpu"), progress=no_progress)
    assert len(few.points.positions) < 0.9 * len(matched().points.positions)
    assert np.quantile(errors_percent(few), 0.95) < np.quantile(errors_percent(matched()), 0.95)


# words


def test_progress_grows_and_may_cancel() -> None:
    told: list[float] = []

    def listen(fraction: float, _text: str) -> None:
        told.append(fraction)
        if len(told) == 2:
            raise Cancelled

    with pytest.raises(Cancelled):
        match_views(scene().views, true_region(), StereoConfig(), device=torch.device("cpu"), progress=listen)
    assert 0 <= told[0] < told[1] < 1
