"""Places that brightness and colour tell: a surface without texture, but matt and shaded, or coloured.

Patches are compared without their mean and say nothing where there is only shading, which on smooth
things is most of what photographs see. Where two photographs see the same place of the field and
what they show changes evenly along the rays, the depth at which both show the same is a measurement
(maths/brightness.py).

How far it can be trusted is measured twice: by what differs where patches do agree, averaged over so many
places that their texture evens out (on what shines, brightness depends on the view, and the average shows
it); and by what one step leaves unexplained in a window (texture, edges, something else in front). Of what
shines, the part that mirrored directions explain is taken off before (shine).
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int64, Shaped
from scipy.ndimage import binary_erosion, gaussian_filter
from torch import Tensor

from ...maths.brightness import (
    Slopes,
    channels_of,
    depth_steps,
    exposure_ratio,
    grain,
    means_of_cells,
    slopes_along,
)
from ...maths.correlation import window_sum
from ...maths.evidence import cube_keys
from ...maths.geometry import Pinhole, project, sample_image
from ...maths.grid import spacing
from ...maths.mirrored_light import means_of_bins, mirrored_bins
from ...maths.rows import Rows, together
from ...maths.srgb import linear_from_srgb
from ..measurements import SURE, Measurements
from ..stereo.windows import neighbours
from .seen_field import NearSurface, at_size, averaged, may_show, seen_field, smaller
from .shine import Boxes, Shine, deviations, mirrored_by

MOSTLY_TEXTURED = 0.7
"""Where patches tell a larger share of the surface, what is left is hidden or beside edges."""
_GLANCE = 0.125
"""Of the photographs' size at which that share is measured."""
_PARTNERS = 2
"""Photographs that each one is compared with, at most."""
_SHARE = 0.5
"""Of the photographs' size at which brightness is looked at."""
_MOST_PIXELS = 60_000
"""Of a picture: where the subject is not known, and surroundings fill it, brightness is looked at smaller."""
_BLUR_PX = 1.0
"""There; noise is averaged, shading is left."""
_MARGIN_PX = 3
"""From where the field is missed or turns away: across that the blur would reach, and beside it is what one
photograph sees and the other does not."""
_EVEN_PX = 2
"""Half the side of a window over which normals are evened out."""
_OUTLINE_PX = 4.0
"""From the subject's outline in any of the photographs."""
_WINDOW_PX = 1
"""Half a window's side."""
_WIDE_PX = 4
"""The same of a wider one."""
_ALIKE_CELLS = 1.0
"""Both windows' steps differ by at most that: beside a place as bright as can be, the small one's go wild."""
_LEAST_COSINE = 0.25
"""Between the normal and a ray: what turns away further is an edge, or a bridge between two parts."""
_SAME_CELLS = 2.5
"""Two photographs see the same place if their depths of it differ by at most that."""
_LONGEST_CELLS = 4.0
"""A step's length; from farther off, another place may be as bright."""
_CELL = 6.0
"""Side of a box, in cells of the grid, over which differences are averaged."""
_FEWEST_IN_BOX = 20
"""Places in it, all of which patches agree on, or none."""
_SURE_DEVIATION = 0.002
"""Of the depth of a sure stereo point, in half widths of the grid; what is as good weighs as much."""
_LARGEST_DEVIATION = 0.02
"""Of a depth that is told."""
_SURELY = 6.0
"""Deviations by which a field has to be too near for that to be sure."""
_BRIDGED_CELLS = 0.5
"""By which it has to be too near as well: less is not a bridge but what the next round mends."""


@dataclass(frozen=True, kw_only=True)
class ShownPlaces(Rows):
    """Oriented points that brightness tells."""

    positions: Float[Tensor, "points 3"]
    normals: Float[Tensor, "points 3"]
    weights: Float[Tensor, "points"]
    """Beside a sure stereo point, 0 to 1."""
    mirrored: Float[Tensor, "points"]
    """Difference of brightness, in linear light, that was taken off because it is mirrored light."""
    directions: Float[Tensor, "points 3"]
    """Away from the photograph that each was asked of, of unit length."""
    hidden: Bool[Tensor, "points"]
    """Whether the field was surely too near there: what it has before the place is a bridge."""


