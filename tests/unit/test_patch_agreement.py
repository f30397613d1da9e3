"""Agreement of patches at true and at wrong depths; the same compiled, in torch, and in whatever tiles."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from backend.maths.correlation import patch_statistics
from backend.stages.stereo import patch_agreement
from backend.stages.stereo.config import StereoConfig
from backend.stages.stereo.patch_agreement import agreement, in_torch
from backend.stages.stereo.windows import Window, pyramid
from tests.synthetic_scene import OBJECT_UNIT, Scene, arc_cameras, photographed, true_region


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


@pytest.mark.parametrize("num_sources", [1, 2])
@pytest.mark.parametrize("radius", [2, 3])
def test_compiled_as_in_torch(
    windows: list[Window], true_inverse_depth: Tensor, num_sources: int, radius: int
) -> None:
    patches = patch_statistics(windows[0].grey, windows[0].subject.float(), radius)
    window = replace(windows[0], patches=patches)
    depths = torch.cat(
        [
            hypotheses(true_inverse_depth),
            true_inverse_depth.new_tensor([0.1, 0.4, 3.0])[:, None, None].expand(3, *window.grey.shape),
        ]
    )
    asked = everywhere(window)
    compiled = agreement(window, windows[1 : 1 + num_sources], depths, asked)
    reference = in_torch(window, windows[1 : 1 + num_sources], depths, asked)
    assert (reference == -1).any()
    assert (compiled == -1).eq(reference == -1).all()
    # torch brings places to [-1, 1] and back: 1e-5 of a pixel, steep patches tell
    torch.testing.assert_close(compiled, reference, atol=3e-4, rtol=0)
    assert (compiled - reference).abs().mean() < 1e-5


@pytest.mark.parametrize("tile", [(1, 1), (7, 11), (1000, 1000)])
@pytest.mark.parametrize("threads", [1, 3])
def test_tiles_and_threads_do_not_change_it(
    windows: list[Window],
    true_inverse_depth: Tensor,
    monkeypatch: pytest.MonkeyPatch,
    tile: tuple[int, int],
    threads: int,
) -> None:
    asked = everywhere(windows[0])
    asked[30:, 40:] = False
    whole = agreement(windows[0], windows[1:], hypotheses(true_inverse_depth), asked)
    monkeypatch.setattr(patch_agreement, "_TILE", tile)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    in_tiles = agreement(windows[0], windows[1:], hypotheses(true_inverse_depth), asked)
    torch.testing.assert_close(in_tiles[:, asked], whole[:, asked], atol=1e-6, rtol=0)


@pytest.mark.parametrize("pixel", [(0, 0), (-1, -1), (40, 3), (57, 80)])
def test_single_pixels_may_be_asked(
    windows: list[Window], true_inverse_depth: Tensor, pixel: tuple[int, int]
) -> None:
    depths = hypotheses(true_inverse_depth)
    whole = agreement(windows[0], windows[1:], depths, everywhere(windows[0]))
    asked = torch.zeros_like(windows[0].subject)
    asked[pixel] = True
    alone = agreement(windows[0], windows[1:], depths, asked)
    torch.testing.assert_close(alone[:, *pixel], whole[:, *pixel], atol=1e-6, rtol=0)
    assert (alone != -1).any(dim=0).sum() <= 1


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e30, -1e30, -1.0])
def test_no_depth_reads_beside_a_picture(
    windows: list[Window], true_inverse_depth: Tensor, value: float
) -> None:
    """What is no depth agrees with nothing, and spoils what is beside it, no more."""
    depths = true_inverse_depth[None].clone()
    depths[0, :30] = value
    scores = agreement(windows[0], windows[1:], depths, everywhere(windows[0]))
    assert scores.isfinite().all()
    assert (scores[0, :30] <= 0.5).all()
    radius = windows[0].patches.radius
    untouched = agreement(windows[0], windows[1:], true_inverse_depth[None], everywhere(windows[0]))
    torch.testing.assert_close(scores[:, 30 + radius :], untouched[:, 30 + radius :], atol=1e-6, rtol=0)


def test_what_no_source_sees_agrees_with_nothing(windows: list[Window], true_inverse_depth: Tensor) -> None:
    """So near that all of it is seen beside the sources' pictures."""
    scores = agreement(windows[0], windows[1:], 50 * true_inverse_depth[None], windows[0].subject)
    assert (scores[0][windows[0].subject & (true_inverse_depth > 0)] == -1).all()
