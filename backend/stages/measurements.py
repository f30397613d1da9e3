"""All that photographs and stereo say, as tensors in one frame: what the field is fitted to."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int64, Shaped
from torch import Tensor

from ..maths.geometry import Pinhole, pinhole_in_object
from ..maths.silhouette import outline_distance_px
from ..scene import Ground, Region, StereoResult, View

SURE = 0.3
"""Confidence of a depth that carves, or that opens a scene at the pictures' edges.

Off edges that is two photographs that agree to 0.6, or three to 0.4.
"""


@dataclass(frozen=True, kw_only=True)
class Measurements:
    """The views and points as tensors."""

    cameras: list[Pinhole]
    images: list[Float[Tensor, "3 height width"]]
    masks: list[Float[Tensor, "height width"] | None]
    outlines: list[Float[Tensor, "height width"] | None]
    """Signed distance to the mask's outline in pixels, > 0 off the subject."""
    backdrops: list[Float[Tensor, "height width"] | None]
    """The same for an empty backdrop where there is no mask: > 0 on it; what is not on it may be anything."""
    certain: list[Float[Tensor, "height width"] | None]
    """The same, < 0 where the subject surely is."""
    depths: list[Float[Tensor, "height width"]]
    """Along the axes; 0 where nothing was measured."""
    confidences: list[Float[Tensor, "height width"]]
    """Of these, 0 to 1."""
    positions: Float[Tensor, "points 3"]
    normals: Float[Tensor, "points 3"]
    colours: Float[Tensor, "points 3"]
    confidence: Float[Tensor, "points"]
    view_index: Int64[Tensor, "points"]
    """Which view measured each point."""
    region_centre: Float[Tensor, "3"]
    region_radius: float
    ground: Ground | None = None
    """Below it there is nothing; None where none was left out."""

    @property
    def sure_depths(self) -> list[Float[Tensor, "height width"]]:
        """Depths sure enough to call what lies before them empty; 0 elsewhere."""
        maps = zip(self.depths, self.confidences, strict=True)
        return [torch.where(confidence > SURE, depth, 0.0) for depth, confidence in maps]


def measurements(
    views: tuple[View, ...], region: Region, stereo: StereoResult, device: torch.device
) -> Measurements:
    """Everything measured, in the region's object frame."""
    points = stereo.points
    outlines = [_outline_or_none(view.mask, device) for view in views]
    empty = [None if m.empty is None else ~m.empty for m in stereo.depth_maps]
    subject = [_outline_or_none(m.subject, device) for m in stereo.depth_maps]
    cameras = [pinhole_in_object(view.camera, region, device) for view in views]
    positions, normals, view_index = (
        torch.tensor(values, device=device)
        for values in (points.positions, points.normals, points.view_index)
    )
    return Measurements(
        cameras=cameras,
        images=[torch.tensor(view.image_srgb, device=device).permute(2, 0, 1) for view in views],
        backdrops=[_outline_or_none(known, device) for known in empty],
        certain=[on if o is None else o for o, on in zip(outlines, subject, strict=True)],
        masks=[None if v.mask is None else torch.tensor(v.mask, device=device) for v in views],
        outlines=outlines,
        depths=[torch.tensor(map_.depth, device=device) for map_ in stereo.depth_maps],
        confidences=[torch.tensor(map_.confidence, device=device) for map_ in stereo.depth_maps],
        positions=positions,
        normals=_towards_their_views(normals, positions, cameras, view_index),
        colours=torch.tensor(points.colours_srgb, device=device),
        confidence=torch.tensor(points.confidence, device=device),
        view_index=view_index,
        region_centre=torch.zeros(3, device=device),
        region_radius=1.0,
        ground=stereo.ground,
    )


def carried(
    scene: Measurements,
    views: tuple[View, ...],
    region: Region,
    frame_from_object: Float64[np.ndarray, "4 4"],
) -> Measurements:
    """The measurements of the views in the region's object frame, in a frame without rotation against it.

    Where the world's origin is, far off perhaps, has no part in how points are carried.
    """
    device = scene.positions.device
    scale = float(frame_from_object[0, 0])
    middle = torch.tensor(frame_from_object[:3, 3], dtype=torch.float32, device=device)
    ground = scene.ground
    if ground is not None:
        offset = scale * ground.offset + float(ground.normal @ frame_from_object[:3, 3])
        ground = replace(ground, offset=offset, thickness=scale * ground.thickness)
    return replace(
        scene,
        cameras=[pinhole_in_object(view.camera, region.part(frame_from_object), device) for view in views],
        depths=[depth * scale for depth in scene.depths],
        positions=scene.positions * scale + middle,
        region_centre=middle,
        region_radius=scale,
        ground=ground,
    )


def _towards_their_views(
    normals: Float[Tensor, "points 3"],
    positions: Float[Tensor, "points 3"],
    cameras: list[Pinhole],
    view_index: Int64[Tensor, "points"],
) -> Float[Tensor, "points 3"]:
    """Normals on the side of the view that measured the point, for what it shows is an outside.

    Without that, normals of which half are turned round tear the surface, the more the more there are.
    """
    eyes = torch.stack([camera.position for camera in cameras])[view_index]
    inwards = ((eyes - positions) * normals).sum(dim=-1) < 0
    return torch.where(inwards[:, None], -normals, normals)


def _outline_or_none(
    mask: Shaped[np.ndarray, "height width"] | None, device: torch.device
) -> Float[Tensor, "height width"] | None:
    return None if mask is None else torch.tensor(_outline(mask.astype(np.float32)), device=device)


def _outline(mask: Float32[np.ndarray, "height width"]) -> Float32[np.ndarray, "height width"]:
    """Signed distance in pixels to where the mask crosses one half; > 0 off the subject."""
    on = mask > 0.5
    if on.all() or not on.any():
        return np.where(on, -1e4, 1e4).astype(np.float32)
    return outline_distance_px(on).astype(np.float32)
