"""The flat ground that a subject stands on, left out where the user wants the subject alone.

A table or a rug is measured like all else, and without masks nothing tells it from the subject but this: most
of it lies on a plane, and nothing lies below. Once the plane is known, photographs tell which pixels show it,
for there they agree with each other over the plane, and edges of the picture tell where it ends. Such a pixel
says what one off a mask says: along its ray there is nothing of the subject. So does one that shows what
lies behind the region, as stereo found.
"""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from scipy.ndimage import (
    binary_closing,
    binary_erosion,
    distance_transform_edt,
    gaussian_gradient_magnitude,
    label,
    uniform_filter,
)
from skimage.segmentation import expand_labels, watershed

from ...maths.angles import angles_between
from ...maths.geometry import Pinhole, pixel_centres, ray_directions, seen_places
from ...maths.plane_fit import plane_under_most
from ...maths.projection import up_of
from ...scene import (
    Decision,
    DepthMap,
    Ground,
    Progress,
    Region,
    StereoResult,
    SurfacePoints,
    View,
    transform_points,
)
from ..measurements import SURE
from .config import StereoConfig
from .patch_agreement import agreement
from .windows import Window, neighbours, whole_picture

_TOLERANCE = 0.01
"""Of the region's radius, from the plane: so far from it points make it the ground's."""
_ASKED = 2000
"""Of the sure points: so many tell the plane as well as all."""
_LEAST_SHARE = 0.06
"""Of the sure points, that lie on the ground: less are the lowest parts of something round. Measured: 0.12
below a body that fills the pictures, 0.45 of a table, 0.75 of bananas on a rug."""
_MOST_BELOW = 0.2
"""Points below the ground for each on it: more, and it is a side of the subject. What stands on a box has the
box's sides below: of a carton one point for seventeen on it."""
_LEAST_ABOVE = 0.02
"""Of the sure points: less, and there is no subject on it."""
_SPREADS = 3.0
"""Heights up to so many standard deviations of the ground's own are the ground's."""
_MOST_TILTED_DEG = 20.0
"""From level, for ground to be spoken of. Measured: tables and rugs 0.4 to 3, walls and what photographs that
were taken on the side show 71 to 91."""
_FINEST = 0.005
"""Of the region's radius: lower is the ground's, however flat that is."""

_NUM_SOURCES = 4
"""Photographs in which a pixel's place on the plane is looked at; the subject hides it in some."""
_AGREES = 0.6
"""Correlation of patches over the plane from which on a pixel may show it."""
_AROUND_PX, _TEXTURED_SHARE, _AGREEING_SHARE = 15, 0.05, 0.65
"""Side of a square around a pixel; the share of its pixels that must have texture, and of these the share
that must agree. A pile rug agrees on three quarters and more, what stands before it on a tenth, by chance."""
_GAP_PX = 3
"""Gaps up to twice as wide between pixels that show the ground show it too."""
_BEHIND_INSIDE_PX = 2
"""From the border of what shows the room behind, which is found where photographs are small."""
_LEAST_SHOWN, _LEAST_STANDING, _LEAST_BEHIND = 1e-3, 2e-4, 5e-3
"""Of the picture: smaller pieces of ground, of what stands on it, and of the room behind are chance."""
_SPOT_RING_PX, _SPOT_SHARE = 3, 0.1
"""Of what lies so near around a small piece of ground: more, standing there, makes it doubtful; and of its
own pixels: less, measured as ground or behind, makes it none. Of nine photographs of a doll six pieces of
0.04 to 0.33 % are such, five of them its cloth; of 21 photographs of tables none."""
_INSIDE_PX, _OUTSIDE_PX = 4, 6
"""From the border of what agrees: so far inside pixels surely show the ground, and so far outside they are
not known to, for a patch that reaches over the subject's outline agrees or not by chance. Between them the
edge of the picture is sought."""
_EDGE_PX = 1.5
"""Standard deviation of the Gaussian whose gradient is an edge."""


def without_ground(
    stereo: StereoResult,
    views: tuple[View, ...],
    region: Region,
    config: StereoConfig,
    *,
    progress: Progress,
) -> StereoResult:
    """Without the points of the ground, whose pixels are empty then; where there is none, with the doubt.

    The views' cameras are those that the depth maps belong to. A decision says what was found.
    """
    ground, because = _unmasked_ground(stereo.points, views, region)
    if ground is None:
        return _as_it_is(stereo, because)
    points = stereo.points
    above = ground.height(points.positions.astype(np.float64)) >= ground.thickness
    windows = [whole_picture(view, region, config) for view in views]
    nearby = neighbours([window.camera for window in windows], _NUM_SOURCES)
    maps = []
    for index, (map_, view, near) in enumerate(zip(stereo.depth_maps, views, nearby, strict=True)):
        progress(1.0, f"ground in photograph {index + 1}")
        agreeing = _textured_and_agreeing(ground, windows[index], [windows[n] for n in near])
        behind = _textured_and_behind(map_, windows[index])
        maps.append(_without(ground, map_, windows[index].camera, view.image_srgb, agreeing, behind))
    return replace(
        stereo,
        points=points.chosen(above),
        depth_maps=tuple(maps),
        ground=ground,
        decisions=(*stereo.decisions, Decision(what="ground", choice="left out", because=because)),
    )


