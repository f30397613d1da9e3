"""What stereo compares: each view's part that shows the region, from full size to small."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from ...maths.angles import angles_between
from ...maths.backdrop import find_backdrop
from ...maths.correlation import PatchStatistics, patch_statistics, without_local_mean
from ...maths.geometry import Pinhole, pinhole_in_object, seen_places
from ...maths.rays import sphere_span
from ...scene import Region, View
from .config import StereoConfig

_TEXTURED = 6.0
"""Contrast of a patch, in deviations of noise, with which it is like no other; of all depths of one that has
less, some agrees by chance."""
_SAME_PLACE_DEG, _NARROW_DEG, _WIDE_DEG, _WIDEST_DEG = 0.5, 5.0, 45.0, 75.0
"""Between two views: that tell nothing of depth; that tell little; whose patches are slanted so much for each
other that they add nothing to what two nearer views tell; that are not compared at all."""
_DETOUR = 1.25
"""A view is between two others if the way past it is at most so many times as long."""


@dataclass(frozen=True, kw_only=True)
class Window:
    """One view's part that shows the region, at some size."""

    left: int
    """First column, in pixels of the view."""
    top: int
    pixel_size: int
    """In pixels of the view, along an axis: a power of two."""
    camera: Pinhole
    grey: Float[Tensor, "height width"]
    """Free of its local mean."""
    patches: PatchStatistics
    noise: float
    subject: Bool[Tensor, "height width"]
    surrounded: bool
    """Whether neither a mask nor an even backdrop parts the subject from what is around it."""

    @property
    def textured(self) -> Bool[Tensor, "height width"]:
        """Where patches are like no other."""
        return self.patches.variance > (_TEXTURED * self.noise) ** 2


def pyramid(view: View, region: Region, config: StereoConfig, device: torch.device) -> list[Window]:
    """The view's window at its first size, half, quarter, ... until all depths can be tried."""
    camera = pinhole_in_object(view.camera, region, device)
    colours = torch.tensor(view.image_srgb, device=device).permute(2, 0, 1)
    image = colours.mean(dim=0)
    subject = sees_region(camera)
    backdrop = None
    if view.mask is not None:
        subject &= torch.tensor(view.mask > 0.5, device=device)
    elif (backdrop := find_backdrop(colours, subject)) is not None:
        subject &= ~backdrop.empty
    left, top, width, height = _bounding_box(subject)
    camera = camera.cropped(left, top, width, height)
    grey = image[top : top + height, left : left + width]
    subject = subject[top : top + height, left : left + width]
    noise = config.noise * _exposure(grey)
    windows: list[Window] = []
    pixel_size = 1
    while True:
        is_last = grey.numel() <= config.coarse_pixels or min(grey.shape) < 64
        if pixel_size >= config.first_pixel_size or is_last:
            window = _window(grey, subject, camera, noise, config)
            surrounded = view.mask is None and backdrop is None
            windows.append(replace(window, left=left, top=top, pixel_size=pixel_size, surrounded=surrounded))
        if is_last:
            return windows
        pixel_size *= 2
        height, width = grey.shape[0] // 2, grey.shape[1] // 2
        even = grey[: 2 * height, : 2 * width]
        grey = F.avg_pool2d(even[None], 2)[0]
        share = F.avg_pool2d(subject[None, : 2 * height, : 2 * width].float(), 2)[0]
        subject = share > 0
        camera = camera.cropped(0, 0, 2 * width, 2 * height).scaled(width, height)


def whole_picture(view: View, region: Region, config: StereoConfig) -> Window:
    """The whole view at its own size as a window, with whatever it shows."""
    camera = pinhole_in_object(view.camera, region, torch.device("cpu"))
    grey = torch.tensor(view.image_srgb).mean(dim=2)
    everywhere = torch.ones_like(grey, dtype=torch.bool)
    return _window(grey, everywhere, camera, config.noise * _exposure(grey), config)


