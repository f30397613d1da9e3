"""Outlines inside the subject: where one part of it hides another, photographs show a line.

Beside such a line, mostly one photograph alone sees what is behind, so nothing is measured there, and a
smooth field bridges the way from what is in front to what is behind: on all subjects that we looked at, most
of what is wrong is such a bridge. Where the line is, the photograph itself tells: pixels without a
measurement belong with those measured ones that a random walk finds which hardly ever crosses contrasts.
Where on one side of a line walks end much farther off than on the other, and the field lies before that,
nothing is there.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64
from scipy.ndimage import binary_erosion, binary_opening, label
from torch import Tensor

from ...maths.geometry import Pinhole
from ...maths.random_walk import WalkEnds, walk_ends
from ...scene import Decision
from ..measurements import Measurements
from .seen_field import at_size, averaged, seen_field, smaller

_PIXELS = 30_000
"""Of a picture that walks go over, at most: time grows faster than they do."""
_LEAST_CONFIDENCE = 0.1
"""Of a depth that a walk may end at."""
_BY_FIELD = 0.01
"""How readily a walk ends where nothing was measured, at the field's own depth, beside confidence; less where
the field turns away, for bridges do: nothing below a cosine of 0.3, all from 0.8 on."""
_USUAL = 0.85
"""Of the median difference between neighbouring pixels: what differs by as much is still alike."""
_LEAST_CONTRAST = 0.004
"""Of that, in sRGB values from 0 to 1: eight bits' steps."""
_STEP = 0.05
"""Between the depths at which walks from two neighbouring pixels end, in half widths of the grid, about a
fiftieth of the diagonal: a line parts them."""
_DOUBT = 0.7
"""How many spreads nearer the far side may be; and how steep it may rise towards the line."""
_MARGIN = 0.025
"""In half widths of the grid: by less, the field does not lie before what is behind."""
_THICK_PX = 3
"""What is narrower is where the line is, not what is beside it."""


@dataclass(frozen=True, kw_only=True)
class FarSide:
    """What a photograph tells to be empty beside lines inside the subject."""

    camera: Pinhole
    """Of a smaller picture."""
    depth: Float[Tensor, "height width"]
    """Along the axis, up to which a pixel's ray is empty; 0 where nothing is told."""


def far_sides(scene: Measurements, distance: Float[Tensor, "nodes nodes nodes"]) -> list[FarSide]:
    """For each photograph that knows its subject, where a field of the scene's frame bridges a gap."""
    views = zip(scene.cameras, scene.images, scene.certain, scene.depths, scene.confidences, strict=True)
    found = []
    for camera, image, outline, depth, confidence in views:
        if outline is None:
            continue
        small = smaller(camera, min(math.sqrt(_PIXELS / (camera.width * camera.height)), 1.0))
        seen = _seen(small, at_size(outline, small) < 0, distance)
        on = seen.depth > 0
        sure = at_size(confidence, small).cpu().numpy()
        measured = at_size(depth, small).cpu().numpy()
        is_known = (measured > 0) & (sure > _LEAST_CONFIDENCE)
        picture = averaged(image, small).permute(1, 2, 0).cpu().numpy()
        ends = walk_ends(
            picture,
            on,
            np.where(is_known, measured, seen.depth),
            np.where(is_known, sure, _BY_FIELD * seen.facing),
            contrast=_contrast(picture, on),
        )
        empty = _empty(ends, on, seen.depth, float(small.intrinsics[0, 0]))
        found.append(FarSide(camera=small, depth=torch.tensor(empty, device=distance.device)))
    return found


def decision(far: Sequence[FarSide]) -> Decision:
    """In how many photographs something was told, for the report."""
    told = sum(bool((side.depth > 0).any()) for side in far)
    what = "outlines inside the subject"
    if not far:
        return Decision(what=what, choice="left out", because="not asked for, or no silhouettes are known")
    because = f"in {told} of {len(far)} photographs a line parts near from far, and the field was a bridge"
    return Decision(what=what, choice="used" if told else "left out", because=because)


@dataclass(frozen=True, kw_only=True)
class _Seen:
    """A field as a camera sees it; 0 where it is missed or not looked at."""

    depth: Float64[np.ndarray, "height width"]
    """Along the axis."""
    facing: Float64[np.ndarray, "height width"]
    """0 where it turns away, 1 where it faces the camera."""


def _seen(
    camera: Pinhole, where: Bool[Tensor, "height width"], distance: Float[Tensor, "nodes nodes nodes"]
) -> _Seen:
    seen = seen_field(camera, where, distance)
    depth = torch.where(seen.hit, seen.depth, 0.0)
    facing = torch.where(seen.hit, ((seen.cosine - 0.3) / 0.5).clamp(0, 1).square(), 0.0)

    def as_picture(values: Float[Tensor, "pixels"]) -> Float64[np.ndarray, "height width"]:
        out = np.zeros(where.shape)
        out[where.cpu().numpy()] = values.cpu().numpy()
        return out

    return _Seen(depth=as_picture(depth), facing=as_picture(facing))


def _contrast(picture: Float32[np.ndarray, "height width 3"], on: Bool[np.ndarray, "height width"]) -> float:
    """How much neighbours on the subject may differ and still be alike: less than its texture does."""
    difference = np.linalg.norm(np.diff(picture, axis=1), axis=2)[on[:, 1:] & on[:, :-1]]
    usual = float(np.median(difference)) if len(difference) else 0.0
    return max(_USUAL * usual, _LEAST_CONTRAST)


def _empty(
    ends: WalkEnds,
    on: Bool[np.ndarray, "height width"],
    field_depth: Float64[np.ndarray, "height width"],
    focal_px: float,
) -> Float32[np.ndarray, "height width"]:
    """Depth up to which rays are empty, of pixels beside a line where the field lies before that; else 0."""
    rise = ends.distance_px * ends.mean / focal_px
    clear = ends.mean - _DOUBT * np.hypot(ends.spread, rise) - _MARGIN
    bridged = on & (clear > field_depth)  # never where an end is not a number
    pieces, _ = label(bridged, np.ones((3, 3)))
    beside = np.unique(pieces[_beyond_a_line(ends.mean) & binary_erosion(on, iterations=2)])
    kept = binary_opening(np.isin(pieces, beside[beside > 0]), np.ones((_THICK_PX, _THICK_PX)))
    return np.where(kept, clear, 0.0).astype(np.float32)


def _beyond_a_line(mean: Float64[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """The farther of each two pixels side by side, or one above the other, with a step between."""
    beyond = np.zeros(mean.shape, np.bool_)
    for grid, far in ((mean, beyond), (mean.T, beyond.T)):
        step = np.diff(grid, axis=1)
        far[:, 1:] |= step > _STEP
        far[:, :-1] |= step < -_STEP
    return beyond
