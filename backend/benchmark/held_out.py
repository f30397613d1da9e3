"""How well a mesh's colours, or a radiance field, repeat photographs that it was not made from."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float32

from ..maths.metrics import psnr
from ..maths.raycast import RayCaster, render_mesh
from ..scene import Camera, SurfaceMesh, View, no_progress
from ..stages.cameras.solving import CamerasConfig
from ..stages.photos import PhotosConfig
from ..stages.published.radiance_field import restored
from ..stages.published.radiance_image import radiance_image
from ..stages.radiance import Radiance
from .one_by_one import solve
from .suites import Case

_Drawn = tuple[Float32[np.ndarray, "height width 3"], Bool[np.ndarray, "height width"]]
"""Colours, 0 or the background's where nothing is, and what is covered."""

MAX_SIDE_PX = 800
"""Photographs are compared at this size, whatever the preset."""


@dataclass(frozen=True, kw_only=True)
class HeldOutFit:
    """Means over the held-out views."""

    psnr_db: float | None
    """Where a view has a mask, over all of the mask: surface that is missing counts as black. Else over what
    the mesh covers. None where no view has a finite number."""
    covered_share: float
    """Of the mask, or of the picture where there is none."""


def known_views(case: Case, folder: Path, indices: tuple[int, ...]) -> tuple[View, ...]:
    """Photographs of a case with their known cameras, undistorted. Raises ReconstructionError."""
    assert case.cameras is not None
    return solve(case, folder, indices, PhotosConfig(max_side_px=MAX_SIDE_PX), CamerasConfig()).views


def held_out_fit(mesh: SurfaceMesh, views: Sequence[View]) -> HeldOutFit:
    """Colours of a mesh (world frame) against at least one view."""
    caster = RayCaster(mesh.vertices, mesh.faces)

    def draw(camera: Camera) -> _Drawn:
        image = render_mesh(mesh, camera, caster=caster)
        return image.colour_srgb, image.coverage

    return _mean_fit(draw, views)


def held_out_radiance_fit(radiance: Radiance, views: Sequence[View], device: torch.device) -> HeldOutFit:
    """The field's own pictures, not its mesh's, against at least one view; half opaque counts as covered."""
    field = restored(radiance, device)

    def draw(camera: Camera) -> _Drawn:
        image = radiance_image(field, radiance, camera, device=device, progress=no_progress)
        return image.colour_srgb, image.opacity > 0.5

    return _mean_fit(draw, views)


def _mean_fit(draw: Callable[[Camera], _Drawn], views: Sequence[View]) -> HeldOutFit:
    fits = [_fit(view, *draw(view.camera)) for view in views]
    finite = [value for value, _ in fits if value is not None and math.isfinite(value)]
    return HeldOutFit(
        psnr_db=sum(finite) / len(finite) if finite else None,
        covered_share=sum(share for _, share in fits) / len(fits),
    )


def _fit(
    view: View, colour_srgb: Float32[np.ndarray, "height width 3"], coverage: Bool[np.ndarray, "height width"]
) -> tuple[float | None, float]:
    """PSNR in dB and the share that is covered."""
    if view.mask is None:
        return psnr(view.image_srgb, colour_srgb, coverage), float(coverage.mean())
    inside = np.asarray(view.mask > 0.5)
    covered = float(coverage[inside].mean()) if inside.any() else 0.0
    return psnr(view.image_srgb, colour_srgb, inside), covered
