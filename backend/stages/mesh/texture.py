"""The texture: a picture of the surface, put together from the photographs.

Each face lies in the picture as the photograph shows it that shows it largest, so that texels are its pixels;
regions of one photograph stay in one piece, as Lempitsky and Ivanov, "Seamless mosaicing of image-based
texture maps" (2007), cut a surface by its best view. The colour of a texel is the mean of all photographs
that see the place, those that see it frontally first, in whichever it lies: there are no seams to even out.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from scipy.ndimage import distance_transform_edt

from ...kernels.side_by_side import bands_side_by_side, side_by_side
from ...maths.atlas import Texels, faces_at, neighbours, packed, spread
from ...maths.exposure import evened
from ...maths.faces import area_vectors, face_areas
from ...maths.pieces import connected_pieces
from ...maths.projection import projected
from ...maths.raycast import interpolate
from ...scene import Camera, Decision, SurfaceMesh, Texture, View, transform_points
from .originals import Colours, Original, close_up, close_up_camera
from .vertex_colours import frontal_share, on_subject

_SPREAD_ROUNDS = 8
"""How far a face asks its neighbours for the best photograph: fewer and smaller pieces without it."""
_MARGIN_PX = 2
"""Around a chart, so that what is drawn bilinearly sees nothing of the next."""
_BLEED_PX = 16
"""How far a chart's colours go on around it, for viewers that draw the texture smaller than it is."""
_UNUSED_SRGB = np.full(3, 128, np.uint8)
_GUESSED_DENSITY = 0.25
"""Of surface that no photograph shows, as a share of the others': its colours are smooth."""
_LAST_RESORT = 1e-3
"""Weight of a photograph at the rim of what it sees, where it may be a pixel beside."""
_STRIP = 2**14
"""Texels at a time: what is read and made of them stays in a cache."""


@dataclass(frozen=True, kw_only=True)
class TextureConfig:
    """How fine the texture may be."""

    max_photo_px: int = 2048
    """Photographs are read again, for their colours alone, until their longer side is this."""
    max_side_px: int = 4096
    """Of the texture. Its texels are as large as pixels of these photographs if there is room for that."""


def paint(
    mesh: SurfaceMesh,
    seen: Bool[np.ndarray, "vertices views"],
    views: tuple[View, ...],
    originals: tuple[Original, ...] | None,
    log_exposures: Float64[np.ndarray, "views 3"],
    config: TextureConfig,
) -> tuple[Texture, Decision]:
    """The texture of a mesh without one, and how large it is.

    `seen` says which views see a vertex, `originals` what the views were made from, where they were made from
    files, and `log_exposures` what their colours are brought together by.
    Raises ReconstructionError(PHOTO_UNREADABLE).
    """
    pairs = list(zip(views, originals or [None] * len(views), strict=True))
    cameras = [close_up_camera(view, original, config.max_photo_px) for view, original in pairs]
    photographs = (close_up(view, original, config.max_photo_px) for view, original in pairs)
    shown = seen[mesh.faces].all(axis=1)
    corners_px, (width, height), scale = _layout(mesh, shown, cameras, config.max_side_px)
    texels = faces_at(corners_px, width, height)
    colours = np.zeros((height, width, 3), np.uint8)
    colours[texels.covered] = _colours(mesh, texels, shown, cameras, photographs, log_exposures)
    bleed(colours, texels.covered)
    longest = max(max(camera.width, camera.height) for camera in cameras)
    decision = Decision(
        what="texture",
        choice=f"{width} x {height}",
        because=f"{scale:.0%} of the size of photographs of up to {longest} pixels, the side at most "
        f"{config.max_side_px}",
    )
    return Texture(image_srgb=colours, corners_px=corners_px.astype(np.float32)), decision


def _layout(
    mesh: SurfaceMesh, shown: Bool[np.ndarray, "faces views"], cameras: Sequence[Camera], max_side_px: int
) -> tuple[Float64[np.ndarray, "faces 3 2"], tuple[int, int], float]:
    """Corners of the faces in the picture, its (width, height), and its scale, 1 for the photographs'."""
    area = face_areas(mesh.vertices, mesh.faces)
    pixels = np.stack([projected(mesh.vertices, camera)[0][mesh.faces] for camera in cameras])
    density = np.zeros((len(mesh.faces), len(cameras)))
    for index in range(len(cameras)):
        mine = shown[:, index] & (area > 0)
        density[mine, index] = _area_px(pixels[index][mine]) / area[mine]
    pairs = neighbours(mesh.faces)
    best = np.where(density > 0, spread(density, pairs, _SPREAD_ROUNDS), 0.0)
    picture, known = best.argmax(axis=1), best.any(axis=1)
    laid = pixels[picture, np.arange(len(picture))]
    if not known.all():
        guessed = np.flatnonzero(~known)
        axis, laid[guessed] = _from_outside(mesh.vertices, mesh.faces[guessed])
        picture[guessed] = len(cameras) + axis
        usual = np.sqrt(np.median(density.max(axis=1)[known])) if known.any() else 1.0
        laid[guessed] *= _GUESSED_DENSITY * usual
    same = picture[pairs[0]] == picture[pairs[1]]
    return _placed(laid, connected_pieces(pairs[:, same], len(picture)), max_side_px)


