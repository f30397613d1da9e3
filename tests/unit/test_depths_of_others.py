"""Depths of other views: taken where a view has none and its patches agree, left alone elsewhere."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from backend.stages.stereo.config import StereoConfig
from backend.stages.stereo.depths_of_others import unconfirmed, with_depths_of
from backend.stages.stereo.plane_sweep import Map, inverse_depth_range, step_of_one_pixel
from backend.stages.stereo.windows import Window, pyramid
from tests.synthetic_scene import OBJECT_UNIT, arc_cameras, photographed, true_region

CONFIG = StereoConfig()
SCENE = photographed(arc_cameras(3, 30, 320))
LEFT, MIDDLE, RIGHT = (pyramid(view, true_region(), CONFIG, torch.device("cpu"))[0] for view in SCENE.views)


def truth(view: int, window: Window) -> Tensor:
    """Inverse depth; 0 off the body."""
    height, width = window.grey.shape
    part = SCENE.depths[view][window.top : window.top + height, window.left : window.left + width]
    return torch.tensor(OBJECT_UNIT / part, dtype=torch.float32)


def a_map(window: Window, inverse_depth: Tensor, score: float) -> Map:
    nothing = torch.zeros_like(window.grey)
    return Map(
        window=window, inverse_depth=inverse_depth, score=torch.full_like(nothing, score), behind=nothing
    )


def nothing_found() -> Map:
    """Of the middle view: all at the far end."""
    return a_map(MIDDLE, torch.full_like(MIDDLE.grey, inverse_depth_range(MIDDLE.camera)[1]), 0.1)


def true_map(score: float = 0.9) -> Map:
    """Of the view on the left."""
    return a_map(LEFT, truth(0, LEFT), score)


def nowhere(window: Window) -> Tensor:
    return torch.zeros_like(window.subject)


def of_the_left() -> list[Tensor]:
    """What it alone has found."""
    return [unconfirmed(true_map(), nowhere(LEFT), CONFIG)]


def test_what_another_view_found_is_found_as_well() -> None:
    """Within half a pixel of disparity, nearly everywhere that both see."""
    own = nothing_found()
    told = with_depths_of(own, nowhere(MIDDLE), of_the_left(), [LEFT, RIGHT], CONFIG)
    took = told.inverse_depth != own.inverse_depth
    step = step_of_one_pixel(MIDDLE, [LEFT, RIGHT], truth(1, MIDDLE).clamp(min=1e-3))
    off = (told.inverse_depth - truth(1, MIDDLE)).abs() / step
    on = MIDDLE.subject & MIDDLE.textured & (truth(1, MIDDLE) > 0)
    assert took[on].float().mean() > 0.8
    assert off[took].quantile(0.95) < 0.5
    assert (told.score > own.score)[took].all()
    assert (told.score > CONFIG.growth_correlation)[took].all()
    assert torch.equal(told.score[~took], own.score[~took])


def test_only_what_is_not_measured_is_asked() -> None:
    own, left_half = nothing_found(), nowhere(MIDDLE)
    left_half[:, : left_half.shape[1] // 2] = True
    told = with_depths_of(own, left_half, of_the_left(), [LEFT, RIGHT], CONFIG)
    took = told.inverse_depth != own.inverse_depth
    assert took.sum() > 5000
    assert not took[left_half].any()


@pytest.mark.parametrize("case", ["agrees already", "other is measured", "other agrees with nothing"])
def test_nothing_is_taken(case: str) -> None:
    own, other, measured = nothing_found(), true_map(), nowhere(LEFT)
    match case:
        case "agrees already":
            own = replace(own, score=torch.ones_like(own.score))
        case "other is measured":  # both have looked there, and the view has not found it for a reason
            measured = ~measured
        case "other agrees with nothing":
            other = true_map(0.4)
    told = with_depths_of(own, nowhere(MIDDLE), [unconfirmed(other, measured, CONFIG)], [LEFT, RIGHT], CONFIG)
    assert torch.equal(told.inverse_depth, own.inverse_depth)


def test_of_two_places_the_nearer_is_what_is_seen() -> None:
    """Another view that sees through to what is behind does not hide what stands before it."""
    own = nothing_found()
    behind = a_map(RIGHT, 0.93 * truth(2, RIGHT), 0.9)
    alone, beside = (
        with_depths_of(own, nowhere(MIDDLE), others, [LEFT, RIGHT], CONFIG)
        for others in (of_the_left(), [unconfirmed(behind, nowhere(RIGHT), CONFIG), *of_the_left()])
    )
    step = step_of_one_pixel(MIDDLE, [LEFT, RIGHT], truth(1, MIDDLE).clamp(min=1e-3))
    right = [
        ((m.inverse_depth - truth(1, MIDDLE)).abs() < 0.5 * step).float().mean() for m in (alone, beside)
    ]
    assert right[1] > 0.85 * right[0]


def test_alone_a_view_stays_as_it_is() -> None:
    own = nothing_found()
    assert with_depths_of(own, nowhere(MIDDLE), [], [], CONFIG) is own
