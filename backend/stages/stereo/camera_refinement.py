"""Estimated cameras held against the surface: patches of it are looked for where cameras put them.

Structure from motion places cameras by corners and blobs. Once stereo knows the planes of surface, a patch is
found in another photograph to a few hundredths of a pixel wherever there is texture. How far patches lie
beside their epipolar lines is what cameras are wrong by, whatever the depth. Only where that is much are
cameras adjusted to the patches, and stereo done again.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import PIL.Image  # noqa: F401 - pycolmap loaded before Pillow corrupts memory when Pillow next saves
import pycolmap
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from ...maths.geometry import Pinhole, inside, pinhole_in_object, project, sample_image
from ...maths.patch_alignment import align, beside_epipolar_lines_px, on_planes, patch_pixels
from ...maths.projection import projected
from ...scene import (
    Camera,
    Decision,
    Region,
    SolvedCameras,
    StereoResult,
    SurfacePoints,
    View,
    transform_points,
)
from ..cameras.bundle_adjustment import adjust_bundle
from ..cameras.lenses import rigid_matrix
from .windows import neighbours

_WHAT = "estimated cameras, held against the surface"

_WORTH_REFINING_PX = 0.3
"""Evidence from which on cameras are adjusted. Photographs that suit come to 0.01 to 0.09 px; 0.5 px makes
the surface 2 % worse, and stereo takes as long again."""
_LARGEST_SHARE_LEFT = 0.5
"""Adjusted cameras are taken where they leave less than this of the evidence: a lens that is not as modelled,
or a subject that moved, cannot be mended by moving cameras."""
_LARGEST_MOVE_PX = 4.0
"""By which adjusting may move what a camera sees: beyond, patches were not found but mistaken."""

_PATCHES_PER_VIEW = 200
_PATCH_RADIUS_PX = 5
_VIEWS_PER_PATCH = 4
"""Other photographs in which a patch is looked for."""
_REACH_PX = 4.0
"""How far from where it should be."""
_ROUNDS = 6
_LEAST_CONFIDENCE = 0.2
_LEAST_CORRELATION = 0.8
_LARGEST_SIGMA_PX = 0.1
"""Of a patch: where nothing but noise is compared it comes out as 0.13, whatever the noise."""
_LEAST_FACING = 0.4
"""Cosine between a patch's normal and the direction to a camera in which it is looked for."""
_NO_NUMBERS = np.zeros(0, np.int64)
_FEWEST_IN_QUARTER = 8
"""Patches whose median tells something."""
_ROBUST_SCALE_PX = 0.25
"""Of the Cauchy loss, for patches that were mistaken for others."""


@dataclass(frozen=True, kw_only=True)
class Sightings:
    """Patches of surface, each cut out of one photograph, and where other photographs show them."""

    positions: Float64[np.ndarray, "patches 3"]
    """World frame, as stereo knows them."""
    home: Int64[np.ndarray, "patches"]
    """The photograph that the patch was cut out of."""
    home_px: Float64[np.ndarray, "patches 2"]
    patch: Int64[np.ndarray, "sightings"]
    view: Int64[np.ndarray, "sightings"]
    """The other photograph."""
    seen_px: Float64[np.ndarray, "sightings 2"]

    def of_patches(self, chosen: Bool[np.ndarray, "patches"]) -> "Sightings":
        """Those of some of the patches; the others have none."""
        kept = chosen[self.patch]
        return replace(self, patch=self.patch[kept], view=self.view[kept], seen_px=self.seen_px[kept])


@dataclass(frozen=True, kw_only=True)
class Refined:
    """What came of holding cameras against the surface."""

    cameras: tuple[Camera, ...] | None
    """None where they are to stay as they are."""
    decision: Decision


def with_refined(solved: SolvedCameras, stereo: StereoResult) -> SolvedCameras:
    """The cameras that the depth maps belong to."""
    if stereo.refined_cameras is None:
        return solved
    return replace(solved, views=with_cameras(solved.views, stereo.refined_cameras))


