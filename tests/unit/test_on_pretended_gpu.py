"""What a GPU would refuse of stereo and fit, without one; with one there is test_on_gpu.py."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from backend.scene import StereoResult, no_progress
from backend.stages.stereo.config import StereoConfig
from backend.stages.stereo.multi_view_stereo import match_views
from backend.stages.surface import Surface
from backend.stages.train.render_fit import RenderConfig
from backend.stages.train.surface_fit import TrainConfig, fit_surface
from tests.pretended_gpu import GPU, PretendedGpu, RefusedError, claims
from tests.synthetic_scene import Scene, arc_cameras, photographed, true_region

CPU = torch.device("cpu")


@cache
def with_masks() -> Scene:
    return photographed(arc_cameras(3, 60, 96))


@cache
def before_a_wall() -> Scene:
    return photographed(arc_cameras(3, 60, 96), wall=True).without_masks()


def matched(scene: Scene, device: torch.device) -> StereoResult:
    return match_views(scene.views, true_region(), StereoConfig(), device=device, progress=no_progress)


def fitted(scene: Scene, stereo: StereoResult, config: TrainConfig, device: torch.device) -> Surface:
    chance = torch.Generator().manual_seed(0)
    given = (scene.views, true_region(), stereo, config)
    return fit_surface(*given, device=device, generator=chance, progress=no_progress)


@pytest.mark.parametrize(
    "work",
    [
        pytest.param(lambda there, here: there + here, id="two devices"),
        pytest.param(lambda there, here: torch.stack([here, there]), id="two devices in a list"),
        pytest.param(lambda there, here: torch.where(here > 0, there, 0.0), id="a condition of the CPU"),
        pytest.param(lambda there, here: np.asarray(there), id="numpy"),
        pytest.param(lambda there, here: there[1:].numpy(), id="a part to numpy"),
        pytest.param(lambda there, here: there.long() @ there.long(), id="product of whole numbers"),
        pytest.param(lambda there, here: there.double(), id="double precision"),
    ],
)
def test_a_pretended_gpu_refuses_what_a_gpu_does(work: Callable[[Tensor, Tensor], object]) -> None:
    with PretendedGpu():
        there, here = torch.ones(3, device=GPU), torch.ones(3)
        with pytest.raises(RefusedError):
            work(there, here)
        work(here, here)


def test_what_a_pretended_gpu_makes_is_there_until_it_is_moved() -> None:
    with PretendedGpu():
        there, here = torch.ones(3, device=GPU), torch.arange(3.0)
        made = (there + 1, there * here.sum(), there[here.long()], there.new_tensor([1.0]), here.to(GPU))
        assert all(part.device == GPU for part in (*made, *there.split(1), *there[None].max(dim=0)))
        assert not any(map(claims, (here, there.cpu(), here + 1)))
        there[0] = 5.0
        assert there.cpu().tolist() == [5, 1, 1]
        assert here.to(GPU).cpu().data_ptr() != here.data_ptr()
    assert there.device.type == "cpu"


@pytest.mark.slow
@pytest.mark.parametrize("scene", [with_masks, before_a_wall])
def test_stereo_and_fit_run_on_a_gpu_as_on_the_cpu(
    scene: Callable[[], Scene], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compiled and not, they round differently; a cell of 48 nodes is 0.04 of the frame's units."""
    # so that brightness is asked as well
    monkeypatch.setattr("backend.stages.train.looks.MOSTLY_TEXTURED", 1.0)
    config = TrainConfig(
        levels=(32, 48), rounds=(4, 4), steps=(0, 2), looks=(0, 2, 2), render=RenderConfig(rays=64)
    )
    here = matched(scene(), CPU)
    with PretendedGpu():
        there = matched(scene(), GPU)
    both = [(one.depth, other.depth) for one, other in zip(here.depth_maps, there.depth_maps, strict=True)]
    for one, other in both:
        shared = (one > 0) & (other > 0)
        assert shared.sum() > 0.9 * max((one > 0).sum(), (other > 0).sum()) > 1000
        assert np.median(np.abs(one - other)[shared]) < 1e-3
    expected = fitted(scene(), here, config, CPU)
    with PretendedGpu():
        found = fitted(scene(), here, config, GPU)
    choices = {decision.what: decision.choice for decision in found.decisions}
    assert choices["brightness without texture"] == "used"
    np.testing.assert_allclose(found.grid_from_world, expected.grid_from_world, atol=1e-3)
    apart = np.abs(found.distance - expected.distance)
    assert np.median(apart) < 1e-5
    assert np.quantile(apart, 0.99) < 1e-3
