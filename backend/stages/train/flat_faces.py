"""Flat faces: what is evenly bright in a photograph, and has its border on a plane, lies on that plane.

Patches say nothing inside such a region, brightness says nothing where all is equally bright, and the
smoothest field through its border is a pillow. But a matt surface that turns changes its brightness (the
light falls on it at another angle): what keeps it does not turn, or hardly. So the plane through what stereo
measured along the region's border is a measurement of its inside, if another photograph, warped over that
plane, shows the same border, and none shows something else through it.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64
from scipy.ndimage import distance_transform_edt, find_objects, gaussian_filter, label
from skimage.morphology import convex_hull_image
from torch import Tensor

from ...maths.geometry import Pinhole, inside, pixel_centres, project, ray_directions, sample_image, unproject
from ...maths.plane_fit import Plane, plane_of_most
from ...maths.rows import Rows, together
from ...scene import Decision
from ..measurements import Measurements
from .seen_field import at_size, averaged, smaller

_SHARE = 0.5
"""Of the photographs' size at which they are looked at."""
_BLUR_PX = 1.0
"""There."""
_EVEN = 1 / 255
"""Largest change of a channel from pixel to pixel inside a region, in sRGB from 0 to 1."""
_EVEN_WHOLE = 0.04
"""From its darkest twentieth to its brightest, of its brightness: a cylinder that is lit from aside changes
as much within five degrees."""
_LEAST_PX = 150
"""Pixels of a region."""
_OFF_OUTLINE_PX = 2.5
"""From the subject's outline."""
_BORDER_PX = 5.0
"""Around a region, where stereo measured its border."""
_FEWEST = 20
"""Measured pixels there."""
_TOLERANCE = 0.008
"""From the plane, in half widths of the grid: half a cell of one of 128 nodes."""
_MOST = 0.6
"""Share of them that lies on the plane."""
_SURROUNDED = 0.8
"""Share of the region that lies between what was measured on the plane. What is not may be another face, as
bright, behind a step that is seen at the region's ends alone."""
_LEAST_COSINE = 0.2
"""Between the plane's normal and the rays, from where it is told and from where it is checked."""
_MEETS = 0.01
"""The same of a ray that meets the plane at all."""
_SEEN = 0.3
"""Share of a region and its border that another photograph has to show to be asked."""
_EDGE = 3 / 255
"""Change from pixel to pixel on a border."""
_FEWEST_ON_EDGES = 20
"""Pixels; with fewer there is no border to check."""
_ALIKE = 3 / 255
"""Difference of what two photographs show of the same, besides what a pixel aside shows."""
_AGREES = 0.8
"""Share of a region's pixels that are alike."""
_AGREES_ON_EDGES = 0.72
"""The same of those on edges, its border among them."""
_CONTRADICTED = 0.05
"""Share of a face that may seem to lie where a photograph shows something else through it."""
_OFF_PX = 2.0
"""From the outline: what is farther is off the subject for sure."""
_BRIGHTER = 1.3
"""Times, that a face may be seen from elsewhere: it shines, or photographs are exposed otherwise."""
_SAID = 0.8
"""Confidence of a place on such a plane."""


@dataclass(frozen=True, kw_only=True)
class FlatFaces(Rows):
    """Places on flat faces, in the frame of the scene that was asked."""

    positions: Float[Tensor, "places 3"]
    normals: Float[Tensor, "places 3"]
    colours: Float[Tensor, "places 3"]
    views: Int64[Tensor, "places"]
    """Which photograph tells each."""
    faces: Int64[Tensor, "places"]
    """To which region each belongs, by its number."""

    @property
    def decision(self) -> Decision:
        """For the report."""
        what, count = "flat faces", len(torch.unique(self.faces))
        if not count:
            because = (
                "no evenly bright region is known to have its border on a plane, or they were not asked for"
            )
            return Decision(what=what, choice="left out", because=because)
        because = f"{count} evenly bright regions have borders on planes on which other photographs show them"
        return Decision(what=what, choice="used", because=because)

    def beside(self, scene: Measurements) -> Measurements:
        """The scene with these places behind the points that stereo measured."""
        said = torch.full_like(self.positions[:, 0], _SAID)
        return replace(
            scene,
            positions=torch.cat([scene.positions, self.positions]),
            normals=torch.cat([scene.normals, self.normals]),
            colours=torch.cat([scene.colours, self.colours]),
            confidence=torch.cat([scene.confidence, said]),
            view_index=torch.cat([scene.view_index, self.views]),
        )