def _window(
    grey: Float[Tensor, "height width"],
    subject: Bool[Tensor, "height width"],
    camera: Pinhole,
    noise: float,
    config: StereoConfig,
) -> Window:
    """A whole picture at its own size, among surroundings."""
    flat = without_local_mean(grey, subject.float(), 2 * config.patch_radius)
    return Window(
        left=0,
        top=0,
        pixel_size=1,
        camera=camera,
        grey=flat,
        patches=patch_statistics(flat, subject.float(), config.patch_radius),
        noise=noise,
        subject=subject,
        surrounded=True,
    )


def _exposure(grey: Float[Tensor, "height width"]) -> float:
    """1 for a well exposed photograph, less for a dark one, whose noise is darker too."""
    bright = float(torch.quantile(grey.flatten()[:: max(1, grey.numel() // 100_000)], 0.99))
    return min(max(bright / 0.5, 0.25), 1.0)


def sees_region(camera: Pinhole) -> Bool[Tensor, "height width"]:
    """Pixels whose ray meets the unit sphere."""
    far = seen_places(camera, camera.intrinsics.new_ones(camera.height, camera.width)) - camera.position
    directions = F.normalize(far, dim=-1).reshape(-1, 3)
    entry, leave = sphere_span(camera.position.expand_as(directions), directions)
    return (leave > entry).reshape(far.shape[:2])


def _bounding_box(subject: Bool[Tensor, "height width"]) -> tuple[int, int, int, int]:
    """(left, top, width, height) around the pixels that are set, with room for patches; at least 16 px."""
    height, width = subject.shape
    rows = torch.nonzero(subject.any(dim=1)).flatten().tolist() or [0, height - 1]
    columns = torch.nonzero(subject.any(dim=0)).flatten().tolist() or [0, width - 1]
    top, bottom = max(rows[0] - 8, 0), min(rows[-1] + 9, height)
    left, right = max(columns[0] - 8, 0), min(columns[-1] + 9, width)
    return left, top, max(right - left, min(16, width)), max(bottom - top, min(16, height))


def neighbours(cameras: list[Pinhole], count: int) -> list[list[int]]:
    """For each view the others to compare with: similar direction, but not the same place.

    The wish is 5 to 25 degrees seen from the middle of the region. Pairs of more than 45 degrees, up to 75,
    are taken only until there are two: their patches agree less, and by chance as well.
    """
    angles_deg = _angles_deg(cameras)
    chosen: list[list[int]] = []
    for apart_deg in angles_deg:
        near: list[int] = []
        others = np.flatnonzero((apart_deg > _SAME_PLACE_DEG) & (apart_deg < _WIDEST_DEG)).tolist()
        for j in sorted(others, key=lambda j: _pair_cost(apart_deg[j])):
            if apart_deg[j] < _WIDE_DEG or sum(apart_deg[k] > _NARROW_DEG for k in near) < 2:
                near.append(j)
        chosen.append(near[:count])
    return chosen


def views_between(cameras: list[Pinhole], one: int, other: int) -> list[int]:
    """The views past which two others look at the region: about on the way from one to the other."""
    angles_deg = _angles_deg(cameras)
    way_deg = angles_deg[one] + angles_deg[other]
    return [
        k
        for k in range(len(cameras))
        if k not in (one, other) and way_deg[k] < _DETOUR * angles_deg[one, other]
    ]


def _angles_deg(cameras: list[Pinhole]) -> Float64[np.ndarray, "views views"]:
    """Between the views, seen from the middle of the region."""
    directions = F.normalize(torch.stack([camera.position for camera in cameras]), dim=-1)
    unit = directions.cpu().numpy().astype(np.float64)
    return np.asarray(np.degrees(angles_between(unit[:, None], unit[None])))


def _pair_cost(angle_deg: float) -> float:
    """Lowest at 12 degrees; twice as bad at half or double that."""
    return abs(math.log(angle_deg / 12.0))
