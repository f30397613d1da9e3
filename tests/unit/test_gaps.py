"""A patch of the backdrop's colour is no gap where other photographs measure the surface."""

from dataclasses import replace
from functools import cache

import numpy as np
import torch
from jaxtyping import Bool

from backend.scene import DepthMap, SurfacePoints, no_progress, transform_points
from backend.stages.stereo.config import StereoConfig
from backend.stages.stereo.gaps import without_covered_patches
from backend.stages.stereo.multi_view_stereo import match_views
from tests.synthetic_scene import Scene, arc_cameras, photographed, plain_points, true_region

Patch = Bool[np.ndarray, "120 160"]
PATCH: Patch = np.hypot(*np.mgrid[-60:60, -80:80]) < 12
"""Within the subject of the first photograph."""


@cache
def scene() -> Scene:
    return photographed(arc_cameras(3, 30, 160)).without_masks()


@cache
def measured_by_all() -> SurfacePoints:
    """The true surface at every pixel of every photograph, in the region's object frame."""
    parts = []
    for index, (view, depth) in enumerate(zip(scene().views, scene().depths, strict=True)):
        rows, columns = np.nonzero(np.isfinite(depth))
        pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])
        in_camera = (np.linalg.solve(view.camera.intrinsics, pixels) * depth[rows, columns]).T
        world = transform_points(np.linalg.inv(view.camera.camera_from_world), in_camera)
        parts.append((transform_points(true_region().object_from_world, world), np.full(len(world), index)))
    positions, view_index = (np.concatenate(column) for column in zip(*parts, strict=True))
    return plain_points(positions, view_index=view_index)


def empty_in_first(patch: Patch, points: SurfacePoints) -> Patch:
    """What stays empty of the first photograph, which shows the backdrop and has a patch of its colour."""
    blank = np.zeros((120, 160), np.float32)
    maps = [
        DepthMap(depth=blank, confidence=blank, empty=~np.isfinite(depth), subject=None)
        for depth in scene().depths
    ]
    assert maps[0].empty is not None
    maps[0] = replace(maps[0], empty=maps[0].empty | patch)
    found = without_covered_patches(tuple(maps), points, scene().views, true_region())
    for before, after in zip(maps[1:], found[1:], strict=True):
        np.testing.assert_array_equal(after.empty, before.empty)
    assert found[0].empty is not None
    assert found[0].empty[maps[0].empty & ~patch].all()
    return found[0].empty & patch


def test_what_others_measure_is_no_gap() -> None:
    assert not empty_in_first(PATCH, measured_by_all()).any()


def test_where_others_measure_nothing_there_is_a_gap() -> None:
    """Of others, points that fall on the patch are left out, or all of those that are sure."""
    points = measured_by_all()
    of_first = points.view_index == 0
    alone = points.chosen(of_first)
    np.testing.assert_array_equal(empty_in_first(PATCH, alone), PATCH)
    unsure = replace(points, confidence=np.where(of_first, 1, 0.29).astype(np.float32))
    np.testing.assert_array_equal(empty_in_first(PATCH, unsure), PATCH)


def test_a_few_wrong_points_close_no_gap() -> None:
    points = measured_by_all()
    few = np.random.default_rng(0).random(len(points.positions)) < 0.02
    world = transform_points(true_region().world_from_object, points.positions.astype(np.float64))
    pixels = transform_points(scene().views[0].camera.camera_from_world, world)
    pixels = pixels @ scene().views[0].camera.intrinsics.T
    column, row = (pixels[:, :2] / pixels[:, 2:]).astype(int).clip(0, [159, 119]).T
    np.testing.assert_array_equal(empty_in_first(PATCH, points.chosen(few | ~PATCH[row, column])), PATCH)


def test_points_beside_a_narrow_gap_do_not_close_it() -> None:
    narrow = PATCH & (np.abs(np.arange(160) - 80) < 3)
    np.testing.assert_array_equal(empty_in_first(narrow, measured_by_all()), narrow)


def test_the_backdrop_around_the_subject_stays_empty() -> None:
    """A bay of it that others seem to cover; what is connected with the border is no patch."""
    bay: Patch = np.hypot(*np.mgrid[-60:60, -80:80]) < 30
    bay[60:] |= np.abs(np.arange(160) - 80) < 4
    np.testing.assert_array_equal(empty_in_first(bay, measured_by_all()), bay)


def test_a_highlight_that_one_photograph_shows_is_not_carved() -> None:
    views = list(scene().views)
    blown_out = views[0].image_srgb.copy()
    blown_out[PATCH] = 0.0  # the backdrop is black here
    views[0] = replace(views[0], image_srgb=blown_out)
    config, cpu = StereoConfig(), torch.device("cpu")
    found = match_views(tuple(views), true_region(), config, device=cpu, progress=no_progress)
    empty = found.depth_maps[0].empty
    assert empty is not None
    assert not empty[PATCH].any()
    assert empty[~np.isfinite(scene().depths[0])].mean() > 0.9
