"""The flat ground below a subject: found where it is one, told from the subject, and left out."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from jaxtyping import Bool, Float64
from scipy.ndimage import binary_dilation, binary_erosion

from backend.errors import Cancelled
from backend.maths.grid import node_positions
from backend.maths.raycast import camera_rays
from backend.scene import Camera, DepthMap, Ground, StereoResult, no_progress, transform_points
from backend.stages.measurements import carried, measurements
from backend.stages.stereo.config import StereoConfig
from backend.stages.stereo.ground import find_ground, told_of_ground, without_ground
from backend.stages.train.silhouettes import least_distance
from tests.synthetic_scene import (
    CENTRE,
    GROUND_Z,
    OBJECT_UNIT,
    Scene,
    camera_at,
    ground_distance,
    photographed,
    plain_points,
    true_region,
)

EYES = np.array([[-0.5, -2.0, 1.5], [0.5, -2.0, 1.5]])
GROUND = (GROUND_Z - CENTRE[2]) / OBJECT_UNIT
"""Its height in the object frame, whose axes are the world's."""


def disc(z: float, num: int = 3000, noise: float = 0.002) -> Float64[np.ndarray, "points 3"]:
    rng = np.random.default_rng(0)
    radius, angle = np.sqrt(rng.random(num)), 2 * np.pi * rng.random(num)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z + noise * rng.normal(size=num)], -1)


def ball(z: float, num: int = 1000) -> Float64[np.ndarray, "points 3"]:
    directions = np.random.default_rng(1).normal(size=(num, 3))
    return 0.3 * directions / np.linalg.norm(directions, axis=1, keepdims=True) + [0, 0, z]


def test_a_plane_with_something_on_it_is_ground() -> None:
    points = plain_points(np.concatenate([disc(-0.2), ball(0.1)]))
    for eyes in (EYES, EYES[::-1]):
        ground, because = find_ground(points, eyes)
        assert ground is not None
        np.testing.assert_allclose(ground.normal, [0, 0, 1], atol=2e-3)
        assert ground.offset == pytest.approx(-0.2, abs=1e-3)
        assert 0.004 < ground.thickness < 0.008  # three standard deviations
        assert because == ("of the points that are surely measured 75% lie on a plane and 25% above it")


@pytest.mark.parametrize(
    "positions",
    [
        pytest.param(ball(0.0), id="no plane"),
        pytest.param(disc(0.0), id="nothing on it"),
        pytest.param(np.concatenate([disc(0.3), ball(0.0)]), id="a lid: the rest is below"),
        pytest.param(np.concatenate([disc(2.0), ball(2.5)]), id="above the cameras"),
        pytest.param(disc(0.0, num=2), id="two points"),
        pytest.param(np.zeros((0, 3)), id="no points"),
    ],
)
def test_what_is_no_ground(positions: Float64[np.ndarray, "points 3"]) -> None:
    assert find_ground(plain_points(positions), EYES)[0] is None


def test_unsure_points_tell_no_ground() -> None:
    positions = np.concatenate([disc(-0.2), ball(0.1)])
    assert find_ground(plain_points(positions, confidence=0.1), EYES)[0] is None


@pytest.fixture(scope="module")
def scene() -> Scene:
    """The body on a textured ground, without masks."""
    cameras = [camera_at(azimuth, 2.5, 480) for azimuth in (-30.0, -10.0, 10.0, 30.0)]
    return photographed(cameras, ground=True, wall=True).without_masks()


@pytest.fixture(scope="module")
def stereo(scene: Scene) -> StereoResult:
    """All that is in the region is measured truly, but for what lies within 4 px of the body's outline."""
    maps, positions, views = [], [], []
    for index, (view, depth) in enumerate(zip(scene.views, scene.depths, strict=True)):
        origins, directions = camera_rays(view.camera)
        along_axis = directions @ view.camera.camera_from_world[2, :3]
        shown = np.minimum(depth.ravel(), ground_distance(origins, directions) * along_axis)
        met = np.isfinite(shown)
        world = origins + np.where(met, shown / along_axis, 0)[:, None] * directions
        places = transform_points(true_region().object_from_world, world)
        body = np.isfinite(depth)
        unknown = binary_dilation(body, iterations=4) & binary_dilation(~body, iterations=4)
        known = (met & (np.linalg.norm(places, axis=1) < 1)).reshape(depth.shape) & ~unknown
        measured = np.where(known, shown.reshape(depth.shape) / OBJECT_UNIT, 0).astype(np.float32)
        maps.append(DepthMap(depth=measured, confidence=known.astype(np.float32), empty=None, subject=None))
        positions.append(places[known.ravel()][::10])
        views.append(np.full(len(positions[-1]), index))
    points = plain_points(np.concatenate(positions), view_index=np.concatenate(views))
    return StereoResult(points=points, depth_maps=tuple(maps))


@pytest.fixture(scope="module")
def alone(scene: Scene, stereo: StereoResult) -> StereoResult:
    return without_ground(stereo, scene.views, true_region(), StereoConfig(), progress=no_progress)


