"""Named settings as data: how much time a run takes, and for what detail."""

from dataclasses import dataclass
from types import MappingProxyType

from .stages.cameras import CamerasConfig
from .stages.photos import PhotosConfig
from .stages.region import RegionConfig
from .stages.stereo import StereoConfig


@dataclass(frozen=True, kw_only=True)
class Settings:
    """One config per stage."""

    photos: PhotosConfig = PhotosConfig()
    cameras: CamerasConfig = CamerasConfig()
    region: RegionConfig = RegionConfig()
    stereo: StereoConfig = StereoConfig()
    train: object = None
    mesh: object = None


PRESETS = MappingProxyType({"fast": Settings(), "balanced": Settings(), "detailed": Settings()})
