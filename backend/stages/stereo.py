"""Multi-view stereo without CUDA: a depth map per photograph, then points that photographs agree on.

Per photograph: a plane sweep in inverse depth over the region at a coarse size, made smooth by
semi-global matching; then, finer and finer, a few hypotheses around planes fitted to the map so
far, so that every patch is compared along the slant of the surface it lies on. A point is kept
where another photograph's depth map puts the same point; what only two photographs agree on is
kept with a lower confidence, not dropped.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from ..errors import ErrorCode, ReconstructionError
from ..maths.backdrop import find_backdrop
from ..maths.correlation import (
    PatchStatistics,
    correlation,
    patch_statistics,
    window_mean,
    window_sum,
    without_local_mean,
)
from ..maths.geometry import (
    Pinhole,
    epipolar_map,
    inside,
    pinhole_in_object,
    pixel_centres,
    project,
    sample_image,
    unproject,
    warp_pixels,
)
from ..maths.inverse_depth import fit_planes, lowest_with_neighbours, normals_from_planes
from ..maths.semi_global import aggregate
from ..scene import Decision, Progress, Region, SurfacePoints, View


@dataclass(frozen=True, kw_only=True)
class StereoConfig:
    """How hard to look."""

    num_sources: int = 3
    """Photographs that each one is compared with, at most."""
    coarse_pixels: int = 50_000
    """Pixels of the window in which all depths are tried."""
    num_planes: int = 192
    """Depths tried there, at most."""
    patch_radius: int = 3
    """Half width of the patches, in pixels of the size at hand."""
    min_correlation: float = 0.3
    """Patches that agree less than this are not measurements."""
    max_reprojection_px: float = 1.0
    """How far a point may move when carried to another photograph's depth map and back."""
    max_points: int = 500_000
    """Points kept, evenly over all that are measured; depth maps keep every pixel."""
    noise: float = 1.2 / 255
    """Standard deviation of sensor and coding noise in a flat patch of a well exposed photograph."""


@dataclass(frozen=True, kw_only=True)
class DepthMap:
    """What one photograph measured; full image size, object frame."""

    depth: Float32[np.ndarray, "height width"]
    """Along the camera's axis, object units; 0 where nothing was measured."""
    confidence: Float32[np.ndarray, "height width"]
    """0 to 1."""
    empty: Bool[np.ndarray, "height width"] | None
    """Where the photograph, if it has no mask, shows nothing but an even backdrop; None where it has none."""
    subject: Bool[np.ndarray, "height width"] | None
    """Where something surely stands before that backdrop."""


@dataclass(frozen=True, kw_only=True)
class StereoResult:
    """Points of the surface and the depth maps they come from, one per view."""

    points: SurfacePoints
    depth_maps: tuple[DepthMap, ...]
    decisions: tuple[Decision, ...] = ()


@dataclass(frozen=True, kw_only=True)
class _Window:
    """One view's part that shows the region, at some size."""

    left: int
    """First column, in pixels of the view."""
    top: int
    camera: Pinhole
    grey: Float[Tensor, "height width"]
    """Free of its local mean."""
    patches: PatchStatistics
    noise: float
    subject: Bool[Tensor, "height width"]


@dataclass(frozen=True, kw_only=True)
class _Map:
    """A depth map in the making."""

    window: _Window
    inverse_depth: Float[Tensor, "height width"]
    score: Float[Tensor, "height width"]


def match_views(
    views: tuple[View, ...], region: Region, config: StereoConfig, *, device: torch.device, progress: Progress
) -> StereoResult:
    """Depth maps and points of all views, object frame.

    Raises ReconstructionError(NO_SURFACE) if the photographs agree on next to nothing.
    """
    with torch.no_grad():
        pyramids = [_pyramid(view, region, config, device) for view in views]
        neighbours = _neighbours([p[0].camera for p in pyramids], config.num_sources)
        maps = []
        for index, pyramid in enumerate(pyramids):
            progress(index / len(views) * 0.9, f"depth of {views[index].name}")
            maps.append(_depth_map(pyramid, [pyramids[n] for n in neighbours[index]], config))
        progress(0.9, "comparing depth maps")
        kept = [_agreement(i, maps, neighbours, config) for i in range(len(maps))]
        points = _points(views, maps, kept, config.max_points)
    _check_enough(points)
    depth_maps = tuple(
        _full_size(view, map_, agreed, region) for view, map_, agreed in zip(views, maps, kept, strict=True)
    )
    return StereoResult(points=points, depth_maps=depth_maps)


