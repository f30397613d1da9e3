"""Depths tried again: found where they were missed, left alone where they were measured or cannot be."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from backend.maths.raycast import RayCaster, camera_rays
from backend.scene import Camera, StereoResult, View, no_progress
from backend.stages.stereo.config import StereoConfig
from backend.stages.stereo.multi_view_stereo import match_views
from backend.stages.stereo.patch_agreement import agreement
from backend.stages.stereo.plane_sweep import (
    Map,
    better_of,
    inverse_depth_range,
    leaning,
    step_of_one_pixel,
    subject_of,
    swept_again,
)
from backend.stages.stereo.windows import Window, pyramid
from tests.synthetic_scene import (
    CENTRE,
    OBJECT_UNIT,
    SIZE,
    arc_cameras,
    camera_at,
    photographed,
    texture_srgb,
    true_region,
)

CONFIG = StereoConfig()


@cache
def windows() -> list[Window]:
    views = photographed(arc_cameras(3, 30, 320)).views
    return [pyramid(view, true_region(), CONFIG, torch.device("cpu"))[0] for view in views]


@cache
def truth() -> Tensor:
    """Inverse depth of the middle window; 0 off the body."""
    window, depth = windows()[1], photographed(arc_cameras(3, 30, 320)).depths[1]
    height, width = window.grey.shape
    part = depth[window.top : window.top + height, window.left : window.left + width]
    return torch.tensor(OBJECT_UNIT / part, dtype=torch.float32)


def half_right() -> tuple[Map, Tensor]:
    """Measured and true on the left of the middle; on the right at the far end, where nothing agrees."""
    window, known = windows()[1], torch.zeros_like(truth(), dtype=torch.bool)
    known[:, : known.shape[1] // 2] = True
    known &= window.subject
    far = torch.full_like(truth(), inverse_depth_range(window.camera)[1])
    one = Map(
        window=window,
        inverse_depth=torch.where(known, truth(), far),
        score=torch.where(known, 0.9, 0.1),
        behind=torch.zeros_like(truth()),
    )
    return one, known


def again(one: Map, known: Tensor, others: list[Window]) -> Map:
    subjects = [
        found for other in others if other.camera is not one.window.camera and (found := subject_of(other))
    ]
    return swept_again(one, known, [windows()[0], windows()[2]], subjects, CONFIG)


def test_what_was_missed_is_found_and_what_was_measured_is_left() -> None:
    """Within a pixel of disparity; planes that face the camera do not fit what turns away from it."""
    one, known = half_right()
    found = again(one, known, windows())
    step = step_of_one_pixel(one.window, [windows()[0], windows()[2]], truth().clamp(min=1e-3))
    textured = one.window.patches.variance.sqrt() > 6 * one.window.noise
    missed = one.window.subject & ~known & (truth() > 0) & textured
    right = (found.inverse_depth - truth()).abs() < step
    assert missed.sum() > 5000
    assert not ((one.inverse_depth - truth()).abs() < step)[missed].any()
    assert right[missed].float().mean() > 0.65
    assert (found.inverse_depth == one.inverse_depth)[known].float().mean() > 0.99
    # what took another's place agrees better, and as well as it says
    took = found.inverse_depth != one.inverse_depth
    assert (found.score > one.score + 0.04)[took].all()
    assert (found.score[took] > CONFIG.growth_correlation).all()


@pytest.mark.parametrize("seen", ["as it is", "off the subject", "only at its edge", "surrounded"])
def test_nothing_is_found_where_another_photograph_shows_that_nothing_is_there(seen: str) -> None:
    one, known = half_right()
    left, middle, right = windows()
    match seen:
        case "off the subject":
            right = replace(right, subject=torch.zeros_like(right.subject))
        case "only at its edge":  # two pixels off: so far cameras may be wrong
            right = replace(right, subject=right.subject.roll(2, 0) & right.subject)
        case "surrounded":
            right = replace(right, subject=torch.zeros_like(right.subject), surrounded=True)
    found = again(one, known, [left, middle, right])
    expected = again(one, known, windows())
    changed, usually = (int((map_.inverse_depth != one.inverse_depth).sum()) for map_ in (found, expected))
    assert usually > 5000
    assert changed == (0 if seen == "off the subject" else pytest.approx(usually, rel=0.001))


def without_texture(one: Map, known: Tensor) -> tuple[Map, Tensor]:
    """Five deviations of noise."""
    patches = replace(one.window.patches, variance=torch.full_like(truth(), (5 * one.window.noise) ** 2))
    return replace(one, window=replace(one.window, patches=patches)), known


def better_behind(one: Map, known: Tensor) -> tuple[Map, Tensor]:
    return replace(one, behind=torch.where(known, 0.0, 0.8)), known


def all_but_lines(one: Map, known: Tensor) -> tuple[Map, Tensor]:
    """Three pixels wide, as beside jumps."""
    known = one.window.subject & (torch.arange(known.shape[1]) % 20 > 2)
    return replace(one, score=torch.where(known, 0.9, 0.1)), known


def hardly_anything(one: Map, known: Tensor) -> tuple[Map, Tensor]:
    return one, known & (known.flatten().cumsum(0).view_as(known) < 50)


@pytest.mark.parametrize("change", [without_texture, better_behind, all_but_lines, hardly_anything])
def test_what_is_not_asked_stays_as_it_is(change) -> None:  # type: ignore[no-untyped-def]
    one, known = change(*half_right())
    assert torch.equal(again(one, known, windows()).inverse_depth, one.inverse_depth)


def test_alone_a_view_stays_as_it_is() -> None:
    one, known = half_right()
    assert swept_again(one, known, [], [], CONFIG) is one


def test_the_better_of_two_keeps_what_agreed_clearly_better() -> None:
    one, _ = half_right()
    after = torch.full_like(truth(), 0.6)
    before = after.clone()
    before[0], before[1] = 0.7, 0.62
    found = better_of(
        replace(one, score=before, inverse_depth=torch.full_like(truth(), 1.0)),
        replace(one, score=after, inverse_depth=torch.full_like(truth(), 2.0)),
    )
    assert (found.inverse_depth[0] == 1).all()
    assert (found.inverse_depth[1:] == 2).all()
    assert torch.equal(found.score[0], before[0])
    assert torch.equal(found.score[1:], after[1:])


# a board with a slot, and a wall behind it: what is narrow, and behind an edge on either side

SLOT = 0.065 * SIZE
"""Half its height: eight pixels."""
WALL_BEHIND = 0.7 * SIZE


def board_and_wall() -> RayCaster:
    """The board above and below the slot, and the wall behind it and beside it, across y."""
    y, width, height = CENTRE[1] - 0.3 * SIZE, 0.5 * SIZE, 0.6 * SIZE
    bands = [(y, width, SLOT, height), (y, width, -height, -SLOT)]
    bands.append((y + WALL_BEHIND, 1.6 * width, -height, height))
    corners = [
        [CENTRE[0] + side, depth, CENTRE[2] + z]
        for depth, wide, low, high in bands
        for side, z in ((-wide, low), (wide, low), (wide, high), (-wide, high))
    ]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return RayCaster(np.array(corners), np.concatenate([faces + 4 * k for k in range(len(bands))]))


def taken_of(caster: RayCaster, camera: Camera, index: int) -> tuple[View, np.ndarray, np.ndarray]:
    """The view, the number of the face that each pixel shows, -1 for none, and where; world frame."""
    origins, directions = camera_rays(camera)
    hits, shape = caster.cast(origins, directions), (camera.height, camera.width)
    image, places = np.zeros((len(origins), 3), np.float32), np.full((len(origins), 3), np.nan)
    places[hits.hit] = origins[hits.hit] + hits.distance[hits.hit, None] * directions[hits.hit]
    image[hits.hit] = texture_srgb(places[hits.hit])
    mask = hits.hit.reshape(shape).astype(np.float32)
    view = View(name=f"{index}.png", camera=camera, image_srgb=image.reshape(*shape, 3), mask=mask)
    return view, np.where(hits.hit, hits.face, -1).reshape(shape), places.reshape(*shape, 3)


def depth_of(camera: Camera, places: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Along the camera's axis, object units, where it is wanted; else not a number."""
    along = (places - camera.position) @ camera.camera_from_world[2, :3] / OBJECT_UNIT
    return np.where(wanted, along, np.nan)