def with_cameras(views: Sequence[View], cameras: Sequence[Camera]) -> tuple[View, ...]:
    """The same photographs, taken from elsewhere."""
    return tuple(replace(view, camera=camera) for view, camera in zip(views, cameras, strict=True))


def refine_cameras(
    views: Sequence[View], region: Region, points: SurfacePoints, *, device: torch.device
) -> Refined:
    """Cameras adjusted to patches of the surface, if these say that there is something to gain.

    Every other patch has no say in the adjustment: those judge it.
    """
    with torch.no_grad():
        seen = find_patches(views, region, points, device=device)
    cameras = tuple(view.camera for view in views)
    before_px = misplaced_px(cameras, seen)
    if before_px is None:
        return _left("too few patches of surface are found again in other photographs to tell")
    lie = f"{len(seen.patch)} patches of surface lie {before_px:.2f} px beside their epipolar lines"
    if before_px < _WORTH_REFINING_PX:
        return _left(f"{lie}; {_WORTH_REFINING_PX:g} px would be worth a refinement")
    judging = np.arange(len(seen.positions)) % 2 == 1
    judges = seen.of_patches(judging)
    adjusted = adjusted_cameras(cameras, seen.of_patches(~judging))
    before_px, after_px = misplaced_px(cameras, judges), misplaced_px(adjusted, judges)
    if before_px is None or after_px is None or after_px > _LARGEST_SHARE_LEFT * before_px:
        return _left(f"{lie}, and moving the cameras does not mend it")
    moved_px = largest_move_px(cameras, adjusted, seen.positions)
    if moved_px > _LARGEST_MOVE_PX:
        return _left(f"{lie}, but to mend it a camera would have to see points {moved_px:.1f} px from there")
    because = f"{lie}, and {after_px:.2f} px since cameras moved what they see by up to {moved_px:.1f} px"
    decision = Decision(what=_WHAT, choice="refined", because=because)
    return Refined(cameras=adjusted, decision=decision)


def _left(because: str) -> Refined:
    return Refined(cameras=None, decision=Decision(what=_WHAT, choice="left as estimated", because=because))


def find_patches(
    views: Sequence[View], region: Region, points: SurfacePoints, *, device: torch.device
) -> Sightings:
    """A spread of patches around the points, looked for in photographs that should show them."""
    cameras = [pinhole_in_object(view.camera, region, device) for view in views]
    greys = [torch.tensor(view.image_srgb, device=device).mean(dim=-1) for view in views]
    nearby = neighbours(cameras, _VIEWS_PER_PATCH)
    home: list[Int64[np.ndarray, "chosen"]] = []
    patch: list[Int64[np.ndarray, "found"]] = []
    seen_in: list[Int64[np.ndarray, "found"]] = []
    positions, home_px, seen_px = [], [], []
    for index, camera in enumerate(cameras):
        chosen = _spread(points, index, camera)
        if not len(chosen):
            continue
        first = sum(map(len, home))
        position = torch.tensor(points.positions[chosen], device=device)
        normal = torch.tensor(points.normals[chosen], device=device)
        pixels = project(camera, position)[0]
        home.append(np.full(len(chosen), index))
        positions.append(position)
        home_px.append(pixels)
        square = patch_pixels(pixels, _PATCH_RADIUS_PX)
        reference = sample_image(greys[index][None], square[None])[0, 0]
        surface = on_planes(camera, square, position, normal)
        for other in nearby[index]:
            rows = torch.nonzero(_shown(cameras[other], surface, position, normal)).flatten()
            if not len(rows):
                continue
            shift, sure = _shifts(reference[rows], greys[other], project(cameras[other], surface[rows])[0])
            rows = rows[sure]
            patch.append(first + rows.cpu().numpy())
            seen_in.append(np.full(len(rows), other))
            seen_px.append(project(cameras[other], position[rows])[0] + shift[sure])
    none = torch.zeros((0, 2), device=device)
    return Sightings(
        positions=transform_points(region.world_from_object, _float64([none.new_zeros((0, 3)), *positions])),
        home=np.concatenate([_NO_NUMBERS, *home]),
        home_px=_float64([none, *home_px]),
        patch=np.concatenate([_NO_NUMBERS, *patch]),
        view=np.concatenate([_NO_NUMBERS, *seen_in]),
        seen_px=_float64([none, *seen_px]),
    )