def test_the_ground_is_where_it_is(alone: StereoResult) -> None:
    assert alone.ground is not None
    np.testing.assert_allclose(alone.ground.normal, [0, 0, 1], atol=1e-3)
    assert alone.ground.offset == pytest.approx(GROUND, abs=1e-3)
    assert alone.doubt is None
    assert [(d.what, d.choice) for d in alone.decisions] == [("ground", "left out")]


def test_its_points_are_gone_and_those_of_the_subject_stay(stereo: StereoResult, alone: StereoResult) -> None:
    before, after = stereo.points.positions, alone.points.positions
    assert alone.ground is not None
    low = before[:, 2] < GROUND + alone.ground.thickness
    assert 0.1 < low.mean() < 0.8
    np.testing.assert_array_equal(after, before[~low])
    np.testing.assert_array_equal(alone.points.view_index, stereo.points.view_index[~low])


def test_pixels_that_show_it_are_empty_up_to_the_subject_s_outline(scene: Scene, alone: StereoResult) -> None:
    """Also where nothing was measured: beside the outline, though body and ground look the same there."""
    for body, map_ in zip(scene.coverage, alone.depth_maps, strict=True):
        assert map_.empty is not None
        assert map_.subject is not None
        assert (map_.empty & body).sum() < 0.01 * body.sum()
        beside = binary_dilation(body, iterations=5) & ~body
        beside[: body.shape[0] * 6 // 10] = False  # below, where the ground is behind the outline
        assert (map_.empty & beside).sum() > 0.6 * beside.sum()
        assert (map_.subject & ~body).sum() < 0.01 * body.sum()
        assert (map_.subject & body).sum() > 0.6 * body.sum()
        assert not (map_.empty & map_.subject).any()
        assert not map_.depth[map_.empty].any()
        assert not map_.confidence[map_.empty].any()


def test_pixels_that_show_the_room_behind_are_empty_too(scene: Scene, stereo: StereoResult) -> None:
    """What of it has texture; a piece of the subject that is found again behind by chance stays."""
    maps, rooms, chances = [], [], []
    for view, body, map_ in zip(scene.views, scene.coverage, stereo.depth_maps, strict=True):
        on_ground = np.isfinite(ground_distance(*camera_rays(view.camera))).reshape(body.shape)
        rooms.append(~body & ~on_ground)
        row, column = np.argwhere(body).mean(axis=0).astype(int)
        chance = np.zeros_like(body)
        chance[row - 10 : row + 10, column - 10 : column + 10] = True
        measured = map_.measured_where(~binary_dilation(chance, iterations=2))
        chances.append(chance)
        maps.append(replace(measured, behind=binary_erosion(rooms[-1]) | chances[-1]))
    told = replace(stereo, depth_maps=tuple(maps))
    alone = without_ground(told, scene.views, true_region(), StereoConfig(), progress=no_progress)
    untold = without_ground(stereo, scene.views, true_region(), StereoConfig(), progress=no_progress)
    for room, body, chance, map_, before in zip(
        rooms, scene.coverage, chances, alone.depth_maps, untold.depth_maps, strict=True
    ):
        assert map_.empty is not None
        assert before.empty is not None
        assert (map_.empty & body).sum() < 0.01 * body.sum()
        assert not (map_.empty & chance).any()
        assert (map_.empty & room).sum() > 0.45 * room.sum() > 3 * (before.empty & room).sum()


@pytest.mark.parametrize("seen_through", [False, True])
def test_a_spot_amid_the_subject_is_ground_where_that_was_measured(
    seen_through: bool, scene: Scene, stereo: StereoResult
) -> None:
    """Plain cloth agrees with other photographs over any plane, where nothing was measured. Here a painting
    does that the first photograph shows on the body, or through a hole of the body.
    """
    places = [plane_places(view.camera) for view in scene.views]
    row, column = np.argwhere(scene.coverage[0]).mean(axis=0).astype(int)
    middle = places[0][row, column]
    radius = np.quantile(np.linalg.norm(places[0] - middle, axis=2), 0.003)
    painted = [np.linalg.norm(place - middle, axis=2) < radius for place in places]
    spot = painted[0]
    assert (spot <= scene.coverage[0]).all()
    views, maps = [], []
    for view, place, where, map_ in zip(scene.views, places, painted, stereo.depth_maps, strict=True):
        waves = 0.5 + 0.4 * np.prod(np.sin(12 * place / radius), axis=2, keepdims=True)
        image = np.where(where[..., None], waves, view.image_srgb).astype(np.float32)
        views.append(replace(view, image_srgb=image))
        maps.append(map_.measured_where(~where))
    if seen_through:
        maps[0] = measured_on_ground(maps[0], scene.views[0].camera, spot)
    painted_on = replace(stereo, depth_maps=tuple(maps))
    alone = without_ground(painted_on, tuple(views), true_region(), StereoConfig(), progress=no_progress)
    assert alone.depth_maps[0].empty is not None
    share = alone.depth_maps[0].empty[spot].mean()
    assert share > 0.8 if seen_through else share == 0


def measured_on_ground(map_: DepthMap, camera: Camera, where: Bool[np.ndarray, "height width"]) -> DepthMap:
    origins, directions = camera_rays(camera)
    along_axis = ground_distance(origins, directions) * (directions @ camera.camera_from_world[2, :3])
    depth = np.where(where, along_axis.reshape(where.shape) / OBJECT_UNIT, map_.depth).astype(np.float32)
    return replace(map_, depth=depth, confidence=np.where(where, 1, map_.confidence).astype(np.float32))


def plane_places(camera: Camera) -> Float64[np.ndarray, "height width 2"]:
    """Where each pixel's ray meets the ground, in the world; far off where it does not."""
    origins, directions = camera_rays(camera)
    distance = np.nan_to_num(ground_distance(origins, directions), posinf=1e3)
    met: Float64[np.ndarray, "rays 3"] = origins + distance[:, None] * directions
    return met[:, :2].reshape(camera.height, camera.width, 2)


@pytest.mark.parametrize("scale", [1.0, 1.5])
def test_below_it_nothing_is(scale: float, scene: Scene, alone: StereoResult) -> None:
    """In the region's frame and in one that is laid around a part of it."""
    measured = measurements(scene.views, true_region(), alone, torch.device("cpu"))
    frame_from_object = np.diag([scale, scale, scale, 1.0])
    frame_from_object[:3, 3] = [0.1, -0.2, 0.3]
    part = carried(measured, scene.views, true_region(), frame_from_object)
    part = replace(part, backdrops=[None] * len(scene.views))
    depth_below = scale * GROUND + 0.3 - node_positions(24, torch.device("cpu"))[..., 2]
    elsewhere = least_distance(replace(part, ground=None), 24)
    assert (depth_below > elsewhere + 0.1).any()
    expected = torch.maximum(depth_below, elsewhere)
    torch.testing.assert_close(least_distance(part, 24), expected, atol=2e-3, rtol=0)
    assert part.ground is not None
    assert alone.ground is not None
    assert part.ground.thickness == pytest.approx(scale * alone.ground.thickness)


def test_masks_say_what_the_subject_is(scene: Scene, stereo: StereoResult) -> None:
    views = tuple(replace(view, mask=np.ones_like(view.image_srgb[..., 0])) for view in scene.views)
    kept = without_ground(stereo, views, true_region(), StereoConfig(), progress=no_progress)
    assert kept.ground is None
    assert kept.doubt is not None
    assert "the photographs have masks" in kept.doubt
    assert kept.points is stereo.points


def test_ground_that_is_kept_is_told(scene: Scene, stereo: StereoResult) -> None:
    told = told_of_ground(stereo, scene.views, true_region())
    assert told.doubt is not None
    assert "Without Ground" in told.doubt
    assert [(d.what, d.choice) for d in told.decisions] == [("ground", "kept")]
    assert (told.points, told.depth_maps, told.ground) == (stereo.points, stereo.depth_maps, None)


def test_no_ground_is_told_of_that_masks_leave_out(scene: Scene, stereo: StereoResult) -> None:
    views = tuple(replace(view, mask=np.ones_like(view.image_srgb[..., 0])) for view in scene.views)
    assert told_of_ground(stereo, views, true_region()) is stereo


def test_a_wall_is_no_ground_to_be_told_of(scene: Scene, stereo: StereoResult) -> None:
    """The same photographs, taken with the camera on its side."""
    on_its_side = np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], np.float64)
    views = [
        replace(
            view, camera=replace(view.camera, camera_from_world=on_its_side @ view.camera.camera_from_world)
        )
        for view in scene.views
    ]
    assert told_of_ground(stereo, tuple(views), true_region()) is stereo


