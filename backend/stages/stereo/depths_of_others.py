"""Depths that other views found, tried where a view has found none.

Of two views that see a face, one sees it better. What it finds there is a depth for the other as well, whose
own patches are narrow on that face and agree with nothing until they lean as it does; and only what both
find is a measurement.
"""

from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from ...maths.correlation import window_sum
from ...maths.geometry import Pinhole, inside, pixel_centres, project, unproject
from ...maths.inverse_depth import fit_planes
from .config import StereoConfig
from .patch_agreement import agreement
from .plane_sweep import AGREES_BETTER, Map, inverse_depth_range, step_of_one_pixel
from .windows import Window

_AROUND_PX = 2
"""Half the side of a window in which depths of another view are taken for one plane."""
_FEWEST = 3
"""Of them in it."""
_DEEP_PX = 4.0
"""Of the match: what lies farther behind the nearest of them is seen through the gaps between them."""


def unconfirmed(
    map_: Map, measured: Bool[Tensor, "height width"], config: StereoConfig
) -> Float[Tensor, "places 3"]:
    """Where a view's patches agree with some view, though no view has found the same; object frame."""
    where = map_.window.subject & ~measured & (map_.score > config.growth_correlation)
    camera = map_.window.camera
    pixels = pixel_centres(camera.width, camera.height, where.device)[where]
    return unproject(camera, pixels, 1 / map_.inverse_depth[where].clamp(min=1e-6))


def with_depths_of(
    own: Map,
    measured: Bool[Tensor, "height width"],
    others: list[Float[Tensor, "_places 3"]],
    sources: list[Window],
    config: StereoConfig,
) -> Map:
    """The map, with `unconfirmed` places of others where it has no depth and patches agree better there."""
    window = own.window
    if not others or not sources:
        return own
    nearest = _nearest_seen(window.camera, torch.cat(others))
    in_front = F.max_pool2d(nearest[None], 2 * _AROUND_PX + 1, stride=1, padding=_AROUND_PX)[0]
    behind = nearest < in_front - _DEEP_PX * step_of_one_pixel(window, sources, in_front)
    known = ((nearest > 0) & ~behind).float()
    asked = window.subject & window.textured & ~measured & (window_sum(known, _AROUND_PX) >= _FEWEST)
    if not asked.any():
        return own
    near, far = inverse_depth_range(window.camera)
    planes = fit_planes(nearest, known, _AROUND_PX)[0].clamp(far, near)
    tried = torch.where(asked, planes, own.inverse_depth)
    score = agreement(window, sources, tried[None], asked)[0]
    better = asked & (score > (own.score + AGREES_BETTER).clamp(min=config.growth_correlation))
    return replace(
        own,
        inverse_depth=torch.where(better, tried, own.inverse_depth),
        score=torch.where(better, score, own.score),
    )


def _nearest_seen(camera: Pinhole, places: Float[Tensor, "places 3"]) -> Float[Tensor, "height width"]:
    """Inverse depth of the nearest place that each pixel shows; 0 where it shows none."""
    pixels, depth = project(camera, places)
    seen = (depth > 0) & inside(pixels, camera.width, camera.height)
    column, row = pixels[seen].long().unbind(dim=-1)
    nearest = places.new_zeros(camera.height * camera.width)
    nearest.scatter_reduce_(0, row * camera.width + column, 1 / depth[seen], "amax")
    return nearest.view(camera.height, camera.width)