def _float64(parts: list[Tensor]) -> Float64[np.ndarray, "rows columns"]:
    # In this order: Apple's GPUs know no float64.
    joined: Float64[np.ndarray, "rows columns"] = torch.cat(parts).cpu().double().numpy()
    return joined


def _spread(points: SurfacePoints, index: int, camera: Pinhole) -> Int64[np.ndarray, "chosen"]:
    """Of the points of a view, the most confident in each cell of a grid over what it shows."""
    rows = np.nonzero((points.view_index == index) & (points.confidence > _LEAST_CONFIDENCE))[0]
    positions = torch.tensor(points.positions[rows], device=camera.intrinsics.device)
    at = project(camera, positions)[0].cpu().numpy()
    margin = _PATCH_RADIUS_PX + 0.5
    whole = ((at > margin) & (at < np.array([camera.width, camera.height]) - margin)).all(axis=1)
    rows, at = rows[whole], at[whole]
    if not len(rows):
        return rows
    side = max(float(np.sqrt(np.ptp(at, axis=0).prod() / _PATCHES_PER_VIEW)), 1.0)
    cell = (at / side).astype(np.int64) @ np.array([1, camera.width])
    order = np.lexsort((-points.confidence[rows], cell))
    return rows[order[np.unique(cell[order], return_index=True)[1]]]


def _shown(
    camera: Pinhole,
    surface: Float[Tensor, "patches patch_pixels 3"],
    position: Float[Tensor, "patches 3"],
    normal: Float[Tensor, "patches 3"],
) -> Bool[Tensor, "patches"]:
    """True where the whole patch is in the picture and faces the camera; something may stand before it."""
    places, depth = project(camera, surface)
    whole = (inside(places, camera.width, camera.height) & (depth > 0)).all(dim=-1)
    facing = (F.normalize(camera.position - position, dim=-1) * normal).sum(dim=-1)
    shown: Bool[Tensor, "patches"] = whole & (facing > _LEAST_FACING)
    return shown


def _shifts(
    reference: Float[Tensor, "patches patch_pixels"],
    grey: Float[Tensor, "height width"],
    places: Float[Tensor, "patches patch_pixels 2"],
) -> tuple[Float[Tensor, "patches 2"], Bool[Tensor, "patches"]]:
    """By how much patches lie beside their places, and which of them are surely found."""
    found = align(reference, grey, places, rounds=_ROUNDS, reach_px=_REACH_PX)
    sure: Bool[Tensor, "patches"] = found.correlation > _LEAST_CORRELATION
    sure &= found.sigma_px < _LARGEST_SIGMA_PX
    sure &= found.shift_px.abs().amax(dim=-1) < _REACH_PX
    return found.shift_px, sure


def misplaced_px(cameras: Sequence[Camera], seen: Sightings) -> float | None:
    """How far off the worst camera is, by how patches in a quarter of a picture lie, as one, off their lines.

    For each two photographs and quarter of the first it is the median of the signed distances, in which the
    patches' own errors cancel; for each camera the median size of all that it takes part in. None where
    nothing is measured.
    """
    of_camera: list[list[float]] = [[] for _ in cameras]
    home = seen.home[seen.patch]
    home_px = seen.home_px[seen.patch]
    for a, b in np.unique(np.stack([home, seen.view], axis=1), axis=0):
        rows = (home == a) & (seen.view == b)
        beside = beside_epipolar_lines_px(cameras[a], cameras[b], home_px[rows], seen.seen_px[rows])
        quarter = (home_px[rows] > np.median(home_px[rows], axis=0)) @ np.array([1, 2])
        parts = (beside[quarter == number] for number in range(4))
        sizes = [abs(float(np.median(part))) for part in parts if len(part) >= _FEWEST_IN_QUARTER]
        of_camera[a] += sizes
        of_camera[b] += sizes
    return max((float(np.median(sizes)) for sizes in of_camera if sizes), default=None)


