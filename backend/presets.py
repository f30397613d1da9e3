"""Named settings as data: how much time a run takes, and for what detail."""

import math
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from .stages.cameras.solving import CamerasConfig
from .stages.mesh.extraction import MeshConfig
from .stages.mesh.texture import TextureConfig
from .stages.photos import PhotosConfig
from .stages.published.networks import HashConfig, NetworkConfig
from .stages.published.neus_fit import NeusConfig
from .stages.published.neus_losses import Sampling, Weights
from .stages.published.radiance_fit import RadianceConfig
from .stages.region import RegionConfig
from .stages.report import ReportConfig
from .stages.stereo.config import StereoConfig
from .stages.train.linear_fit import LinearConfig
from .stages.train.surface_fit import TrainConfig


@dataclass(frozen=True, kw_only=True)
class Settings:
    """One config per stage; the type of `train` says what is fitted."""

    photos: PhotosConfig = field(default_factory=PhotosConfig)
    cameras: CamerasConfig = field(default_factory=CamerasConfig)
    region: RegionConfig = field(default_factory=RegionConfig)
    stereo: StereoConfig | None = field(default_factory=StereoConfig)
    """None where what is fitted does not ask for points."""
    train: TrainConfig | RadianceConfig | NeusConfig = field(default_factory=TrainConfig)
    mesh: MeshConfig = field(default_factory=MeshConfig)
    report: ReportConfig = field(default_factory=ReportConfig)


_SPARSECRAFT = NeusConfig(
    network=NetworkConfig(layers=1, colour_layers=3, hash_grid=HashConfig(), albedo_and_specular=True),
    sampling=Sampling(rays=128, uniform=16, rounds=2),
    weights=Weights(points=1.0),
    learning_rate=1e-2,
    warm_up=0.0,
    constant=0.5,
    last_rate=0.1,
    exponential=True,
    slope_annealed_at=1.0,
)

PRESETS = MappingProxyType(
    {
        "fast": Settings(
            photos=PhotosConfig(max_side_px=800),
            stereo=StereoConfig(
                first_pixel_size=2,
                num_sources=2,
                coarse_pixels=15_000,
                growth_rounds=(1, 2, 2),
                free_leverage=1.2,
                trust_of_half_size=0.63,
            ),
            train=TrainConfig(
                levels=(32, 64, 96),
                rounds=(10, 10, 5),
                looks=(0, 3, 2),
                detail=0,
                linear=LinearConfig(settled=0.01),
            ),
            mesh=MeshConfig(max_faces=25_000, texture=TextureConfig(max_photo_px=1600)),
        ),
        "balanced": Settings(photos=PhotosConfig(max_side_px=1024)),
        "detailed": Settings(
            photos=PhotosConfig(max_side_px=1600),
            train=TrainConfig(
                levels=(32, 64, 128, 192), rounds=(15, 15, 10, 10), steps=(0, 0, 0, 0), detail=320
            ),
            mesh=MeshConfig(max_faces=200_000, texture=TextureConfig(max_photo_px=4096, max_side_px=8192)),
        ),
        "nerf": Settings(photos=PhotosConfig(max_side_px=800), stereo=None, train=RadianceConfig()),
        "neus": Settings(photos=PhotosConfig(max_side_px=800), stereo=None, train=NeusConfig()),
        "sparsecraft": Settings(
            photos=PhotosConfig(max_side_px=800),
            train=_SPARSECRAFT,
        ),
        "neus-published": Settings(
            photos=PhotosConfig(max_side_px=1600),
            stereo=None,
            train=NeusConfig(
                steps=300_000,
                network=NetworkConfig(
                    width=256,
                    layers=8,
                    features=256,
                    colour_layers=4,
                    frequencies=6,
                    longest_wave=2 * math.pi,
                    direction_frequencies=4,
                ),
                sampling=Sampling(rays=512, uniform=64, rounds=4, per_round=16),
                learning_rate=5e-4,
                sharpness_rate=5e-3,
                constant=1 / 60,
                nodes=512,
            ),
            mesh=MeshConfig(max_faces=200_000),
        ),
        "sparsecraft-published": Settings(
            photos=PhotosConfig(max_side_px=1600),
            train=replace(
                _SPARSECRAFT,
                steps=4000,
                network=replace(
                    _SPARSECRAFT.network,
                    features=13,
                    spherical_harmonics=True,
                    hash_grid=HashConfig(levels=32, finest=2048, most_rows=2**19),
                ),
                sampling=Sampling(rays=1024, uniform=64, rounds=4, per_round=16, point_queries=5000),
                nodes=512,
            ),
            mesh=MeshConfig(max_faces=200_000),
        ),
    }
)
"""By name; the names are those of backend.wire.protocol.PRESETS."""