def shared_brightness(
    scene: Measurements, distance: Float[Tensor, "nodes nodes nodes"], *, may_shine: bool = True
) -> ShownPlaces:
    """Where the field's surface should be, of all places that two photographs see and patches do not tell.

    If it `may_shine`, light that it is found to mirror is taken off first.
    """
    near = NearSurface(distance=distance)
    pictures = [_picture(scene, index, distance, near) for index in range(len(scene.cameras))]
    partners = neighbours(scene.cameras, _PARTNERS)
    compared = [
        compared
        for picture, others in zip(pictures, partners, strict=True)
        for other in others
        if (compared := _compared(picture, pictures[other], len(distance))) is not None
    ]
    if not compared:
        return _nothing(distance.device)
    boxes = together([pair.boxes for pair in compared])
    noise = deviations(boxes.difference[boxes.sure])
    shine = mirrored_by(boxes, noise, compared[0].cell) if may_shine else None
    return _off_outlines(scene, together([_told(pair, noise, shine) for pair in compared]))


def textured(scene: Measurements, distance: Float[Tensor, "nodes nodes nodes"]) -> float:
    """How much of the field's surface that photographs show is told by patches: 1 if all of it, and surely.

    Surroundings that the field does not have count for nothing, whether the subject is known or not.
    """
    told, near = [], NearSurface(distance=distance)
    for index, confidence in enumerate(scene.confidences):
        camera, asked = _asked(scene, index, near, _GLANCE)
        seen = seen_field(camera, asked, distance)
        facing = seen.hit & (seen.cosine > _LEAST_COSINE)
        told.append((at_size(confidence, camera)[asked][facing] / SURE).clamp(max=1.0))
    return float(torch.cat(told).mean().nan_to_num())


def share_told(told: ShownPlaces, distance: Float[Tensor, "nodes nodes nodes"]) -> float:
    """Of the cells that a field's surface goes through, about how many have places that were told."""
    h = spacing(len(distance))
    # a plane goes through |n_x| + |n_y| + |n_z| cells for each square of a cell's side: on average 1.5
    met = int((distance.abs() < 0.75 * h).sum())
    return len(torch.unique(cube_keys(told.positions, h))) / max(met, 1)


@dataclass(frozen=True, kw_only=True)
class _Places(Rows):
    """Of the field, that pixels see."""

    pixel: Int64[Tensor, "places"]
    """Number of the pixel, row by row."""
    positions: Float[Tensor, "places 3"]
    normals: Float[Tensor, "places 3"]
    """Evened out."""
    directions: Float[Tensor, "places 3"]
    """Away from the camera."""
    sure: Bool[Tensor, "places"]
    """Whether patches agree there."""


@dataclass(frozen=True, kw_only=True)
class _Picture:
    """A photograph's light, and the places of the field that its pixels see."""

    camera: Pinhole
    """Of a smaller picture."""
    linear: Float[Tensor, "3 height width"]
    """Blurred."""
    depth: Float[Tensor, "height width"]
    """Of the field, along the axis; 0 where it is missed, and near where it turns away."""
    places: _Places


@dataclass(frozen=True, kw_only=True)
class _Compared:
    """What two photographs show of the same places, by channels: brightness and differences of colour."""

    boxes: Boxes
    """Averages; some of them where patches agree."""
    places: _Places
    """Where patches do not."""
    difference: Float[Tensor, "channels height width"]
    slopes: Slopes
    """Of them, [channels, height, width]; straight nowhere but at the places that both show."""
    bins: Int64[Tensor, "2 height width"]
    """Of the mirrored directions, from the one's side and the other's."""
    cell: float
    """Side of a cell of the grid."""


