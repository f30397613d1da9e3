"""Agreement of patches at true and at wrong depths; the same in whatever pieces it is computed."""

import numpy as np
import pytest
import torch
from torch import Tensor

from backend.stages import patch_agreement
from backend.stages.patch_agreement import agreement
from backend.stages.stereo_config import StereoConfig
from backend.stages.stereo_windows import Window, pyramid
from tests.synthetic_scene import SIZE, Scene, arc_cameras, photographed, true_region

OBJECT_UNIT = 1.2 * SIZE
"""Of the region's object frame, in world units."""


@pytest.fixture(scope="module")
def scene() -> Scene:
    return photographed(arc_cameras(3, 30, 160))


@pytest.fixture(scope="module")
def windows(scene: Scene) -> list[Window]:
    config, device = StereoConfig(), torch.device("cpu")
    return [pyramid(view, true_region(), config, device)[0] for view in scene.views]


@pytest.fixture(scope="module")
def true_inverse_depth(scene: Scene, windows: list[Window]) -> Tensor:
    """Of the first window; 0 off the body."""
    window = windows[0]
    height, width = window.grey.shape
    depth = scene.depths[0][window.top : window.top + height, window.left : window.left + width]
    return torch.tensor(np.where(np.isfinite(depth), OBJECT_UNIT / depth, 0), dtype=torch.float32)


def hypotheses(true_inverse_depth: Tensor) -> Tensor:
    """The truth, and a tenth nearer."""
    return torch.stack([true_inverse_depth, 1.1 * true_inverse_depth])


def everywhere(window: Window) -> Tensor:
    return torch.ones_like(window.subject)


def test_patches_agree_at_the_true_depth_and_not_off_it(
    scene: Scene, windows: list[Window], true_inverse_depth: Tensor
) -> None:
    scores = agreement(windows[0], windows[1:], hypotheses(true_inverse_depth), windows[0].subject)
    window = windows[0]
    height, width = window.grey.shape
    covered = torch.tensor(
        scene.coverage[0][window.top : window.top + height, window.left : window.left + width]
    )
    assert scores[0][covered].median() > 0.9
    assert scores[1][covered].median() < 0.4


@pytest.mark.parametrize("at_once", [1, 20_000])
def test_pieces_do_not_change_it(
    windows: list[Window], true_inverse_depth: Tensor, monkeypatch: pytest.MonkeyPatch, at_once: int
) -> None:
    asked = everywhere(windows[0])
    monkeypatch.setattr(patch_agreement, "_AT_ONCE", 2**30)
    whole = agreement(windows[0], windows[1:], hypotheses(true_inverse_depth), asked)
    monkeypatch.setattr(patch_agreement, "_AT_ONCE", at_once)
    in_pieces = agreement(windows[0], windows[1:], hypotheses(true_inverse_depth), asked)
    torch.testing.assert_close(in_pieces, whole, atol=1e-5, rtol=0)


@pytest.mark.parametrize("pixel", [(0, 0), (-1, -1), (40, 3), (57, 80)])
def test_single_pixels_may_be_asked(
    windows: list[Window], true_inverse_depth: Tensor, monkeypatch: pytest.MonkeyPatch, pixel: tuple[int, int]
) -> None:
    monkeypatch.setattr(patch_agreement, "_AT_ONCE", 1)
    depths = hypotheses(true_inverse_depth)
    whole = agreement(windows[0], windows[1:], depths, everywhere(windows[0]))
    asked = torch.zeros_like(windows[0].subject)
    asked[pixel] = True
    alone = agreement(windows[0], windows[1:], depths, asked)
    torch.testing.assert_close(alone[:, *pixel], whole[:, *pixel], atol=1e-5, rtol=0)
    assert (alone != -1).any(dim=0).sum() <= 1


def test_what_no_source_sees_agrees_with_nothing(windows: list[Window], true_inverse_depth: Tensor) -> None:
    """So near that all of it is seen beside the sources' pictures."""
    scores = agreement(windows[0], windows[1:], 50 * true_inverse_depth[None], windows[0].subject)
    assert (scores[0][windows[0].subject & (true_inverse_depth > 0)] == -1).all()
