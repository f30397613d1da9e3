"""A few steps of each fit on a GPU: finite, and near what the CPU makes of the same chance."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch

from backend.scene import StereoResult, no_progress
from backend.stages.published.networks import HashConfig, NetworkConfig
from backend.stages.published.neus_fit import NeusConfig, fit_neus
from backend.stages.published.neus_losses import Sampling, Weights
from backend.stages.published.radiance_fit import RadianceConfig, fit_radiance
from backend.stages.stereo.config import StereoConfig
from backend.stages.stereo.multi_view_stereo import match_views
from backend.stages.surface import Surface
from backend.stages.train.surface_fit import TrainConfig, fit_surface
from tests.synthetic_scene import Scene, arc_cameras, photographed, true_region

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device here"),
]
NEUS = NeusConfig(
    steps=5, sampling=Sampling(rays=64, point_queries=100), network=NetworkConfig(layers=2), nodes=32
)
SPARSECRAFT = replace(
    NEUS,
    network=NetworkConfig(
        layers=1, hash_grid=HashConfig(levels=4), spherical_harmonics=True, albedo_and_specular=True
    ),
    weights=Weights(points=1.0),
)
FITS = [
    pytest.param(fit_surface, TrainConfig(levels=(32,), rounds=(5,), steps=(5,)), id="default"),
    pytest.param(fit_radiance, RadianceConfig(steps=5, rays=64, nodes=32), id="nerf"),
    pytest.param(fit_neus, NEUS, id="neus"),
    pytest.param(fit_neus, SPARSECRAFT, id="sparsecraft"),
]


@cache
def scene() -> Scene:
    return photographed(arc_cameras(5, 100, 128))


def stereo_on(device: str) -> StereoResult:
    kind = torch.device(device)
    return match_views(scene().views, true_region(), StereoConfig(), device=kind, progress=no_progress)


def fitted_on(device: str, fit: Callable[..., Surface], config: Any, stereo: StereoResult) -> Surface:
    """Chance is drawn on the CPU, whatever the device."""
    given = (scene().views, true_region(), stereo, config)
    chance = torch.Generator().manual_seed(0)
    return fit(*given, device=torch.device(device), generator=chance, progress=no_progress)


@pytest.mark.parametrize(("fit", "config"), FITS)
def test_a_fit_on_the_gpu_is_near_that_on_the_cpu(fit: Callable[..., Surface], config: Any) -> None:
    """In the frame's units, a cell of 32 nodes being 0.065: sums are taken in another order, no more."""
    stereo = stereo_on("cpu")
    here, there = (fitted_on(device, fit, config, stereo) for device in ("cpu", "cuda"))
    assert np.isfinite(there.distance).all()
    np.testing.assert_allclose(there.grid_from_world, here.grid_from_world, atol=1e-3)
    apart = np.abs(there.distance - here.distance)
    assert np.median(apart) < 1e-3
    assert np.quantile(apart, 0.99) < 2e-2


def test_depth_maps_on_the_gpu_are_near_those_on_the_cpu() -> None:
    here, there = stereo_on("cpu"), stereo_on("cuda")
    for one, other in zip(here.depth_maps, there.depth_maps, strict=True):
        both = (one.depth > 0) & (other.depth > 0)
        assert both.sum() > 0.95 * max((one.depth > 0).sum(), (other.depth > 0).sum()) > 0
        assert np.median(np.abs(one.depth - other.depth)[both]) < 1e-3