def _picture(
    scene: Measurements, index: int, distance: Float[Tensor, "nodes nodes nodes"], near: NearSurface
) -> _Picture:
    camera, asked = _asked(scene, index, near, _SHARE)
    if (num_asked := int(asked.sum())) > _MOST_PIXELS:
        camera, asked = _asked(scene, index, near, _SHARE * math.sqrt(_MOST_PIXELS / num_asked))
    seen = seen_field(camera, asked, distance)
    depth, facing = torch.zeros(asked.shape, device=asked.device), torch.zeros_like(asked)
    depth[asked] = torch.where(seen.hit, seen.depth, 0.0)
    facing[asked] = seen.hit & (seen.cosine > _LEAST_COSINE)
    inner = torch.tensor(binary_erosion(facing.cpu().numpy(), iterations=_MARGIN_PX), device=asked.device)
    wanted = inner[asked]
    return _Picture(
        camera=camera,
        linear=_blurred(averaged(scene.images[index], camera), depth > 0),
        depth=torch.where(inner, depth, 0.0),
        places=_Places(
            pixel=torch.nonzero(asked.flatten())[wanted, 0],
            positions=seen.positions[wanted],
            normals=_evened(seen.normals[wanted], inner),
            directions=seen.directions[wanted],
            sure=(at_size(scene.confidences[index], camera) > SURE)[asked][wanted],
        ),
    )


def _asked(
    scene: Measurements, index: int, near: NearSurface, share: float
) -> tuple[Pinhole, Bool[Tensor, "height width"]]:
    """A camera of so much of a photograph's size, and its pixels on the subject that may show the field."""
    camera, subject = smaller(scene.cameras[index], share), scene.certain[index]
    return camera, may_show(camera, near) if subject is None else at_size(subject, camera) < 0


def _evened(
    normals: Float[Tensor, "places 3"], where: Bool[Tensor, "height width"]
) -> Float[Tensor, "places 3"]:
    """Means over windows of the pixels `where` they are known: else ripples of the field are told again."""
    picture = normals.new_zeros((3, *where.shape))
    picture[:, where] = normals.T
    return F.normalize(window_sum(picture, _EVEN_PX)[:, where].T, dim=-1)


def _blurred(
    image_srgb: Float[Tensor, "3 rows columns"], seen: Bool[Tensor, "rows columns"]
) -> Float[Tensor, "3 rows columns"]:
    """Linear light, blurred over the seen pixels alone."""
    linear, on = linear_from_srgb(image_srgb.cpu().numpy()), seen.cpu().numpy().astype(np.float32)
    share = gaussian_filter(on, _BLUR_PX).clip(min=1e-6)
    blurred = np.stack([gaussian_filter(channel * on, _BLUR_PX) / share for channel in linear])
    return torch.tensor(blurred, dtype=torch.float32, device=seen.device)


def _compared(one: _Picture, other: _Picture, nodes: int) -> _Compared | None:
    """What another photograph shows of the places of one; None if too little is known to judge it by."""
    h = spacing(nodes)
    at, depth = project(other.camera, one.places.positions)
    seen_depth = sample_image(other.depth[None], at[None, None], "nearest")[0, 0, 0]
    towards = F.normalize(other.camera.position - one.places.positions, dim=-1)
    same = (depth > 0) & (seen_depth > 0) & ((seen_depth - depth).abs() < _SAME_CELLS * h)
    same &= (one.places.normals * towards).sum(dim=-1) > _LEAST_COSINE
    places = one.places.chosen(same)
    sure = places.sure
    if not sure.any():
        return None

    def shown_at(pixels: Float[Tensor, "places 2"]) -> Float[Tensor, "channels places"]:
        return channels_of(sample_image(other.linear, pixels[None, None])[0, :, 0])

    def shown(step: float) -> Float[Tensor, "channels places"]:
        return shown_at(project(other.camera, places.positions + step * places.directions)[0])

    def in_picture(values: Shaped[Tensor, "channels places"]) -> Shaped[Tensor, "channels height width"]:
        empty = values.new_zeros((len(values), one.camera.height * one.camera.width))
        return empty.index_copy_(1, places.pixel, values).view(-1, one.camera.height, one.camera.width)

    here, there = channels_of(one.linear.flatten(1)[:, places.pixel]), shown_at(at[same])
    _, box = torch.unique(2 * cube_keys(places.positions, _CELL * h) + sure.long(), return_inverse=True)

    def boxes(values: Float[Tensor, "channels places"]) -> Float[Tensor, "channels boxes"]:
        return means_of_cells(values, box, _FEWEST_IN_BOX)

    in_sure = boxes(sure[None].float())[0] > 0.5
    if not in_sure.any():
        return None
    ratio = exposure_ratio(boxes(here)[:, in_sure], boxes(there)[:, in_sure])[:, None]
    difference, along = ratio * here - there, slopes_along(shown(-h), there, shown(h), h)
    bins = torch.stack(
        [
            mirrored_bins(places.normals, F.normalize(camera.position - places.positions, dim=-1))
            for camera in (one.camera, other.camera)
        ]
    )
    return _Compared(
        boxes=Boxes(
            difference=boxes(difference).T,
            slope=boxes(along.slope).T,
            mirrored=means_of_bins(bins[0], bins[1], box, _FEWEST_IN_BOX),
            sure=in_sure,
        ),
        places=places.chosen(~sure),
        difference=in_picture(difference),
        slopes=Slopes(slope=in_picture(along.slope), straight=in_picture(along.straight)),
        bins=in_picture(bins),
        cell=h,
    )