def _placed(
    laid: Float64[np.ndarray, "faces 3 2"], chart: Int64[np.ndarray, "faces"], max_side_px: int
) -> tuple[Float64[np.ndarray, "faces 3 2"], tuple[int, int], float]:
    """Charts side by side in one picture, drawn smaller where it would be too large."""
    scale = 1.0
    while True:
        low = np.full((chart.max() + 1, 2), np.inf)
        high = -low
        np.minimum.at(low, chart, scale * laid.min(axis=1))
        np.maximum.at(high, chart, scale * laid.max(axis=1))
        # by whole pixels, so that texels are pixels of the photograph
        first = np.floor(low) - _MARGIN_PX
        places, size = packed((np.ceil(high) + _MARGIN_PX - first).astype(np.int64))
        if max(size) <= max_side_px or scale * np.ptp(laid, axis=(0, 1)).max() < 1:
            return scale * laid + (places - first)[chart][:, None], size, scale
        scale *= min(0.95, max_side_px / max(size))


def _area_px(corners: Float64[np.ndarray, "faces 3 2"]) -> Float64[np.ndarray, "faces"]:
    (ax, ay), (bx, by) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    return np.asarray(np.abs(ax * by - ay * bx) / 2)


def _from_outside(
    vertices: Float64[np.ndarray, "vertices 3"], faces: Int64[np.ndarray, "faces 3"]
) -> tuple[Int64[np.ndarray, "faces"], Float64[np.ndarray, "faces 3 2"]]:
    """From which of the six sides of its box a face is seen best, and how it looks from there."""
    across = area_vectors(vertices, faces)
    axis = np.abs(across).argmax(axis=1)
    front = across[np.arange(len(faces)), axis] > 0
    u, v = (vertices[faces, (axis[:, None] + step) % 3] for step in (1, 2))
    return axis + 3 * front, np.stack([u, v], axis=-1)


def _colours(
    mesh: SurfaceMesh,
    texels: Texels,
    shown: Bool[np.ndarray, "faces views"],
    cameras: Sequence[Camera],
    photographs: Iterable[Colours],
    log_exposures: Float64[np.ndarray, "views 3"],
) -> UInt8[np.ndarray, "texels 3"]:
    """Means of the photographs; where none shows the place, the colours of the vertices."""
    total = np.zeros((len(texels.face), 4), np.float32)
    for index, (camera, photograph) in enumerate(zip(cameras, photographs, strict=True)):
        in_camera = transform_points(camera.camera_from_world, mesh.vertices)
        told = np.column_stack([in_camera, _shares(mesh, shown[:, index], camera)])
        mine = np.flatnonzero(shown[texels.face, index])
        _add(total, mesh.faces, texels, mine, told, photograph, log_exposures[index])
    known = total[:, 3] > 0
    colours = np.zeros((len(known), 3), np.uint8)
    colours[known] = np.clip(255 * total[known, :3] / total[known, 3:] + 0.5, 0, 255)
    corners, within = mesh.faces[texels.face[~known]], texels.barycentric(~known)
    colours[~known] = interpolate(mesh.colours_srgb, corners, within) + 0.5
    return colours


def _add(
    total: Float32[np.ndarray, "texels 4"],
    faces: Int64[np.ndarray, "faces 3"],
    texels: Texels,
    mine: Int64[np.ndarray, "some_texels"],
    told: Float64[np.ndarray, "vertices 4"],
    photograph: Colours,
    log_exposure: Float64[np.ndarray, "3"],
) -> None:
    """Add the colours of a photograph times their weights, and these, where it shows the texels.

    `told` of each vertex are its place in the camera's axes and how much the photograph counts there.
    """

    def add(strip: Int64[np.ndarray, "strip"]) -> None:
        at = interpolate(told, faces[texels.face[strip]], texels.barycentric(strip))
        sampled = photograph(at[:, :3])
        weight = (at[:, 3:] + _LAST_RESORT) * on_subject(sampled[:, 3:])
        total[strip, :3] += weight * evened(sampled[:, :3], log_exposure)
        total[strip, 3:] += weight

    strips = np.split(mine, range(_STRIP, len(mine), _STRIP))
    side_by_side(add, strips, torch.get_num_threads())


def bleed(colours: UInt8[np.ndarray, "height width 3"], covered: Bool[np.ndarray, "height width"]) -> None:
    """Write colours where no chart is: near one those of its nearest texel, elsewhere a grey."""

    def band(rows: tuple[int, int]) -> None:
        first, end = rows
        top = max(first - _BLEED_PX, 0)
        around, free = slice(top, end + _BLEED_PX), ~covered[first:end]
        colours[first:end][free] = _UNUSED_SRGB
        if covered[around].any():
            away, nearest = distance_transform_edt(~covered[around], return_indices=True)
            away, nearest = away[first - top : end - top], nearest[:, first - top : end - top]
            near = free & (away <= _BLEED_PX)
            colours[first:end][near] = colours[around][tuple(nearest[:, near])]

    bands_side_by_side(band, len(covered), torch.get_num_threads())


def _shares(
    mesh: SurfaceMesh, shown: Bool[np.ndarray, "faces"], camera: Camera
) -> Float64[np.ndarray, "vertices"]:
    """How much a photograph counts at each vertex: none where a neighbour is hidden, so that it fades out."""
    inside = np.ones(len(mesh.vertices), bool)
    inside[mesh.faces[~shown]] = False
    return np.where(inside, frontal_share(mesh.vertices, mesh.normals.astype(np.float64), camera), 0.0)