def flat_faces(scene: Measurements) -> FlatFaces:
    """Of all photographs that know their subject, each region by itself."""
    shown = zip(scene.cameras, scene.images, scene.certain, scene.sure_depths, strict=True)
    pictures = [_picture(*of_one) for of_one in shown]
    found = [no_faces(scene)]
    for view, picture in enumerate(pictures):
        if not picture.knows_subject:
            continue
        others = pictures[:view] + pictures[view + 1 :]
        for region in _even_regions(picture):
            if (plane := _plane(region, others)) is not None:
                found.append(_places(region, plane, view, len(found), scene.positions))
    return together(found)


def no_faces(scene: Measurements) -> FlatFaces:
    """Nothing, as of a scene without such regions."""
    none, numbers = scene.positions[:0], torch.zeros(0, dtype=torch.long, device=scene.positions.device)
    return FlatFaces(positions=none, normals=none, colours=none, views=numbers, faces=numbers)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Picture:
    """A photograph made smaller, and what stereo measured of it."""

    camera: Pinhole
    image: Float32[np.ndarray, "3 height width"]
    """sRGB, blurred."""
    change: Float32[np.ndarray, "3 height width"]
    """Of it, from pixel to pixel."""
    outline_px: Float32[np.ndarray, "height width"]
    """Signed distance to the subject's outline, < 0 on it; -inf everywhere where it is not known."""
    directions: Float32[np.ndarray, "height width 3"]
    """Of rays, of depth 1."""
    depth: Float32[np.ndarray, "height width"]
    """Sure ones, along the axis; 0 elsewhere."""
    measured: Float32[np.ndarray, "height width 3"]
    """Where those are: of the photograph's own pixels, one of four."""

    @property
    def knows_subject(self) -> bool:
        """Else it tells nothing: even backgrounds have borders on planes as well."""
        return bool(np.isfinite(self.outline_px).any())

    @property
    def centre(self) -> Float64[np.ndarray, "3"]:
        """Of projection."""
        return self.camera.position.double().numpy()


@dataclass(frozen=True, kw_only=True)
class _Region:
    """What is evenly bright, in a window of a picture."""

    picture: _Picture
    window: tuple[slice, slice]
    inside: Bool[np.ndarray, "rows columns"]
    apart_px: Float64[np.ndarray, "rows columns"]
    """From it; 0 inside."""

    @property
    def side_px(self) -> float:
        """Of a square that is as large."""
        return math.sqrt(self.inside.sum())

    @property
    def directions(self) -> Float64[np.ndarray, "rows columns 3"]:
        """Of the window's rays, of depth 1."""
        return self.picture.directions[self.window].astype(np.float64)


@dataclass(frozen=True, kw_only=True)
class _PlaneOfRegion:
    """What is known of a flat region."""

    normal: Float64[np.ndarray, "3"]
    """Towards the camera."""
    places: Float64[np.ndarray, "rows columns 3"]
    """Where the window's rays meet the plane."""
    between: Bool[np.ndarray, "rows columns"]
    """Pixels of the region that lie between what was measured on the plane."""