def _told(pair: _Compared, matt_noise: Float[Tensor, "channels"], shine: Shine | None) -> ShownPlaces:
    """The places that are told well enough, by how much each channel depends on the view."""
    if len(pair.places.pixel) == 0:
        return _nothing(pair.difference.device)
    matt, noise = pair.difference, matt_noise[:, None, None]
    if shine is not None:
        matt, noise = shine.taken_off(pair.difference, pair.bins)
    noise = (noise.square() + _grain_of_colours(pair).square()[:, None, None]).sqrt()
    straight, difference, slope = pair.slopes.straight, matt / noise, pair.slopes.slope / noise
    steps = depth_steps(difference, slope, straight, _WINDOW_PX)
    around = depth_steps(difference, slope, straight, _WIDE_PX)
    deviation = (steps.left_over.square() + 1).sqrt() / steps.slope
    asked = straight.any(dim=0) & (deviation < _LARGEST_DEVIATION)
    asked &= steps.step.abs() < _LONGEST_CELLS * pair.cell
    asked &= (steps.step - around.step).abs() < _ALIKE_CELLS * pair.cell
    places = pair.places.chosen(asked.flatten()[pair.places.pixel])
    step, deviation = steps.step.flatten()[places.pixel], deviation.flatten()[places.pixel]
    return ShownPlaces(
        positions=places.positions + step[:, None] * places.directions,
        normals=places.normals,
        weights=(_SURE_DEVIATION / deviation).square().clamp(max=1.0),
        mirrored=(pair.difference - matt)[0].flatten()[places.pixel].abs(),
        directions=places.directions,
        hidden=(step > _SURELY * deviation) & (step > _BRIDGED_CELLS * pair.cell),
    )


def _grain_of_colours(pair: _Compared) -> Float[Tensor, "channels"]:
    """Noise of single pixels, which boxes average away; 0 of brightness.

    What is grey has no slope of its own in its colours, but in units of what boxes leave their grain has one,
    agrees with any depth, and cuts steps short. Brightness has a slope beside its grain.
    """
    where = torch.zeros_like(pair.difference[0], dtype=torch.bool)
    where.view(-1)[pair.places.pixel] = True
    off = grain(pair.difference[1:], where, _WIDE_PX)
    return torch.cat([off.new_zeros(1), off])


def _off_outlines(scene: Measurements, shown: ShownPlaces) -> ShownPlaces:
    """Those that no photograph shows at the subject's outline, which says better where they are."""
    kept = torch.ones_like(shown.weights, dtype=torch.bool)
    for camera, outline in zip(scene.cameras, scene.certain, strict=True):
        if outline is not None:
            pixels, _ = project(camera, shown.positions)
            kept &= sample_image(outline[None], pixels[None, None])[0, 0, 0] < -_OUTLINE_PX
    return shown.chosen(kept)


def _nothing(device: torch.device) -> ShownPlaces:
    places, numbers = torch.zeros((0, 3), device=device), torch.zeros(0, device=device)
    return ShownPlaces(
        positions=places,
        normals=places,
        weights=numbers,
        mirrored=numbers,
        directions=places,
        hidden=torch.zeros_like(numbers, dtype=torch.bool),
    )
