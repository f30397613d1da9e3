"""Beside photographs with masks, those without measure only what lies on the masks."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from backend.errors import ErrorCode, ReconstructionError
from backend.maths.beside_mask import from_mask_px, on_and_beside_mask
from backend.scene import DepthMap, StereoResult, View, no_progress, transform_points
from backend.stages.stereo.bare_views import only_on_masks
from backend.stages.stereo.config import StereoConfig
from backend.stages.stereo.multi_view_stereo import match_views
from tests.synthetic_scene import (
    CENTRE,
    SIZE,
    Scene,
    arc_cameras,
    photographed,
    plain_points,
    surface_points,
    true_region,
)

BESIDE = CENTRE + SIZE * np.array([[0.0, 0.0, 1.3], [1.15, 0.45, 0.36]])
"""World frame: above all pictures, and beside the body in one of the first three."""


@pytest.fixture(scope="module")
def scene() -> Scene:
    return photographed(arc_cameras(4, 60, 160))


def front() -> np.ndarray:
    directions = np.random.default_rng(0).normal(size=(50, 3))
    return surface_points(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def stereo_of(scene: Scene) -> StereoResult:
    """On the body and beside it, measured by the last photograph, and beside it by the first."""
    world = np.concatenate([front(), BESIDE, BESIDE])
    view_index = np.array([3] * 52 + [0, 0])
    in_object = transform_points(true_region().object_from_world, world)
    unit = true_region().radius_world
    maps = []
    for depth in scene.depths:
        known = np.where(np.isfinite(depth), depth / unit, 0).astype(np.float32)
        known[:5] = scene.depths[0][np.isfinite(scene.depths[0])].min() / unit  # above the body
        maps.append(DepthMap(depth=known, confidence=(known > 0) * np.float32(0.5), empty=None, subject=None))
    return StereoResult(points=plain_points(in_object, view_index=view_index), depth_maps=tuple(maps))


def bare(views: tuple[View, ...], which: list[int]) -> tuple[View, ...]:
    return tuple(replace(view, mask=None) if i in which else view for i, view in enumerate(views))


def test_one_of_these_places_is_beside_one_mask_alone(scene: Scene) -> None:
    beside = [
        on_and_beside_mask(view.camera, from_mask_px(view.mask), BESIDE)[1]
        for view in scene.views[:3]
        if view.mask is not None
    ]
    np.testing.assert_array_equal(np.sum(beside, axis=0), [0, 1])


def test_what_lies_beside_the_masks_is_left_out_of_the_bare_one(scene: Scene) -> None:
    stereo = stereo_of(scene)
    kept = only_on_masks(stereo, bare(scene.views, [3]), true_region())
    expected = np.delete(stereo.points.positions, [50, 51], axis=0)
    np.testing.assert_array_equal(kept.points.positions, expected)
    before, after = stereo.depth_maps[3], kept.depth_maps[3]
    assert not after.depth[:5].any()
    assert not after.confidence[:5].any()
    body = scene.coverage[3]
    assert (after.depth[body] > 0).mean() > 0.98
    assert set(np.unique(after.depth[body] - before.depth[body])) <= {0.0, *-before.depth[body]}
    for index in range(3):
        assert kept.depth_maps[index] is stereo.depth_maps[index]
    (decision,) = kept.decisions
    assert decision.choice == "2 of 54 points left out"


@pytest.mark.parametrize("which", [[], [0, 1, 2, 3], [1, 2, 3]])
def test_where_all_have_masks_or_fewer_than_two_it_stays(scene: Scene, which: list[int]) -> None:
    stereo = stereo_of(scene)
    assert only_on_masks(stereo, bare(scene.views, which), true_region()) is stereo


def test_where_hardly_anything_lies_on_masks_there_is_no_surface(scene: Scene) -> None:
    """Two masks of a corner in which nothing is, and two photographs that measure the body."""
    corner = np.zeros((120, 160), np.float32)
    corner[:12, :12] = 1
    masks = (corner, corner, None, None)
    views = tuple(replace(view, mask=mask) for view, mask in zip(scene.views, masks, strict=True))
    with pytest.raises(ReconstructionError) as raised:
        match_views(views, true_region(), StereoConfig(), device=torch.device("cpu"), progress=no_progress)
    assert raised.value.code == ErrorCode.NO_SURFACE
