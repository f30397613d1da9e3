"""From a photograph through any lens to a view through a pinhole.

A lens is a `pycolmap.Camera`: a projection model with its parameters over an image size. Its image points
are in pixels, the centre of the top left one at (0.5, 0.5); rays are points with z = 1 in camera axes.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import PIL.Image  # noqa: F401 - pycolmap loaded before Pillow corrupts memory when Pillow next saves
import pycolmap
from jaxtyping import Bool, Float64

from ...errors import ErrorCode, ReconstructionError
from ...maths.bilinear import bilinear
from ...scene import Camera, CameraEvidence, Decision, Lens, Photo, Unplaced, View

SMALLEST_ZOOM, LARGEST_ZOOM = 0.5, 4.0
"""Of the pinhole's focal length against the lens's. Below the first, a wide lens would lose half its
resolution in the middle to show a little more at the corners."""

_BORDER_STEPS = 33
_ZOOM_STEPS = 64
_ZOOM_BISECTIONS = 12
_ROUND_TRIP_PX = 0.01
"""Where a distortion folds back on itself, going there and back ends elsewhere."""
_OUTSIDE_PX = 0.01
"""Of rounding; beyond it the border would repeat its last pixels."""

PERSPECTIVE_TERMS = MappingProxyType(
    {
        "SIMPLE_PINHOLE": (),
        "PINHOLE": (),
        "SIMPLE_RADIAL": ("k1",),
        "RADIAL": ("k1", "k2"),
        "OPENCV": ("k1", "k2", "p1", "p2"),
        "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    }
)
FISHEYE_TERMS = MappingProxyType(
    {
        "SIMPLE_FISHEYE": (),
        "FISHEYE": (),
        "SIMPLE_RADIAL_FISHEYE": ("k1",),
        "RADIAL_FISHEYE": ("k1", "k2"),
        "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
    }
)
"""Distortion coefficients of COLMAP's models, in its order. Each model holds those before it in its table, so
that a lens can be said in the last one, or in the first of the common ones that has all it needs."""


@dataclass(frozen=True, kw_only=True)
class PlacedPhoto:
    """Where a photograph was taken and through which lens."""

    index: int
    """Of the photograph among those given."""
    lens: pycolmap.Camera
    """Over an image of the same shape as the photograph, of any size."""
    camera_from_world: Float64[np.ndarray, "4 4"]


@dataclass(frozen=True, kw_only=True)
class Placement:
    """What is known of the cameras before the photographs are undistorted."""

    placed: tuple[PlacedPhoto, ...]
    """In the order of the photographs."""
    sparse_positions: Float64[np.ndarray, "points 3"]
    sparse_visibility: Bool[np.ndarray, "points placed"]
    unplaced: tuple[Unplaced, ...]
    """The other photographs, in their order."""
    reprojection_error_px: float | None
    """In pixels of the photographs; None where the cameras were given."""
    evidence: CameraEvidence | None = None
    """The same."""
    estimated: bool = False
    """Whether FewView found the cameras from the photographs, be it in an earlier job."""
    suit_outlines: bool = False
    """Whether they were moved until the subject's outlines suit each other."""
    way_up_told: bool = False
    """Whether the photographs told which way up given cameras are."""
    decisions: tuple[Decision, ...] = ()


