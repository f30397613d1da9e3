"""Depths that are tried one after another: all where images are small, and again where nothing was measured.

The first sweep sees little of what is narrow there, a recess or a bar behind an edge, and gives it the depth
of what stands before it. Refinement and growth change depths a little at a time and never cross such a jump.
Nor does it see a face that turns away, for its planes do not: such a face is grown into from beside it, but
past a crease there is nothing to grow from. So planes that lean are tried as well.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from ...maths.correlation import window_mean
from ...maths.geometry import (
    Pinhole,
    epipolar_map,
    inside,
    match_speed_px,
    pixel_centres,
    warp_pixels,
)
from ...maths.inverse_depth import lowest_with_neighbours
from ...maths.semi_global import aggregate
from .config import StereoConfig
from .patch_agreement import agreement
from .windows import Window

Lean = tuple[float, float]
"""How many pixels the match moves more from a pixel to the next on its right, and to the next below."""
UPRIGHT: Lean = (0.0, 0.0)
"""Of planes that face the camera: all of their match moves alike."""
_AT_A_TIME = 16
"""Planes that are compared before the next are thought of."""
_FARTHEST = 0.02
"""Of the inverse depth at the region's end: nothing farther off moves between photographs."""
AGREES_BETTER = 0.05
"""By that much it has to, at a depth that takes the place of another."""
_FEWEST_MEASURED = 100
"""Pixels, that say between which depths to look again."""
_SURELY_OFF_PX = 3
"""From the subject's outline in another photograph, of which cameras and masks may be a little wrong."""


@dataclass(frozen=True, kw_only=True)
class Map:
    """A depth map in the making."""

    window: Window
    inverse_depth: Float[Tensor, "height width"]
    score: Float[Tensor, "height width"]
    behind: Float[Tensor, "height width"]
    """How well patches agree behind the region, where that was better than anything in it; else 0."""


Subject = tuple[Pinhole, Bool[Tensor, "_rows _columns"]]
"""A photograph's camera, and the pixels on the subject or so near that cameras and masks may be wrong."""


def subject_of(window: Window) -> Subject | None:
    """None where nothing parts it from what is around it."""
    if window.surrounded:
        return None
    side = 2 * _SURELY_OFF_PX + 1
    near = F.max_pool2d(window.subject[None].float(), side, stride=1, padding=_SURELY_OFF_PX)[0] > 0
    return window.camera, near


def better_of(one: Map, other: Map) -> Map:
    """The other map, but the one's depths where patches agree clearly better."""
    kept = one.score > other.score + AGREES_BETTER
    return replace(
        other,
        inverse_depth=torch.where(kept, one.inverse_depth, other.inverse_depth),
        score=torch.where(kept, one.score, other.score),
    )


def sweep(window: Window, sources: list[Window], config: StereoConfig) -> Map:
    """Best plane of every pixel, after semi-global matching where asked for, to a fraction of a step."""
    if not sources:
        nothing = torch.zeros_like(window.grey)
        return Map(window=window, inverse_depth=nothing, score=nothing, behind=nothing)
    near, far = inverse_depth_range(window.camera)
    planes = _planes(window, _step(window, sources, far, near), far, near, config)
    score = torch.cat(list(_tried(window, sources, planes)))
    cost = (1 - score).permute(1, 2, 0).contiguous()
    if config.semi_global:
        gradient = window.grey.diff(dim=0, append=window.grey[-1:]).abs()
        gradient += window.grey.diff(dim=1, append=window.grey[:, -1:]).abs()
        large_step = 0.3 + 0.7 * torch.exp(-gradient / 0.04)
        cost = aggregate(cost, 0.08, large_step)
    index, offset = lowest_with_neighbours(cost)
    inverse_depth = planes[index] + offset * (planes[1] - planes[0])
    best = score.permute(1, 2, 0).gather(-1, index[..., None])[..., 0]
    behind = torch.zeros_like(best)
    if window.surrounded:
        # as many depths again: a pixel whose own is not among those tried agrees with another by chance
        farther = far - (planes - far)[1:]
        for scores in _tried(window, sources, farther[farther > _FARTHEST * far]):
            behind = behind.maximum(scores.max(dim=0).values)
        behind = torch.where(behind > score.max(dim=0).values, behind, 0.0)
    return Map(window=window, inverse_depth=inverse_depth, score=best, behind=behind)