def _picture(
    full: Pinhole,
    image_srgb: Float[Tensor, "3 height width"],
    outline: Float[Tensor, "height width"] | None,
    depth: Float[Tensor, "height width"],
) -> _Picture:
    camera = smaller(full, _SHARE)
    on_cpu = camera.cpu()
    small = averaged(image_srgb, camera).cpu().numpy()
    image = np.stack([gaussian_filter(channel, _BLUR_PX) for channel in small])
    own = pixel_centres(full.width, full.height, depth.device)
    pixels = torch.stack([at_size(axis, camera) for axis in own.unbind(dim=-1)], dim=-1)
    sure = at_size(depth, camera)
    measured = unproject(full, pixels, sure)
    return _Picture(
        camera=on_cpu,
        image=image,
        change=np.hypot(*np.gradient(image, axis=(1, 2))).astype(np.float32),
        outline_px=np.full(sure.shape, -np.inf, np.float32)
        if outline is None
        else _SHARE * at_size(outline, camera).cpu().numpy(),
        directions=ray_directions(
            on_cpu, pixel_centres(camera.width, camera.height, on_cpu.intrinsics.device)
        ).numpy(),
        depth=sure.cpu().numpy(),
        measured=measured.cpu().numpy(),
    )


def _even_regions(picture: _Picture) -> Iterator[_Region]:
    even = (picture.change.max(axis=0) < _EVEN) & (picture.outline_px < -_OFF_OUTLINE_PX)
    numbers, _ = label(even)
    sizes = np.bincount(numbers.ravel())
    brightness = picture.image.mean(axis=0)
    for number, box in enumerate(find_objects(numbers), start=1):
        if sizes[number] < _LEAST_PX:
            continue
        dark, bright = np.quantile(brightness[box][numbers[box] == number], (0.05, 0.95))
        if bright - dark > _EVEN_WHOLE * (dark + bright) / 2:
            continue
        margin = math.ceil(max(math.sqrt(sizes[number]), _BORDER_PX)) + 1
        rows, columns = (slice(max(side.start - margin, 0), side.stop + margin) for side in box)
        window = rows, columns
        within = numbers[window] == number
        yield _Region(picture=picture, window=window, inside=within, apart_px=distance_transform_edt(~within))


def _plane(region: _Region, others: list[_Picture]) -> _PlaneOfRegion | None:
    """Where a region lies, if it is flat as far as can be told."""
    picture, window = region.picture, region.window
    depth, directions = picture.depth[window], region.directions
    border = (region.apart_px <= _BORDER_PX) & (picture.outline_px[window] < 0)
    measured = picture.measured[window].astype(np.float64)
    at = border & (depth > 0)
    if at.sum() < _FEWEST or (plane := plane_of_most(measured[at], _TOLERANCE)) is None:
        return None
    on_plane = (
        (depth > 0) & (region.apart_px <= region.side_px) & (np.abs(plane.distance(measured)) < _TOLERANCE)
    )
    between = region.inside & convex_hull_image(on_plane)  # type: ignore[no-untyped-call]
    if plane.within.mean() < _MOST or between.sum() < _SURROUNDED * region.inside.sum():
        return None
    slope = directions @ plane.normal
    cosine = np.abs(slope) / np.linalg.norm(directions, axis=-1)
    to_plane = -plane.distance(picture.centre)
    meets = (slope * to_plane > 0) & (cosine > _MEETS)
    if np.median(cosine[region.inside]) < _LEAST_COSINE or not meets[between].all():
        return None
    along = np.where(meets, to_plane / np.where(meets, slope, 1.0), 0.0)
    places = picture.centre + along[..., None] * directions
    if any(_denies_it(other, places[between]) for other in others):
        return None
    # what stereo surely measured elsewhere, as behind an edge, is not of this face
    asked = border & meets & ~((depth > 0) & (np.abs(depth - along) > 3 * _TOLERANCE))
    if not any(_shows_it(other, region, plane, places, asked) for other in others):
        return None
    normal = plane.normal * np.sign(plane.distance(picture.centre))
    return _PlaneOfRegion(normal=normal, places=places, between=between)