def seen(camera: Camera, index: int) -> tuple[View, np.ndarray]:
    """The view, and the depth of the wall where it is seen through the slot."""
    view, face, places = taken_of(board_and_wall(), camera, index)
    x, _, z = np.moveaxis(np.abs(places - CENTRE), -1, 0)
    through = (face >= 4) & (z < 0.5 * SIZE) & (x < 0.35 * SIZE)
    return view, depth_of(camera, places, through)


def matched(views: tuple[View, ...], config: StereoConfig) -> StereoResult:
    return match_views(views, true_region(), config, device=torch.device("cpu"), progress=no_progress)


def test_what_lies_behind_a_slot_is_measured() -> None:
    cameras = [camera_at(azimuth, 0.0, 320) for azimuth in (-10, 0, 10)]
    views, depths = zip(*(seen(camera, i) for i, camera in enumerate(cameras)), strict=True)
    shares = []
    for sweep_again in (False, True):
        found = matched(
            views, StereoConfig(sweep_again=sweep_again, lean=0.0, coarse_pixels=5_000, min_piece_px=50)
        )
        through = [np.isfinite(depth) for depth in depths]
        assert min(there.sum() for there in through) > 300
        right = [
            (np.abs(map_.depth / depth - 1) < 0.01)[there]
            for map_, depth, there in zip(found.depth_maps, depths, through, strict=True)
        ]
        shares.append(float(np.concatenate(right).mean()))
    assert shares[1] > 2 * shares[0], shares
    assert shares[1] > 0.4, shares


