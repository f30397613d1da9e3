"""Multi-view stereo without CUDA: a depth map per photograph, then points that photographs agree on.

Per photograph: a plane sweep in inverse depth over the region at a coarse size, made smooth by
semi-global matching; then, finer and finer, a few hypotheses around planes fitted to the map so
far, so that every patch is compared along the slant of the surface it lies on; and what is measured
grows into what is not. A point is kept where another photograph's depth map puts the same point;
what only two photographs agree on is kept with a lower confidence, not dropped, and so is what only
smaller sizes of the photographs measure.
"""

import math
from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from ...errors import ErrorCode, ReconstructionError
from ...maths.backdrop import find_backdrop
from ...maths.geometry import pinhole_in_object, pixel_centres, sample_image, unproject
from ...maths.inverse_depth import fit_planes, normals_from_planes
from ...maths.texture import leverage
from ...scene import DepthMap, Progress, Region, StereoResult, SurfacePoints, View, within
from .bare_views import only_on_masks
from .config import StereoConfig
from .depth_maps import Measured, depth_maps
from .gaps import without_covered_patches
from .hanging import without_hanging
from .outlines_alone import FEWEST_POINTS, check_enough, no_points, outlines_alone
from .plane_sweep import AGREES_BETTER
from .strays import without_strays
from .windows import neighbours, pyramid, sees_region

_LEAST_BEHIND = 0.5
"""Correlation of patches behind the region from which on a pixel may show what is there."""


def match_views(
    views: tuple[View, ...], region: Region, config: StereoConfig, *, device: torch.device, progress: Progress
) -> StereoResult:
    """Depth maps and points of all views, object frame.

    Raises ReconstructionError(NO_SURFACE) if the photographs agree on next to nothing and hardly any has a
    mask; with masks there are no points then, and a decision says so. Raises PHOTO_UNREADABLE if one has
    values that are not numbers.
    """
    _check_pictures(views)
    with torch.no_grad():
        pyramids = [pyramid(view, region, config, device) for view in views]
        nearby = neighbours([sizes[0].camera for sizes in pyramids], config.num_sources)
        sizes = depth_maps(pyramids, nearby, config, within(progress, 0.0, 0.95))
        points = _points(views, sizes, config)
    full_size = tuple(_full_size(view, maps, region, config) for view, maps in zip(views, sizes, strict=True))
    full_size = without_covered_patches(full_size, points, views, region)
    found = only_on_masks(StereoResult(points=points, depth_maps=full_size), views, region)
    check_enough(found.points, views, region)
    if len(found.points.positions) < FEWEST_POINTS:
        return outlines_alone(found)
    return without_hanging(replace(found, points=without_strays(found.points)), views, region)


def _check_pictures(views: tuple[View, ...]) -> None:
    """Raises ReconstructionError(PHOTO_UNREADABLE) for values that are not numbers.

    They spoil what they are compared with, and the colours.
    """
    for view in views:
        if not np.isfinite(view.image_srgb).all():
            raise ReconstructionError(
                ErrorCode.PHOTO_UNREADABLE,
                f"The photograph {view.name} has pixels whose values are not numbers.",
                "Export it again, as JPEG, PNG or 16-bit TIFF.",
            )


def unmatched(views: tuple[View, ...]) -> StereoResult:
    """What stereo gives where it was not asked: no points, and depth maps in which nothing was measured."""
    blanks = (np.zeros((view.camera.height, view.camera.width), np.float32) for view in views)
    maps = (DepthMap(depth=blank, confidence=blank, empty=None, subject=None) for blank in blanks)
    return StereoResult(points=no_points(), depth_maps=tuple(maps))


def _points(views: tuple[View, ...], sizes: list[list[Measured]], config: StereoConfig) -> SurfacePoints:
    found = sum(int((measured.votes > 0).sum()) for maps in sizes for measured in maps)
    stride = max(1, math.ceil(found / config.max_points))
    parts: list[list[Tensor]] = []
    for index, (view, maps) in enumerate(zip(views, sizes, strict=True)):
        image = torch.tensor(view.image_srgb, device=maps[0].votes.device).permute(2, 0, 1)
        parts += [_points_of_map(index, image, measured, stride, config) for measured in maps]
    joined = [torch.cat(column).cpu().numpy() for column in zip(*parts, strict=True)]
    return SurfacePoints(
        positions=joined[0],
        normals=joined[1],
        colours_srgb=joined[2],
        confidence=joined[3],
        num_views=np.ceil(joined[4]).astype(np.int64),
        view_index=joined[5].astype(np.int64),
    )