def largest_move_px(
    cameras: Sequence[Camera], others: Sequence[Camera], positions: Float64[np.ndarray, "points 3"]
) -> float:
    """Median over the points of how far they move in the picture, for the camera in which it is most."""
    moves = [
        np.linalg.norm(projected(positions, a)[0] - projected(positions, b)[0], axis=1)
        for a, b in zip(cameras, others, strict=True)
    ]
    return max(float(np.median(move)) for move in moves)


def adjusted_cameras(cameras: Sequence[Camera], seen: Sightings) -> tuple[Camera, ...]:
    """Poses that suit the sightings best, by bundle adjustment, in a world in which patches stay on average.

    Lenses stay: the photographs have been undistorted by them, and to free the focal length gained nothing.
    """
    model = pycolmap.Reconstruction()
    pixels = [
        np.concatenate([seen.home_px[seen.home == i], seen.seen_px[seen.view == i]])
        for i in range(len(cameras))
    ]
    for index, camera in enumerate(cameras):
        params = [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]
        lens = pycolmap.Camera(model="PINHOLE", width=camera.width, height=camera.height, params=params)
        lens.camera_id = index + 1
        model.add_camera_with_trivial_rig(lens)
        image = pycolmap.Image(
            name=str(index), keypoints=pixels[index], camera_id=index + 1, image_id=index + 1
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(camera.camera_from_world[:3]))
    tracks = _tracks(seen)
    shared = [patch for patch, track in enumerate(tracks) if track.length() >= 2]
    points = [model.add_point3D(seen.positions[patch], tracks[patch]) for patch in shared]
    adjust_bundle(model, free_lens=False, robust_scale_px=_ROBUST_SCALE_PX)
    moved = np.array([model.points3D[point].xyz for point in points]).reshape(-1, 3)
    world_from_adjusted = _similarity_or_none(moved, seen.positions[shared])
    if world_from_adjusted is None:
        return tuple(cameras)
    model.transform(world_from_adjusted)
    poses = (rigid_matrix(model.images[index + 1].cam_from_world()) for index in range(len(cameras)))
    return tuple(replace(camera, camera_from_world=pose) for camera, pose in zip(cameras, poses, strict=True))


def _similarity_or_none(
    moved: Float64[np.ndarray, "points 3"], wanted: Float64[np.ndarray, "points 3"]
) -> pycolmap.Sim3d | None:
    """What puts most points back to where they were; a mistaken patch may have been thrown far away."""
    if len(moved) < _FEWEST_IN_QUARTER:
        return None
    distances = np.linalg.norm(moved - wanted, axis=1)
    sane = distances <= 3 * np.median(distances)
    return pycolmap.estimate_sim3d(moved[sane], wanted[sane])


def _tracks(seen: Sightings) -> list[pycolmap.Track]:
    """For each patch, where its pixels are among those of each photograph: homes come first."""
    tracks = [pycolmap.Track() for _ in seen.positions]
    patches = np.concatenate([np.arange(len(seen.positions)), seen.patch])
    num_before: dict[int, int] = {}
    for patch, view in zip(patches.tolist(), [*seen.home.tolist(), *seen.view.tolist()], strict=True):
        number = num_before.get(view, 0)
        tracks[patch].add_element(view + 1, number)
        num_before[view] = number + 1
    return tracks