def undistorted_view(photo: Photo, placed: PlacedPhoto) -> View:
    """The photograph as a pinhole camera at the same place would have taken it, at the photograph's size.

    The principal point stays; the focal length is the smallest that leaves no blank border.
    Raises ReconstructionError(CAMERAS_UNUSABLE) where the lens does not bend light in a sensible way.
    """
    height, width = photo.image_srgb.shape[:2]
    lens = rescaled_lens(colmap_lens(photo_lens(photo, placed)), width, height)
    zoom = smallest_filled_zoom_or_none(lens)
    if zoom is None:
        text = f"The lens distortion given for {photo.name} folds the picture or shows nothing of it."
        raise ReconstructionError(ErrorCode.CAMERAS_UNUSABLE, text, "Check its distortion coefficients.")
    camera = Camera(
        camera_from_world=placed.camera_from_world,
        fx_px=lens.focal_length_x * zoom,
        fy_px=lens.focal_length_y * zoom,
        cx_px=lens.principal_point_x,
        cy_px=lens.principal_point_y,
        width=width,
        height=height,
    )
    if is_pinhole(lens):
        return View(name=photo.name, camera=camera, image_srgb=photo.image_srgb, mask=photo.mask)
    sources = source_pixels(lens, camera)
    image = bilinear(photo.image_srgb, sources).astype(np.float32)
    mask = None if photo.mask is None else bilinear(photo.mask[..., None], sources)[..., 0].astype(np.float32)
    return View(name=photo.name, camera=camera, image_srgb=image, mask=mask)


def photo_lens(photo: Photo, placed: PlacedPhoto) -> Lens:
    """The lens over the photograph's original size, in the plainest common model that says the same.

    Views are made from this record alone, so that what is written of it gives the same views again.
    """
    lens = rescaled_lens(_plainest_lens(placed.lens), photo.original_width, photo.original_height)
    params = tuple(float(value) for value in lens.params)
    return Lens(model=lens.model.name, width=lens.width, height=lens.height, params=params)


def colmap_lens(lens: Lens) -> pycolmap.Camera:
    """The record as COLMAP's camera."""
    return pycolmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=list(lens.params))


def _plainest_lens(lens: pycolmap.Camera) -> pycolmap.Camera:
    """The same lens, in the plainest of the common models with two focal lengths where one says the same.

    With two, each scales with its own side when a picture's sides are rounded to whole pixels.
    """
    name = lens.model.name
    if name not in PERSPECTIVE_TERMS and name not in FISHEYE_TERMS:
        return lens
    terms = {**PERSPECTIVE_TERMS, **FISHEYE_TERMS}
    values = lens.params[len(lens.params) - len(terms[name]) :]
    coefficients = dict(zip(terms[name], values, strict=True))
    model = _plainest_model(coefficients, fisheye=name in FISHEYE_TERMS)
    focal_and_centre = (
        lens.focal_length_x,
        lens.focal_length_y,
        lens.principal_point_x,
        lens.principal_point_y,
    )
    params = [*focal_and_centre, *(coefficients.get(term, 0.0) for term in terms[model])]
    return pycolmap.Camera(model=model, width=lens.width, height=lens.height, params=params)


def _plainest_model(coefficients: Mapping[str, float], *, fisheye: bool) -> str:
    """Of the models with two focal lengths, the smallest that has all coefficients that are not 0."""
    if fisheye:
        return "OPENCV_FISHEYE"
    needed = {term for term, value in coefficients.items() if value != 0}
    common = ("PINHOLE", "OPENCV", "FULL_OPENCV")
    return next(name for name in common if needed <= set(PERSPECTIVE_TERMS[name]))


def rescaled_lens(lens: pycolmap.Camera, width: int, height: int) -> pycolmap.Camera:
    """The same lens over an image of another size."""
    rescaled = copy(lens)
    rescaled.rescale(width, height)
    return rescaled


def is_pinhole(lens: pycolmap.Camera) -> bool:
    """Whether straight lines stay straight; a fisheye without coefficients still bends them."""
    return bool(lens.is_perspective_pinhole() and lens.is_undistorted())


def smallest_filled_zoom_or_none(lens: pycolmap.Camera) -> float | None:
    """The smallest focal length, in those of the lens, at which a pinhole view shows the picture alone.

    1 for a pinhole. None where no zoom does: the lens folds, or is no perspective lens.
    """
    if not lens.is_perspective():
        return None
    if is_pinhole(lens):
        return 1.0
    filled = None
    for zoom in np.geomspace(LARGEST_ZOOM, SMALLEST_ZOOM, _ZOOM_STEPS):
        if not _is_filled(lens, zoom):
            return filled if filled is None else _bisected_zoom(lens, zoom, filled)
        filled = float(zoom)
    return filled