def _places(
    region: _Region, plane: _PlaneOfRegion, view: int, number: int, like: Float[Tensor, "points 3"]
) -> FlatFaces:
    """One pixel of four: they say all the same."""
    rows, columns = np.nonzero(plane.between)
    kept = (rows % 2 == 0) & (columns % 2 == 0)
    at = rows[kept], columns[kept]
    positions = torch.from_numpy(plane.places[at].astype(np.float32)).to(like)
    colours = region.picture.image[:, *region.window][:, *at].T
    numbers = torch.zeros(len(positions), dtype=torch.long, device=like.device)
    return FlatFaces(
        positions=positions,
        normals=torch.from_numpy(plane.normal.astype(np.float32)).to(like).expand_as(positions),
        colours=torch.from_numpy(colours).to(like),
        views=numbers + view,
        faces=numbers + number,
    )


@dataclass(frozen=True, kw_only=True)
class _Looked:
    """What another photograph knows where it shows some places of a plane."""

    image: Float32[np.ndarray, "3 places"]
    outline_px: Float32[np.ndarray, "places"]
    before: Float64[np.ndarray, "places"]
    """How far a place lies before what stereo surely measured there, < 0 behind; 0 where nothing was."""
    inside: Bool[np.ndarray, "places"]
    """Whether it is in the picture at all; what is not tells nothing."""


def _looked(other: _Picture, places: Float64[np.ndarray, "places 3"]) -> _Looked:
    pixels, depth = project(other.camera, torch.from_numpy(places).float())
    smooth = sample_image(torch.from_numpy(other.image), pixels[None, None])[0, :, 0].numpy()
    known = torch.from_numpy(np.stack([other.outline_px, other.depth]))
    outline_px, measured = sample_image(known, pixels[None, None], mode="nearest")[0, :, 0].numpy()
    return _Looked(
        image=smooth,
        outline_px=outline_px,
        before=np.where(measured > 0, measured - depth.double().numpy(), 0.0),
        inside=((depth > 0) & inside(pixels, other.camera.width, other.camera.height)).numpy(),
    )


def _denies_it(other: _Picture, places: Float64[np.ndarray, "places 3"]) -> bool:
    """Whether another photograph shows what is off the subject, or surely behind, through a face.

    Such as the lid of a handle, whose border may be on a plane.
    """
    seen = _looked(other, places)
    through = (seen.outline_px > _OFF_PX) | (seen.before > 3 * _TOLERANCE)
    return bool((through & seen.inside).sum() > _CONTRADICTED * len(places))


def _shows_it(
    other: _Picture,
    region: _Region,
    plane: Plane,
    places: Float64[np.ndarray, "rows columns 3"],
    asked: Bool[np.ndarray, "rows columns"],
) -> bool:
    """Whether another photograph shows the region and its border on that plane."""
    seen = _looked(other, places[asked])
    towards = other.centre - places[asked]
    facing = np.abs(towards @ plane.normal) > _LEAST_COSINE * np.linalg.norm(towards, axis=-1)
    shown = seen.inside & facing & (seen.before > -3 * _TOLERANCE)
    inner = region.inside[asked] & shown
    if shown.sum() < _SEEN * asked.sum() or not inner.any():
        return False
    here, change = (
        values[:, *region.window][:, asked] for values in (region.picture.image, region.picture.change)
    )
    ratio = np.median(here[:, inner], axis=1) / np.median(seen.image[:, inner], axis=1).clip(min=1e-3)
    there = seen.image * ratio.clip(1 / _BRIGHTER, _BRIGHTER)[:, None]
    alike = (np.abs(there - here) < _ALIKE + change).all(axis=0)
    on_edges = change.max(axis=0) > _EDGE
    edges, even = alike[shown & on_edges], alike[shown & ~on_edges]
    return bool(len(edges) > _FEWEST_ON_EDGES and edges.mean() > _AGREES_ON_EDGES and even.mean() > _AGREES)