def _check_enough(points: SurfacePoints) -> None:
    if len(points.positions) < 100:
        raise ReconstructionError(
            ErrorCode.NO_SURFACE,
            f"The photographs agree on only {len(points.positions)} points of the surface.",
            "Take photographs that overlap by more than half, sharp and evenly lit; shiny, transparent "
            "or plain surfaces need masks, or some texture such as dust or chalk.",
        )


# --- windows -------------------------------------------------------------------------------------------


def _pyramid(view: View, region: Region, config: StereoConfig, device: torch.device) -> list[_Window]:
    """The view's window at full size, half, quarter, ... until all depths can be tried."""
    camera = pinhole_in_object(view.camera, region, device)
    colours = torch.tensor(view.image_srgb, device=device).permute(2, 0, 1)
    image = colours.mean(dim=0)
    subject = _sees_region(camera)
    if view.mask is not None:
        subject &= torch.tensor(view.mask > 0.5, device=device)
    elif (backdrop := find_backdrop(colours, subject)) is not None:
        subject &= ~backdrop.empty
    left, top, width, height = _bounding_box(subject)
    camera = camera.cropped(left, top, width, height)
    grey = image[top : top + height, left : left + width]
    subject = subject[top : top + height, left : left + width]
    noise = config.noise * _exposure(grey)
    windows = []
    while True:
        flat = without_local_mean(grey, subject.float(), 2 * config.patch_radius)
        patches = patch_statistics(flat, subject.float(), config.patch_radius)
        windows.append(
            _Window(
                noise=noise, left=left, top=top, camera=camera, grey=flat, patches=patches, subject=subject
            )
        )
        if grey.numel() <= config.coarse_pixels or min(grey.shape) < 64:
            return windows
        height, width = grey.shape[0] // 2, grey.shape[1] // 2
        even = grey[: 2 * height, : 2 * width]
        grey = F.avg_pool2d(even[None], 2)[0]
        share = F.avg_pool2d(subject[None, : 2 * height, : 2 * width].float(), 2)[0]
        subject = share > 0
        camera = camera.cropped(0, 0, 2 * width, 2 * height).scaled(width, height)