def test_without_ground_nothing_changes_but_the_user_is_told(scene: Scene, stereo: StereoResult) -> None:
    high = stereo.points.positions[:, 2] > GROUND + 0.05
    points = plain_points(stereo.points.positions[high].astype(np.float64))
    kept = without_ground(
        replace(stereo, points=points), scene.views, true_region(), StereoConfig(), progress=no_progress
    )
    assert kept.doubt is not None
    assert kept.doubt.startswith("There is no flat ground to leave out: ")
    assert (kept.ground, kept.depth_maps) == (None, stereo.depth_maps)


def test_it_can_be_stopped_between_photographs(scene: Scene, stereo: StereoResult) -> None:
    told: list[str] = []

    def stop_at_the_second(_share: float, text: str) -> None:
        told.append(text)
        if len(told) == 2:
            raise Cancelled

    with pytest.raises(Cancelled):
        without_ground(stereo, scene.views, true_region(), StereoConfig(), progress=stop_at_the_second)
    assert told == ["ground in photograph 1", "ground in photograph 2"]


def test_height_is_above_the_plane() -> None:
    ground = Ground(normal=np.array([0.0, 0.6, 0.8]), offset=0.5, thickness=0.01)
    assert ground.height(np.array([[0.0, 0.3, 0.4], [1.0, 0.6, 0.8]])) == pytest.approx([0.0, 0.5])