def swept_again(
    current: Map,
    measured: Bool[Tensor, "height width"],
    sources: list[Window],
    subjects: list[Subject],
    config: StereoConfig,
    leans: Sequence[Lean] = (UPRIGHT,),
) -> Map:
    """The best plane of what is textured but not `measured`, of all between which anything is.

    Not off the `subjects` that other photographs show.
    """
    window, sure = current.window, measured & (current.score > config.growth_correlation)
    asked = window.subject & window.textured & ~sure & (current.behind == 0)
    # beside an edge, patches reach over it
    asked &= window_mean(asked.float(), torch.ones_like(window.grey), config.patch_radius) > 0.5
    if not sources or int(sure.sum()) < _FEWEST_MEASURED or not asked.any():
        return current
    far, near = np.quantile(current.inverse_depth[sure].cpu().numpy(), [0.001, 0.999])
    pixels = torch.nonzero(asked.flatten())[:, 0]
    score, inverse_depth = current.score.flatten().clone(), current.inverse_depth.flatten().clone()
    best = (score[pixels] + AGREES_BETTER).clamp(min=config.growth_correlation)
    a_pixel = _step(window, sources, far, near)
    planes = _planes(window, a_pixel, far, near, config)
    for lean, some in product(leans, torch.split(planes, _AT_A_TIME)):
        hypotheses = _over(window, some) if lean == UPRIGHT else leaning(window, some, planes, a_pixel, lean)
        tried, found = (
            values[:, asked] for values in (hypotheses, agreement(window, sources, hypotheses, asked))
        )
        plane, pixel = torch.nonzero(found > best, as_tuple=True)
        off = ~_may_be(window, subjects, pixels[pixel], tried[plane, pixel])
        found[plane[off], pixel[off]] = -1.0
        top, index = found.max(dim=0)
        better = top > best
        best = torch.where(better, top, best)
        score[pixels[better]] = top[better]
        inverse_depth[pixels[better]] = tried.gather(0, index[None])[0, better]
    return replace(
        current, inverse_depth=inverse_depth.view_as(window.grey), score=score.view_as(window.grey)
    )


def leaning(
    window: Window,
    some: Float[Tensor, "some_planes"],
    planes: Float[Tensor, "planes"],
    a_pixel: float,
    lean: Lean,
) -> Float[Tensor, "some_planes height width"]:
    """Inverse depths of some of the planes, leaning: all together, they ask each pixel for each depth once.

    Where one leaves the depths of all planes at their near end it comes in again at the far one. That is a
    jump, but on each plane at another place. `a_pixel` is the change of inverse depth that moves the match
    by a pixel.
    """
    far, step = planes[0], planes[1] - planes[0]
    pixels = pixel_centres(window.camera.width, window.camera.height, window.grey.device)
    moved = a_pixel * (lean[0] * pixels[..., 0] + lean[1] * pixels[..., 1])
    return far + (some[:, None, None] - far + moved).remainder(len(planes) * step)


def inverse_depth_range(camera: Pinhole) -> tuple[float, float]:
    """(nearest, farthest) inverse depth of the unit sphere, kept in front of the camera.

    Farther by up to a radius, where surroundings find room; no more, because seen through a long lens the
    sphere is a small share of its distance, and the steps are shared out over all that is searched.
    """
    middle = float(camera.camera_from_object[2, 3])
    nearest = max(middle - 1.0, 0.05 * (middle + 1.0), 1e-3)
    return 1 / nearest, 1 / max(middle + 1.0, min(2 * nearest, max(middle + 2.0, 2e-3)))


def step_of_one_pixel(
    window: Window, sources: list[Window], inverse_depth: Float[Tensor, "height width"]
) -> Float[Tensor, "height width"]:
    """The change of inverse depth that moves the match by one pixel in the source where it moves most."""
    pixels = pixel_centres(window.camera.width, window.camera.height, window.grey.device)
    speed = torch.zeros_like(window.grey)
    for source in sources:
        a, b = epipolar_map(source.camera, window.camera)
        speed = torch.maximum(speed, match_speed_px(a, b, pixels, inverse_depth))
    return 1 / speed.clamp(min=1e-6)


def _planes(
    window: Window, step: float, far: float, near: float, config: StereoConfig
) -> Float[Tensor, "planes"]:
    """Inverse depths from far to near, about a step apart."""
    count = int(np.clip(math.ceil((near - far) / step), 16, config.num_planes)) + 1
    return torch.linspace(far, near, count, device=window.grey.device)


def _step(window: Window, sources: list[Window], far: float, near: float) -> float:
    """The usual change of inverse depth that moves matches by a pixel in the source where they move most."""
    middle = torch.full_like(window.grey, (near + far) / 2)
    return min(float(step_of_one_pixel(window, [source], middle).median()) for source in sources)


def _over(window: Window, planes: Float[Tensor, "planes"]) -> Float[Tensor, "planes height width"]:
    return planes[:, None, None].expand(-1, *window.grey.shape)


def _tried(
    window: Window, sources: list[Window], planes: Float[Tensor, "planes"]
) -> Iterator[Float[Tensor, "some_planes height width"]]:
    """How well patches agree at every pixel at each inverse depth, a few of them at a time."""
    for first in range(0, len(planes), _AT_A_TIME):
        yield agreement(window, sources, _over(window, planes[first : first + _AT_A_TIME]), window.subject)


def _may_be(
    window: Window,
    subjects: list[Subject],
    pixels: Int64[Tensor, "pixels"],
    inverse_depth: Float[Tensor, "pixels"],
) -> Bool[Tensor, "pixels"]:
    """Whether places that pixels see are out of sight or at the subject in all other photographs."""
    everywhere = pixel_centres(window.camera.width, window.camera.height, window.grey.device)
    possible = torch.ones_like(pixels, dtype=torch.bool)
    for camera, near in subjects:
        a, b = epipolar_map(camera, window.camera)
        at = warp_pixels(a, b, everywhere.view(1, -1, 2)[:, pixels], inverse_depth[None, None])[0, 0]
        seen = inside(at, camera.width, camera.height)
        column, row = torch.where(seen[:, None], at, 0.0).long().unbind(dim=-1)
        possible &= near[row, column] | ~seen
    return possible