def _as_it_is(stereo: StereoResult, because: str) -> StereoResult:
    decision = Decision(what="ground", choice="none to leave out", because=because)
    doubt = f"There is no flat ground to leave out: {because}."
    return replace(stereo, doubt=doubt, decisions=(*stereo.decisions, decision))


def told_of_ground(stereo: StereoResult, views: tuple[View, ...], region: Region) -> StereoResult:
    """With a word about ground that is kept, where photographs without masks show something stand on it.

    Only what is level counts: a wall is a plane with things before it as well.
    """
    ground, because = _unmasked_ground(stereo.points, views, region)
    if ground is None:
        return stereo
    up = region.object_from_world[:3, :3] @ up_of([view.camera for view in views])
    if angles_between(up / np.linalg.norm(up), ground.normal) > math.radians(_MOST_TILTED_DEG):
        return stereo
    doubt = "What was photographed stands on something flat, which becomes part of the mesh. "
    doubt += "To leave that out, choose Without Ground, or Cut Out Subject where one thing stands out "
    doubt += "(in a terminal --without-ground or --cut-out)."
    return replace(
        stereo,
        doubt=doubt,
        decisions=(*stereo.decisions, Decision(what="ground", choice="kept", because=because)),
    )


def _unmasked_ground(
    points: SurfacePoints, views: tuple[View, ...], region: Region
) -> tuple[Ground | None, str]:
    """As `find_ground`, where masks do not tell the subject already."""
    if all(view.mask is not None for view in views):
        return None, "the photographs have masks, which say what the subject is"
    eyes = np.array([view.camera.position for view in views])
    return find_ground(points, transform_points(region.object_from_world, eyes))


def find_ground(points: SurfacePoints, eyes: Float64[np.ndarray, "views 3"]) -> tuple[Ground | None, str]:
    """The plane that much of what was measured lies on, with the rest and all eyes above it; and why.

    `eyes` are the cameras' positions, object frame.
    """
    sure = points.positions[points.confidence > SURE].astype(np.float64)
    asked = sure[np.linspace(0, len(sure) - 1, min(_ASKED, len(sure))).astype(int)]
    if len(asked) < 3:
        return None, "hardly a point was surely measured"
    plane = plane_under_most(asked, eyes, _TOLERANCE, _MOST_BELOW)
    if plane is None:
        return None, "no plane has what was measured on it or above"
    on, above = plane.within.mean(), (plane.distance(asked) >= _TOLERANCE).mean()
    because = f"of the points that are surely measured {on:.0%} lie on a plane and {above:.0%} above it"
    if on < _LEAST_SHARE or above < _LEAST_ABOVE:
        return None, because
    thickness = max(_SPREADS * float(plane.distance(asked[plane.within]).std()), _FINEST)
    offset = float(plane.middle @ plane.normal)
    return Ground(normal=plane.normal, offset=offset, thickness=thickness), because


def _textured_and_agreeing(
    ground: Ground, window: Window, sources: list[Window]
) -> Bool[np.ndarray, "2 height width"]:
    """Where the picture has texture, and where that agrees with the sources as if it showed the ground."""
    inverse_depth = _inverse_depth(ground, window.camera)
    asked = torch.from_numpy(inverse_depth > 0) & window.textured
    tried = torch.from_numpy(np.maximum(inverse_depth, 0))[None]
    score = agreement(window, sources, tried, asked)[0]
    return np.stack([asked.numpy(), (asked & (score > _AGREES)).numpy()])


def _textured_and_behind(map_: DepthMap, window: Window) -> Bool[np.ndarray, "2 height width"]:
    """Where the picture has texture, and where that is found again behind the region."""
    textured = window.textured.numpy()
    return np.stack([textured, textured & (False if map_.behind is None else map_.behind)])


def _inverse_depth(ground: Ground, camera: Pinhole) -> Float32[np.ndarray, "height width"]:
    """Of the ground along each pixel's ray; not positive where that does not meet it."""
    pixels = pixel_centres(camera.width, camera.height, torch.device("cpu"))
    downwards = -ray_directions(camera, pixels).numpy().astype(np.float64) @ ground.normal
    height = ground.height(camera.position.numpy().astype(np.float64))
    return np.asarray(downwards / height, np.float32)