def source_pixels(lens: pycolmap.Camera, camera: Camera) -> Float64[np.ndarray, "height width 2"]:
    """For each pixel of the pinhole camera, the image point of the lens on the same ray."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack(
        [
            (columns - camera.cx_px) / camera.fx_px,
            (rows - camera.cy_px) / camera.fy_px,
            np.ones_like(columns),
        ],
        axis=-1,
    )
    image_points: Float64[np.ndarray, "pixels 2"] = lens.img_from_cam(rays.reshape(-1, 3))
    return image_points.reshape(camera.height, camera.width, 2)


def _bisected_zoom(lens: pycolmap.Camera, too_small: float, filled: float) -> float:
    for _ in range(_ZOOM_BISECTIONS):
        middle = (too_small * filled) ** 0.5
        if _is_filled(lens, middle):
            filled = middle
        else:
            too_small = middle
    return filled


def _is_filled(lens: pycolmap.Camera, zoom: float) -> bool:
    """Whether the border of the zoomed pinhole view lies inside the picture, on this side of any fold."""
    steps = np.linspace(0.0, 1.0, _BORDER_STEPS)
    zeros, ones = np.zeros_like(steps), np.ones_like(steps)
    border = np.concatenate(
        [
            np.stack([steps, zeros], axis=1),
            np.stack([steps, ones], axis=1),
            np.stack([zeros, steps], axis=1),
            np.stack([ones, steps], axis=1),
        ]
    ) * (lens.width, lens.height)
    focal = np.array([lens.focal_length_x, lens.focal_length_y])
    centre = np.array([lens.principal_point_x, lens.principal_point_y])
    rays = (border - centre) / (focal * zoom)
    # Along the way to the border as well: a fold may come before it.
    rays = np.concatenate([rays * share for share in (0.25, 0.5, 0.75, 1.0)])
    image_points = lens.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
    inside = (image_points >= -_OUTSIDE_PX) & (image_points <= np.add((lens.width, lens.height), _OUTSIDE_PX))
    if not inside.all():
        return False
    back = lens.cam_from_img(image_points)
    return bool((np.abs(back - rays) * focal).max() <= _ROUND_TRIP_PX)


def rigid_matrix(b_from_a: pycolmap.Rigid3d) -> Float64[np.ndarray, "4 4"]:
    """A rigid transform as a 4x4 matrix."""
    return np.vstack([b_from_a.matrix(), [0.0, 0.0, 0.0, 1.0]])


def shared_tracks(model: pycolmap.Reconstruction, image_ids: Sequence[int]) -> dict[int, dict[int, int]]:
    """For each point that at least two of the images see: the place of such an image among them, and the
    number of its feature there. Points are in the order of their ids."""
    column = {image_id: index for index, image_id in enumerate(image_ids)}
    tracks = {}
    for point_id, point in sorted(model.points3D.items()):
        elements = point.track.elements
        track = {column[e.image_id]: e.point2D_idx for e in elements if e.image_id in column}
        if len(track) >= 2:
            tracks[point_id] = track
    return tracks


def sparse_points(
    model: pycolmap.Reconstruction, image_ids: Sequence[int]
) -> tuple[Float64[np.ndarray, "points 3"], Bool[np.ndarray, "points images"]]:
    """Positions of the points that at least two of the images see, and which of them do."""
    tracks = shared_tracks(model, image_ids)
    visibility = np.zeros((len(tracks), len(image_ids)), bool)
    for row, track in enumerate(tracks.values()):
        visibility[row, list(track)] = True
    positions = [model.points3D[point_id].xyz for point_id in tracks]
    return np.array(positions, np.float64).reshape(-1, 3), visibility
