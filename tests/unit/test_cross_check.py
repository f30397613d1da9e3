"""Depth maps held against each other: who agrees, who denies, who says nothing; compiled as in torch."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from backend.kernels import side_by_side
from backend.maths.geometry import Pinhole, pinhole_in_object
from backend.stages.stereo.cross_check import cross_check, in_torch
from tests.synthetic_scene import OBJECT_UNIT, Scene, arc_cameras, photographed, true_region

LIMITS = {"least_score": 0.4, "largest_px": 1.0}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return photographed(arc_cameras(2, 20, 160))


@pytest.fixture(scope="module")
def cameras(scene: Scene) -> list[Pinhole]:
    return [pinhole_in_object(view.camera, true_region(), torch.device("cpu")) for view in scene.views]


@pytest.fixture(scope="module")
def true_depths(scene: Scene) -> list[Tensor]:
    """Inverse, in the object's unit; 0 off the body."""
    return [
        torch.tensor(np.where(np.isfinite(depth), OBJECT_UNIT / depth, 0), dtype=torch.float32)
        for depth in scene.depths
    ]


def sure(inverse_depth: Tensor) -> Tensor:
    """A map of which every pixel is trusted."""
    return torch.stack([inverse_depth, torch.ones_like(inverse_depth)])


def test_true_maps_agree_where_both_see_and_deny_where_one_is_wrong(
    scene: Scene, cameras: list[Pinhole], true_depths: list[Tensor]
) -> None:
    body = true_depths[0] > 0
    agrees, denies = cross_check(cameras[0], true_depths[0], cameras[1], sure(true_depths[1]), **LIMITS)
    assert agrees[body].float().mean() > 0.75
    assert denies[body].float().mean() < 0.25  # what the other does not see
    agrees, denies = cross_check(
        cameras[0], 1.05 * true_depths[0], cameras[1], sure(true_depths[1]), **LIMITS
    )
    assert agrees[body].float().mean() < 0.05
    assert denies[body].float().mean() > 0.9


def test_who_is_not_sure_says_nothing(cameras: list[Pinhole], true_depths: list[Tensor]) -> None:
    other = torch.stack([true_depths[1], torch.full_like(true_depths[1], 0.39)])
    agrees, denies = cross_check(cameras[0], true_depths[0], cameras[1], other, **LIMITS)
    assert not agrees.any()
    assert not denies.any()


def test_who_does_not_see_it_says_nothing(cameras: list[Pinhole], true_depths: list[Tensor]) -> None:
    """So near that all of it lies beside the other picture."""
    near = torch.full_like(true_depths[0], 50.0)
    agrees, denies = cross_check(cameras[0], near, cameras[1], sure(true_depths[1]), **LIMITS)
    assert not agrees.any()
    assert not denies.any()


@pytest.mark.parametrize("factor", [1.0, 0.995, 1.01, 0.5, 3.0])
@pytest.mark.parametrize("threads", [1, 3])
def test_compiled_as_in_torch(
    cameras: list[Pinhole],
    true_depths: list[Tensor],
    monkeypatch: pytest.MonkeyPatch,
    factor: float,
    threads: int,
) -> None:
    """But for pixels that lie on a limit."""
    monkeypatch.setattr(side_by_side, "BAND", 7)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    depth, other = factor * true_depths[0], sure(true_depths[1])
    other[1] = torch.rand(other[1].shape, generator=torch.Generator().manual_seed(0))
    compiled = cross_check(cameras[0], depth, cameras[1], other, **LIMITS)
    reference = in_torch(cameras[0], depth, cameras[1], other, **LIMITS)
    for one, two in zip(compiled, reference, strict=True):
        assert (one != two).float().mean() < 2e-4
    assert (reference[0] | reference[1]).any()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e30, -1.0])
def test_what_is_no_depth_is_not_agreed_with(
    cameras: list[Pinhole], true_depths: list[Tensor], value: float
) -> None:
    depth = true_depths[0].clone()
    depth[:30] = value
    agrees, _ = cross_check(cameras[0], depth, cameras[1], sure(true_depths[1]), **LIMITS)
    whole, _ = cross_check(cameras[0], true_depths[0], cameras[1], sure(true_depths[1]), **LIMITS)
    assert not agrees[:30].any()
    assert agrees[30:].equal(whole[30:])
    assert cross_check(cameras[0], true_depths[0], cameras[1], sure(depth), **LIMITS)[0].any()