def _without(
    ground: Ground,
    map_: DepthMap,
    camera: Pinhole,
    image_srgb: Float32[np.ndarray, "height width 3"],
    textured_and_agreeing: Bool[np.ndarray, "2 height width"],
    textured_and_behind: Bool[np.ndarray, "2 height width"],
) -> DepthMap:
    """Pixels that show the ground or the room behind are empty, those that surely show what stands there are
    the subject."""
    measured = seen_places(camera, torch.from_numpy(map_.depth)).numpy().astype(np.float64)
    low = ground.height(measured) < ground.thickness
    known, sure = map_.depth > 0, map_.confidence > SURE
    standing = _without_specks(known & sure & ~low, _LEAST_STANDING)
    ground_shown = _most_agree(textured_and_agreeing, standing) | (known & sure & low)
    behind = _without_specks(_most_agree(textured_and_behind, standing), _LEAST_BEHIND)
    behind = binary_erosion(behind, iterations=_BEHIND_INSIDE_PX, border_value=1)
    closed = binary_closing(ground_shown | behind, iterations=_GAP_PX)
    empty = _up_to_edges(_without_specks(closed & ~standing, _LEAST_SHOWN), standing, image_srgb)
    empty = _without_plain_spots(empty, standing, told=(known & low) | textured_and_behind[1])
    return replace(
        map_.measured_where(~low & ~empty),
        empty=empty if map_.empty is None else empty | map_.empty,
        subject=standing & ~empty if map_.subject is None else (standing | map_.subject) & ~empty,
    )


def _most_agree(
    textured_and_agreeing: Bool[np.ndarray, "2 height width"], standing: Bool[np.ndarray, "height width"]
) -> Bool[np.ndarray, "height width"]:
    """Where most of what has texture around a pixel agrees: that tells to the size of a patch."""
    textured, agreeing = (
        uniform_filter((where & ~standing).astype(np.float32), _AROUND_PX) for where in textured_and_agreeing
    )
    most: Bool[np.ndarray, "height width"] = (textured > _TEXTURED_SHARE) & (
        agreeing > _AGREEING_SHARE * textured
    )
    return most


def _up_to_edges(
    shown: Bool[np.ndarray, "height width"],
    standing: Bool[np.ndarray, "height width"],
    image_srgb: Float32[np.ndarray, "height width 3"],
) -> Bool[np.ndarray, "height width"]:
    """What shows the ground or the room behind, up to the strongest edge of the picture near its border.

    By watershed from what surely does and what is not known to (Meyer, "Topographic distance and
    watershed lines", 1994).
    """
    inside = binary_erosion(shown, iterations=_INSIDE_PX, border_value=1)
    outside = distance_transform_edt(~shown) > _OUTSIDE_PX
    outside |= binary_erosion(standing, iterations=_INSIDE_PX)
    channels = np.moveaxis(image_srgb, -1, 0)
    edges = sum(gaussian_gradient_magnitude(channel, _EDGE_PX) ** 2 for channel in channels)
    parts = watershed(  # type: ignore[no-untyped-call]
        edges, np.where(inside, 1, np.where(outside, 2, 0))
    )
    return np.asarray(parts == 1)


def _without_plain_spots(
    empty: Bool[np.ndarray, "height width"],
    standing: Bool[np.ndarray, "height width"],
    told: Bool[np.ndarray, "height width"],
) -> Bool[np.ndarray, "height width"]:
    """Without small pieces beside what stands there in which next to nothing is `told` by a depth.

    Plain cloth between two seams agrees with itself over any plane; ground that is seen through the gap of an
    arm is measured.
    """
    piece, _ = label(empty)
    around = np.where(empty, 0, expand_labels(piece, _SPOT_RING_PX))  # type: ignore[no-untyped-call]
    size, num_around = np.bincount(piece.ravel()), np.bincount(around.ravel(), minlength=piece.max() + 1)
    num_told = np.bincount(piece.ravel(), told.ravel())
    num_standing = np.bincount(around.ravel(), standing.ravel(), minlength=len(size))
    small = size < _LEAST_BEHIND * empty.size
    plain = small & (num_told < _SPOT_SHARE * size) & (num_standing > _SPOT_SHARE * num_around)
    return np.asarray(empty & ~plain[piece])


def _without_specks(mask: Bool[np.ndarray, "height width"], least: float) -> Bool[np.ndarray, "height width"]:
    """Without connected pieces that are a smaller share of the picture."""
    piece, _ = label(mask)
    large = np.bincount(piece.ravel()) > least * mask.size
    return np.asarray(large[piece] & mask)