def _exposure(grey: Float[Tensor, "height width"]) -> float:
    """1 for a well exposed photograph, less for a dark one, whose noise is darker too."""
    bright = float(torch.quantile(grey.flatten()[:: max(1, grey.numel() // 100_000)], 0.99))
    return min(max(bright / 0.5, 0.25), 1.0)


def _sees_region(camera: Pinhole) -> Bool[Tensor, "height width"]:
    """Pixels whose ray meets the unit sphere."""
    pixels = pixel_centres(camera.width, camera.height, camera.intrinsics.device)
    far = unproject(camera, pixels, torch.ones_like(pixels[..., 0])) - camera.position
    direction = F.normalize(far, dim=-1)
    along = -(direction @ camera.position)
    closest = (camera.position + along[..., None] * direction).norm(dim=-1)
    meets: Bool[Tensor, "height width"] = (closest < 1.0) & (along > 0)
    return meets


def _bounding_box(subject: Bool[Tensor, "height width"]) -> tuple[int, int, int, int]:
    """(left, top, width, height) around the pixels that are set, with room for patches; at least 16 px."""
    height, width = subject.shape
    rows = torch.nonzero(subject.any(dim=1)).flatten().tolist() or [0, height - 1]
    columns = torch.nonzero(subject.any(dim=0)).flatten().tolist() or [0, width - 1]
    top, bottom = max(rows[0] - 8, 0), min(rows[-1] + 9, height)
    left, right = max(columns[0] - 8, 0), min(columns[-1] + 9, width)
    return left, top, max(right - left, min(16, width)), max(bottom - top, min(16, height))


def _neighbours(cameras: list[Pinhole], count: int) -> list[list[int]]:
    """For each view the others to compare with: similar direction, but not the same place.

    The wish is 5 to 25 degrees seen from the middle of the region; wider pairs are taken where there
    is nothing nearer, up to 75 degrees.
    """
    directions = F.normalize(torch.stack([camera.position for camera in cameras]), dim=-1)
    cosines = (directions @ directions.T).clamp(-1, 1)
    angles_deg = torch.rad2deg(torch.arccos(cosines))
    chosen = []
    for i in range(len(cameras)):
        costs = sorted(
            (_pair_cost(float(angles_deg[i, j])), j)
            for j in range(len(cameras))
            if j != i and 0.5 < float(angles_deg[i, j]) < 75
        )
        chosen.append([j for _, j in costs[:count]])
    return chosen


def _pair_cost(angle_deg: float) -> float:
    """Lowest at 12 degrees; twice as bad at half or double that."""
    return abs(math.log(angle_deg / 12.0))


# --- one depth map -------------------------------------------------------------------------------------


def _depth_map(pyramid: list[_Window], sources: list[list[_Window]], config: StereoConfig) -> _Map:
    coarsest = pyramid[-1]
    if not sources:
        empty = torch.zeros_like(coarsest.grey)
        return _Map(window=coarsest, inverse_depth=empty, score=empty)
    matched = [source[min(len(pyramid), len(source)) - 1] for source in sources]
    current = _sweep(coarsest, matched, config)
    current = _refine(current, matched, [1.0, 0.5], config)
    for level in range(len(pyramid) - 2, -1, -1):
        matched = [source[min(level, len(source) - 1)] for source in sources]
        current = _enlarged(current, pyramid[level])
        current = _refine(current, matched, [1.0, 0.5, 0.25] if level == 0 else [1.0, 0.5], config)
    return current


def _sweep(window: _Window, sources: list[_Window], config: StereoConfig) -> _Map:
    """Best plane of every pixel after semi-global matching, to a fraction of a step."""
    near, far = _inverse_depth_range(window.camera)
    maps = [epipolar_map(source.camera, window.camera) for source in sources]
    step = min(float(_step_of_one_pixel(window, [m], (near + far) / 2).median()) for m in maps)
    count = int(np.clip(math.ceil((near - far) / step), 16, config.num_planes)) + 1
    planes = torch.linspace(far, near, count, device=window.grey.device)
    chunks = [
        _scores(window, sources, chunk[:, None, None].expand(-1, *window.grey.shape), config)
        for chunk in planes.tensor_split(math.ceil(count / 16))
    ]
    score = torch.cat(chunks)
    gradient = window.grey.diff(dim=0, append=window.grey[-1:]).abs()
    gradient += window.grey.diff(dim=1, append=window.grey[:, -1:]).abs()
    large_step = 0.3 + 0.7 * torch.exp(-gradient / 0.04)
    cost = (1 - score).permute(1, 2, 0).contiguous()
    index, offset = lowest_with_neighbours(aggregate(cost, 0.08, large_step))
    inverse_depth = planes[index] + offset * (planes[1] - planes[0])
    best = score.permute(1, 2, 0).gather(-1, index[..., None])[..., 0]
    return _Map(window=window, inverse_depth=inverse_depth, score=best)


def _inverse_depth_range(camera: Pinhole) -> tuple[float, float]:
    """(nearest, farthest) inverse depth of the unit sphere, kept in front of the camera."""
    middle = float(camera.camera_from_object[2, 3])
    nearest = max(middle - 1.0, 0.05 * (middle + 1.0), 1e-3)
    return 1 / nearest, 1 / max(middle + 1.0, 2 * nearest)


def _step_of_one_pixel(
    window: _Window, maps: list[tuple[Tensor, Tensor]], inverse_depth: Float[Tensor, "height width"] | float
) -> Float[Tensor, "height width"]:
    """The change of inverse depth that moves the match by one pixel in the source where it moves most."""
    pixels = pixel_centres(window.camera.width, window.camera.height, window.grey.device)
    w = torch.as_tensor(inverse_depth, device=window.grey.device).expand(window.grey.shape)
    speed = torch.zeros_like(window.grey)
    for a, b in maps:
        here = warp_pixels(a, b, pixels, w[None])[0]
        there = warp_pixels(a, b, pixels, w[None] * 1.001)[0]
        speed = torch.maximum(speed, (there - here).norm(dim=-1) / (0.001 * w))
    return 1 / speed.clamp(min=1e-6)


def _scores(
    window: _Window,
    sources: list[_Window],
    inverse_depth: Float[Tensor, "planes height width"],
    config: StereoConfig,
) -> Float[Tensor, "planes height width"]:
    """Agreement of each pixel's patch with the sources, in [-1, 1].

    A soft maximum over sources: where one of them is hidden behind something, the others decide.
    """
    pixels = pixel_centres(window.camera.width, window.camera.height, window.grey.device)
    per_source = []
    for source in sources:
        a, b = epipolar_map(source.camera, window.camera)
        where = warp_pixels(a, b, pixels, inverse_depth)
        warped = sample_image(source.grey[None], where)[:, 0]
        score = correlation(window.patches, warped, max(window.noise, source.noise))
        seen = inside(where, source.camera.width, source.camera.height)
        per_source.append(torch.where(seen, score, -1.0))
    if len(per_source) == 1:
        return per_source[0]
    stacked = torch.stack(per_source)
    return (stacked * torch.softmax(stacked / 0.15, dim=0)).sum(dim=0)


def _refine(current: _Map, sources: list[_Window], steps_px: list[float], config: StereoConfig) -> _Map:
    """Five hypotheses around planes fitted to the map so far, once for each step width."""
    window = current.window
    maps = [epipolar_map(source.camera, window.camera) for source in sources]
    near, far = _inverse_depth_range(window.camera)
    offsets = torch.arange(-2, 3, device=window.grey.device)[:, None, None]
    for step_px in steps_px:
        middle = _smoothed(current, config.patch_radius)
        step = step_px * _step_of_one_pixel(window, maps, middle)
        hypotheses = (middle + offsets * step).clamp(far, near)
        score = _scores(window, sources, hypotheses, config)
        best = score.max(dim=0).values
        index, offset = lowest_with_neighbours(1 - score.permute(1, 2, 0))
        current = _Map(
            window=window,
            inverse_depth=(middle + (index - 2 + offset) * step).clamp(far, near),
            score=best,
        )
    return current


def _smoothed(current: _Map, radius: int) -> Float[Tensor, "height width"]:
    """Planes fitted to the better half of every neighbourhood; holes are filled from around."""
    median = _median(current.inverse_depth)
    weight = current.score.clamp(min=0.01) ** 2 * current.window.subject
    spread = window_mean((current.inverse_depth - median).abs(), current.window.subject.float(), radius)
    spread = spread.clamp(min=1e-6)
    weight = weight * torch.exp(-(((current.inverse_depth - median) / (2 * spread)) ** 2))
    value = fit_planes(median, weight, radius)[0]
    return torch.where(window_sum(weight, radius) > 1e-3, value, median)


def _median(values: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    """Median over 3x3."""
    padded = F.pad(values[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    height, width = values.shape
    shifted = [padded[r : r + height, c : c + width] for r in range(3) for c in range(3)]
    return torch.stack(shifted).median(dim=0).values


def _enlarged(current: _Map, window: _Window) -> _Map:
    """The map over the next larger window; sampled at the same places of the scene."""
    pixels = pixel_centres(window.camera.width, window.camera.height, window.grey.device)
    small = current.window.camera
    scale = pixels.new_tensor(
        [small.width / (window.camera.width // 2 * 2), small.height / (window.camera.height // 2 * 2)]
    )
    both = torch.stack([current.inverse_depth, current.score])
    inverse_depth, score = sample_image(both, (pixels * scale)[None])[0]
    return _Map(window=window, inverse_depth=inverse_depth, score=score)


# --- agreement and points --------------------------------------------------------------------------------


def _agreement(
    index: int, maps: list[_Map], neighbours: list[list[int]], config: StereoConfig
) -> Float[Tensor, "height width"]:
    """How many views agree with each pixel's depth (itself counted), 0 where it is not a measurement."""
    own = maps[index]
    pixels = pixel_centres(own.window.camera.width, own.window.camera.height, own.window.grey.device)
    points = unproject(own.window.camera, pixels, 1 / own.inverse_depth.clamp(min=1e-6))
    votes = torch.ones_like(own.inverse_depth)
    for other in range(len(maps)):
        if other == index or (other not in neighbours[index] and index not in neighbours[other]):
            continue
        votes += _confirms(points, pixels, own, maps[other], config)
    good = own.window.subject & (own.score > config.min_correlation) & (points.norm(dim=-1) < 1.0)
    return torch.where(good & (votes > 1), votes, 0.0)


def _confirms(
    points: Float[Tensor, "height width 3"],
    pixels: Float[Tensor, "height width 2"],
    own: _Map,
    other: _Map,
    config: StereoConfig,
) -> Bool[Tensor, "height width"]:
    """True where the other map's point, seen from here, falls on the pixel it came from and has its depth."""
    seen_at, depth = project(other.window.camera, points)
    ok = inside(seen_at, other.window.camera.width, other.window.camera.height) & (depth > 0)
    both = torch.stack([other.inverse_depth, other.score])
    inverse_depth, score = sample_image(both, seen_at[None])[0]
    there = unproject(other.window.camera, seen_at, 1 / inverse_depth.clamp(min=1e-6))
    back_at, back_depth = project(own.window.camera, there)
    moved = (back_at - pixels).norm(dim=-1)
    step = 1 / own.inverse_depth.clamp(min=1e-6)
    relative = (back_depth - step).abs() / step
    confirmed: Bool[Tensor, "height width"] = ok & (score > config.min_correlation - 0.1)
    confirmed &= (moved < config.max_reprojection_px) & (relative < 0.01)
    return confirmed


def _points(views: tuple[View, ...], maps: list[_Map], kept: list[Tensor], max_points: int) -> SurfacePoints:
    stride = max(1, math.ceil(sum(int((votes > 0).sum()) for votes in kept) / max_points))
    parts: list[list[Tensor]] = []
    for index, (view, map_, votes) in enumerate(zip(views, maps, kept, strict=True)):
        camera = map_.window.camera
        pixels = pixel_centres(camera.width, camera.height, votes.device)
        mask = votes > 0
        planes = fit_planes(map_.inverse_depth, mask * map_.score.clamp(min=0) ** 2, 3)
        normals = normals_from_planes(planes, camera)
        positions = unproject(camera, pixels, 1 / map_.inverse_depth.clamp(min=1e-6))
        direction = F.normalize(camera.position - positions, dim=-1)
        facing = (normals * direction).sum(dim=-1).clamp(min=0)
        confidence = _confidence(map_, votes) * facing.sqrt()  # grazing views measure worse
        image = torch.tensor(view.image_srgb, device=votes.device).permute(2, 0, 1)
        corner = pixels.new_tensor([map_.window.left, map_.window.top])
        colours = sample_image(image, (pixels + corner)[None])[0].permute(1, 2, 0)
        mask = mask & (facing > 0.05) & _every(stride, mask)
        number = torch.full_like(votes, index)
        parts.append(
            [positions[mask], normals[mask], colours[mask], confidence[mask], votes[mask], number[mask]]
        )
    joined = [torch.cat(column).cpu().numpy() for column in zip(*parts, strict=True)]
    return SurfacePoints(
        positions=joined[0],
        normals=joined[1],
        colours_srgb=joined[2],
        confidence=joined[3],
        num_views=joined[4].astype(np.int64),
        view_index=joined[5].astype(np.int64),
    )


def _confidence(map_: _Map, votes: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    """Agreement of the patches; where only two views agree, half as much as where many do."""
    confidence: Float[Tensor, "height width"] = map_.score.clamp(0, 1) * -torch.expm1(-0.7 * (votes - 1))
    return confidence


def _every(stride: int, mask: Bool[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """One in `stride` of the pixels that are set, spread over rows and columns alike."""
    number = mask.flatten().cumsum(0).reshape(mask.shape)
    return mask & (number * 7919 % stride == 0)


def _full_size(view: View, map_: _Map, votes: Float[Tensor, "height width"], region: Region) -> DepthMap:
    """The window's measurements over the whole photograph."""
    backdrop = None
    if view.mask is None:
        colours = torch.tensor(view.image_srgb, device=votes.device).permute(2, 0, 1)
        backdrop = find_backdrop(colours, _sees_region(pinhole_in_object(view.camera, region, votes.device)))
    measured = votes > 0
    depth = np.zeros((view.camera.height, view.camera.width), np.float32)
    height, width = votes.shape
    part = np.s_[map_.window.top : map_.window.top + height, map_.window.left : map_.window.left + width]
    confidence = np.zeros_like(depth)
    depth[part] = torch.where(measured, 1 / map_.inverse_depth.clamp(min=1e-6), 0.0).cpu().numpy()
    confidence[part] = torch.where(measured, _confidence(map_, votes), 0.0).cpu().numpy()
    return DepthMap(
        depth=depth,
        confidence=confidence,
        # a shadow may be as dark as the backdrop: what was measured is not empty
        empty=None if backdrop is None else backdrop.empty.cpu().numpy() & (depth == 0),
        subject=None if backdrop is None else backdrop.subject.cpu().numpy(),
    )