def test_depths_that_are_found_agree_as_their_score_says() -> None:
    one, known = half_right()
    found = again(one, known, windows())
    took = found.inverse_depth != one.inverse_depth
    # where all around was found as well, its own depth at each pixel is about one plane
    scores = agreement(
        one.window, [windows()[0], windows()[2]], found.inverse_depth[None], one.window.subject
    )[0]
    assert (scores - found.score).abs()[took].median() < 0.1


# a face that turns away past a crease: no plane to grow from, and none of those that face the camera

TURNED_DEG = 64.0
"""Between the board and the face that goes back from its left side."""


def board_and_side() -> RayCaster:
    """They meet in an edge off the middle, along z."""
    turned = np.radians(TURNED_DEG)
    back = 1.1 * SIZE * np.array([-np.cos(turned), np.sin(turned)])
    edge = CENTRE[:2] - [0.05 * SIZE, 0.4 * SIZE]
    right = np.array([0.5 * SIZE, 0.0])
    ends = [edge + right, edge, edge + back]
    corners = [[*end, CENTRE[2] + z] for end in ends for z in (-0.5 * SIZE, 0.5 * SIZE)]
    return RayCaster(np.array(corners), np.array([[0, 2, 3], [0, 3, 1], [2, 4, 5], [2, 5, 3]]))


def seen_side(camera: Camera, index: int) -> tuple[View, np.ndarray]:
    """The view, and the depth of the face that turns away."""
    view, face, places = taken_of(board_and_side(), camera, index)
    return view, depth_of(camera, places, face >= 2)


def test_a_face_that_turns_away_past_a_crease_is_measured() -> None:
    """More than without such planes, and more than with as many that hardly lean."""
    views, depths = zip(
        *(seen_side(camera_at(azimuth, 0.0, 480), i) for i, azimuth in enumerate((-15, 10))), strict=True
    )
    shares = []
    for lean in (0.0, 1e-6, 0.7):
        found = matched(views, StereoConfig(lean=lean, coarse_pixels=20_000))
        right = [
            (np.abs(map_.depth / depth - 1) < 0.01)[np.isfinite(depth)]
            for map_, depth in zip(found.depth_maps, depths, strict=True)
        ]
        assert min(len(there) for there in right) > 1000
        shares.append(float(np.concatenate(right).mean()))
    assert shares[2] > 2 * shares[0], shares
    assert shares[2] > 1.4 * shares[1], shares


@pytest.mark.parametrize("lean", [(0.7, 0.0), (-0.7, 0.0), (0.0, 0.7), (0.4, -0.4)])
def test_leaning_planes_ask_each_pixel_for_each_depth_once(lean: tuple[float, float]) -> None:
    """And from a pixel to the next the match moves as they lean, but where they begin anew."""
    window = windows()[1]
    planes = torch.linspace(0.5, 0.9, 41)
    step, a_pixel = 0.01, 0.013
    tried = leaning(window, planes, planes, a_pixel, lean)
    assert tried.shape == (41, *window.grey.shape)
    assert (tried >= 0.5 - 1e-6).all()
    assert (tried <= 0.9 + step + 1e-6).all()
    in_order = tried.sort(dim=0).values
    torch.testing.assert_close(in_order.diff(dim=0), torch.full_like(in_order[1:], step), rtol=0, atol=1e-5)
    for slope, change in ((lean[0], tried.diff(dim=2)), (lean[1], tried.diff(dim=1))):
        goes_on = (change - slope * a_pixel).abs() < 1e-5
        assert goes_on.float().mean() > 0.97
        anew = (change - slope * a_pixel).abs() - 41 * step
        assert (anew[~goes_on].abs() < 1e-5).all()