def _points_of_map(
    index: int,
    image: Float[Tensor, "3 height width"],
    measured: Measured,
    stride: int,
    config: StereoConfig,
) -> list[Tensor]:
    """Positions, normals, colours, confidence, votes, and the view's number."""
    map_, votes = measured.map, measured.votes
    camera = map_.window.camera
    pixels = pixel_centres(camera.width, camera.height, votes.device)
    mask = votes > 0
    planes = fit_planes(map_.inverse_depth, mask * map_.score.clamp(min=0) ** 2, 3)
    normals = normals_from_planes(planes, camera)
    positions = unproject(camera, pixels, 1 / map_.inverse_depth.clamp(min=1e-6))
    direction = F.normalize(camera.position - positions, dim=-1)
    facing = (normals * direction).sum(dim=-1).clamp(min=0)
    confidence = _confidence(measured, config) * facing.sqrt()  # grazing views measure worse
    corner = pixels.new_tensor([map_.window.left, map_.window.top])
    colours = sample_image(image, (pixels * map_.window.pixel_size + corner)[None])[0].permute(1, 2, 0)
    mask = mask & (facing > 0.05) & _every(stride, mask)
    number = torch.full_like(votes, index)
    return [positions[mask], normals[mask], colours[mask], confidence[mask], votes[mask], number[mask]]


def _confidence(measured: Measured, config: StereoConfig) -> Float[Tensor, "height width"]:
    """Agreement of the patches; 0 where nothing is measured.

    Where two views agree it is half as much as where many do. It is less where the patches would agree as
    well at another depth, where their texture lies to one side, beside edges, and for large pixels.
    """
    window = measured.map.window
    agreement = measured.map.score.clamp(0, 1)
    certain = -torch.expm1(-0.7 * (measured.votes - 1).clamp(min=0))
    sharp = (measured.sharpness / config.full_sharpness).clamp(0, 1).sqrt()
    off_edge = measured.from_edge_px / (measured.from_edge_px + config.edge_doubt * config.patch_radius)
    confidence: Float[Tensor, "height width"] = measured.trust * agreement * certain * sharp * off_edge
    if config.free_leverage is not None:
        aside = leverage(window.grey, window.subject, config.patch_radius, window.noise)
        confidence = confidence * (config.free_leverage / aside).clamp(max=1)
    return confidence


def _every(stride: int, mask: Bool[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """One in `stride` of the pixels that are set, spread over rows and columns alike."""
    number = mask.flatten().cumsum(0).reshape(mask.shape)
    return mask & (number * 7919 % stride == 0)


def _full_size(view: View, maps: list[Measured], region: Region, config: StereoConfig) -> DepthMap:
    """What was measured at any size, over the whole photograph."""
    finest = maps[0].map
    window = finest.window
    width, height = (side * window.pixel_size for side in (window.camera.width, window.camera.height))
    pixels = pixel_centres(width, height, window.grey.device)
    inverse_depth, confidence = torch.ones_like(pixels[..., 0]), torch.zeros_like(pixels[..., 0])
    for measured in reversed(maps):
        at = (pixels / measured.map.window.pixel_size)[None]
        sure = sample_image(_confidence(measured, config)[None], at, mode="nearest")[0, 0]
        there = sample_image(measured.map.inverse_depth[None], at)[0, 0]
        inverse_depth = torch.where(sure > 0, there, inverse_depth)
        confidence = torch.where(sure > 0, sure, confidence)
    backdrop = None
    if view.mask is None:
        colours = torch.tensor(view.image_srgb, device=window.grey.device).permute(2, 0, 1)
        seen = sees_region(pinhole_in_object(view.camera, region, window.grey.device))
        backdrop = find_backdrop(colours, seen)
    agrees_behind = finest.behind > (finest.score + AGREES_BETTER).clamp(min=_LEAST_BEHIND)
    at = (pixels / window.pixel_size)[None]
    behind = sample_image(agrees_behind[None].float(), at, mode="nearest")[0, 0]
    whole = np.zeros((3, view.camera.height, view.camera.width), np.float32)
    depth = torch.where(confidence > 0, 1 / inverse_depth.clamp(min=1e-6), 0.0)
    known = torch.stack([depth, confidence, behind])
    whole[:, window.top : window.top + height, window.left : window.left + width] = known.cpu().numpy()
    depth_map, confidence_map, behind_map = whole
    return DepthMap(
        depth=depth_map,
        confidence=confidence_map,
        # a shadow may be as dark as the backdrop: what was measured is not empty
        empty=None if backdrop is None else backdrop.empty.cpu().numpy() & (depth_map == 0),
        subject=None if backdrop is None else backdrop.subject.cpu().numpy(),
        behind=behind_map > 0 if window.surrounded else None,
    )
