"""What to reconstruct: a sphere around the subject, found from masks, sparse points or cameras.

In this order of evidence: masks cut out the subject from every side; without them, triangulated
points say where the photographs overlap; without those, the cameras' axes say what they look at. What
stands whole before an even backdrop is not cut off.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.ndimage import label

from ..errors import ErrorCode, ReconstructionError
from ..maths.lines import nearest_to_lines
from ..maths.projection import in_picture, projected, shown
from ..scene import Camera, Decision, Mask, Progress, Region, SolvedCameras, View, to_unit_sphere
from .standing_alone import share_cut_off, standing_alone

FEATURES_REACH = 1.1
"""The surface goes on where features end."""

ROOM = 2.5
"""Times the radius of what all photographs show whole, from which on the rest is the room around it, and the
subject, where most of the points lie, would be a trifle in a sphere around all of them. Measured
with things that stand alone 0.6 to 1.1, with a facade 1.6, with a vase on a table in a room 8."""

LEAST_COMMON = 0.6
"""Share of each mask that what all masks have in common must fill. Measured: 0.88 to 1 with masks that are
right or a twentieth of the picture off; in the worst photograph 0.2 to 0.5 if one of them is inverted."""
DOUBTFUL_COMMON = 0.8
"""Share below which masks are doubted, though they are used. 0.6 to 0.75 if one of them lacks half."""

_FEWEST_SUBJECT_PX = 9
"""Of a mask: fewer are a slip, as one white dot, against which a subject in grey counts as black."""
_ONE_PLACE = 1e-9
"""Of how far cameras are from the origin: nearer to each other, only rounding is between them."""

_CUT_OFF = 0.01
"""Share of what stands whole before a backdrop that the region may leave out."""
_FINER = 3
"""Times as many cells along each axis, where those that are enough for most things find masks in conflict."""
_CLOSE_UP = 0.5
"""Share of what the median photograph shows of the subject's place, below which one is a close-up."""


@dataclass(frozen=True, kw_only=True)
class RegionConfig:
    """Where to look, if it is not to be found automatically."""

    centre_world: tuple[float, float, float] | None = None
    radius_world: float | None = None
    margin: float = 1.08
    """Room left around the subject."""
    hull_cells: int = 64
    """Cells along each axis of the grid that masks are carved from."""


def find_region(solved: SolvedCameras, config: RegionConfig, *, progress: Progress) -> Region:
    """The sphere that holds the subject.

    Raises ReconstructionError: NO_SURFACE if the masks have nothing in common, MASK_UNUSABLE if they have
    hardly anything, CAMERAS_UNUSABLE if the cameras do not look at one place, or stand in one.
    """
    progress(0.0, "finding the subject")
    _check_apart([view.camera for view in solved.views])
    if config.centre_world is not None and config.radius_world is not None:
        centre = np.array(config.centre_world)
        _check_shown(centre, config.radius_world, [view.camera for view in solved.views])
        return replace(_region(centre, config.radius_world, "as given", "set by the user"), given=True)
    masked = [view for view in solved.views if view.mask is not None]
    if len(masked) >= 2:
        centre, radius, doubt = _of_masks(masked, config)
        because = f"{len(masked)} photographs have masks"
        return replace(_region(centre, radius, "the masked subject", because), doubt=doubt)
    cameras = _overviews([view.camera for view in solved.views])
    if len(solved.sparse_positions) >= 20:
        centre, radius = _of_points(solved, cameras)
        middle, within = _shown_whole(cameras)
        share = float((np.linalg.norm(solved.sparse_positions - middle, axis=1) < within).mean())
        if 0 < ROOM * within <= radius and share > 0.5:
            because = f"{share:.0%} of the triangulated points lie there, the others up to "
            because += f"{radius / within:.0f} times as far from each other"
            return _region(middle, within, "what all photographs have in their middle", because)
        radius *= FEATURES_REACH * config.margin
        choice = "where the photographs overlap"
        because = f"no masks, but {len(solved.sparse_positions)} triangulated points"
    else:
        centre, radius = _shown_whole(cameras)
        if radius <= 0:
            raise _looking_apart(solved.views, centre)
        choice, because = "what all cameras look at", "neither masks nor triangulated points"
    found, alone = _region(centre, radius, choice, because), standing_alone(solved.views)
    if len(alone) >= 2 and (cut_off := share_cut_off(alone, found)) > _CUT_OFF:
        # what each shows may be another thing; then finer cells, as `_of_masks` tries, take long for nothing
        with suppress(ReconstructionError):
            hull_centre, hull_radius, _ = _of_hull(alone, config)
            centre, radius = around_both((centre, radius), (hull_centre, hull_radius * config.margin))
            choice += ", and what stands alone before an even backdrop"
            because += f", which leave out {cut_off:.0%} of what {len(alone)} photographs show whole"
            found = _region(centre, radius, choice, because)
    return found


def around_both(
    one: tuple[Float64[np.ndarray, "3"], float], other: tuple[Float64[np.ndarray, "3"], float]
) -> tuple[Float64[np.ndarray, "3"], float]:
    """Centre and radius of the smallest sphere around two."""
    (small, small_radius), (large, large_radius) = sorted((one, other), key=lambda sphere: sphere[1])
    apart = float(np.linalg.norm(large - small))
    if apart + small_radius <= large_radius:
        return large, large_radius
    radius = (apart + small_radius + large_radius) / 2
    return small + (large - small) * (radius - small_radius) / apart, radius


def _region(centre: Float64[np.ndarray, "3"], radius: float, choice: str, because: str) -> Region:
    decision = Decision(what="region", choice=choice, because=because)
    return Region(object_from_world=to_unit_sphere(centre, radius), decisions=(decision,))


def _check_shown(centre: Float64[np.ndarray, "3"], radius: float, cameras: list[Camera]) -> None:
    """Raises ReconstructionError(SETTINGS_INVALID) for a region that fewer than two photographs show."""
    steps = np.linspace(-1, 1, 15)
    ball = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    ball = ball[np.linalg.norm(ball, axis=1) <= 1] * radius + centre
    showing = [camera for camera in cameras if in_picture(ball, camera).any()]
    around = [camera for camera in cameras if np.linalg.norm(camera.position - centre) < radius]
    if len(showing) < 2 and len(around) < 2:
        where = ", ".join(f"{value:g}" for value in centre)
        raise ReconstructionError(
            ErrorCode.SETTINGS_INVALID,
            f"The region that was given, of radius {radius:g} around ({where}), is in the picture of "
            f"{len(showing)} of {len(cameras)} photographs.",
            "Give it in the frame of the cameras, around the subject, or leave it out.",
        )


def _check_apart(cameras: list[Camera]) -> None:
    """Raises ReconstructionError(CAMERAS_UNUSABLE) where all cameras stand in one place."""
    positions = np.array([camera.position for camera in cameras])
    if np.ptp(positions, axis=0).max() <= _ONE_PLACE * np.abs(positions).max():
        raise ReconstructionError(
            ErrorCode.CAMERAS_UNUSABLE,
            "All cameras stand in one place, from where photographs show no depth.",
            "Check the positions in the cameras file.",
        )


def _looking_apart(views: Sequence[View], at: Float64[np.ndarray, "3"]) -> ReconstructionError:
    """The error of cameras that do not look at what is nearest to all their axes."""
    away = [view.name for view in views if _depth(view.camera, at) <= 0]
    others = f" That of {away[0]} looks away from it." if len(away) == 1 else ""
    return ReconstructionError(
        ErrorCode.CAMERAS_UNUSABLE,
        f"The cameras do not look at a common place, so the subject cannot be located.{others}",
        "Check the cameras file: the matrices of a transforms.json are camera-to-world, of cameras that look "
        "along their negative z axis with y up.",
    )


def _depth(camera: Camera, at: Float64[np.ndarray, "3"]) -> float:
    """Of a point before the camera, along its axis."""
    return float(camera.camera_from_world[2, :3] @ at + camera.camera_from_world[2, 3])


def _overviews(cameras: list[Camera]) -> list[Camera]:
    """Those that show about as much as most do: what is not in a close-up may be the subject."""
    centre = nearest_to_axes(cameras)
    shown_world = np.array(
        [
            np.linalg.norm(camera.position - centre)
            * min(camera.width / camera.fx_px, camera.height / camera.fy_px)
            for camera in cameras
        ]
    )
    wide = shown_world > _CLOSE_UP * np.median(shown_world)
    return [camera for camera, shows in zip(cameras, wide, strict=True) if shows]


def nearest_to_axes(cameras: list[Camera]) -> Float64[np.ndarray, "3"]:
    """The point with the least squared distance to all optical axes."""
    axes = np.array([camera.camera_from_world[2, :3] for camera in cameras])
    return np.asarray(nearest_to_lines(np.array([camera.position for camera in cameras]), axes)[0])


def _shown_whole(cameras: list[Camera]) -> tuple[Float64[np.ndarray, "3"], float]:
    """The largest sphere around the look-at point that all photographs show whole; radius <= 0: none."""
    centre = nearest_to_axes(cameras)
    return centre, min(_radius_in_frame(camera, centre) for camera in cameras)


def _radius_in_frame(camera: Camera, centre: Float64[np.ndarray, "3"]) -> float:
    """Distance of a point from the nearest side of the camera's frustum; negative outside."""
    x, y, z = camera.camera_from_world[:3, :3] @ centre + camera.camera_from_world[:3, 3]
    sides = np.array(
        [
            [camera.fx_px, 0, camera.cx_px],
            [-camera.fx_px, 0, camera.width - camera.cx_px],
            [0, camera.fy_px, camera.cy_px],
            [0, -camera.fy_px, camera.height - camera.cy_px],
            [0, 0, 1],
        ]
    )
    return float((sides @ [x, y, z] / np.linalg.norm(sides, axis=1)).min())


def _of_points(solved: SolvedCameras, cameras: list[Camera]) -> tuple[Float64[np.ndarray, "3"], float]:
    """A sphere around the bulk of the points, each weighing as much as photographs see it.

    The subject is what nearly all of these cameras have in their frames: what lies behind it for one camera
    is behind or beside another. Of what is left, the weighted median and a high quantile of the distances
    leave out the few that are far.
    """
    weight = solved.sparse_visibility.sum(axis=1).astype(np.float64) - 1
    weight = np.maximum(weight, 0.1)
    points = solved.sparse_positions
    framed = np.mean([in_picture(points, camera) for camera in cameras], axis=0) > 0.8
    if framed.sum() >= 20:
        points, weight = points[framed], weight[framed]
    centre = np.array([weighted_quantile(points[:, axis], weight, 0.5) for axis in range(3)])
    for _ in range(3):
        distance = np.linalg.norm(points - centre, axis=1)
        near = distance <= weighted_quantile(distance, weight, 0.9)
        low, high = np.quantile(points[near], 0.02, axis=0), np.quantile(points[near], 0.98, axis=0)
        centre = (low + high) / 2
    distance = np.linalg.norm(points - centre, axis=1)
    return centre, weighted_quantile(distance, weight, 0.93)


def weighted_quantile(
    values: Float64[np.ndarray, "n"], weights: Float64[np.ndarray, "n"], share: float
) -> float:
    """The value below which `share` of the weight lies."""
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(cumulative, share * cumulative[-1])])


def _of_masks(views: list[View], config: RegionConfig) -> tuple[Float64[np.ndarray, "3"], float, str | None]:
    """Bounding sphere of the visual hull, with room around it, and what speaks against the masks."""
    try:
        centre, radius, doubt = _of_hull(views, config)
    except ReconstructionError as error:
        at = nearest_to_axes([view.camera for view in views])
        if any(_depth(view.camera, at) <= 0 for view in views):
            raise _looking_apart(views, at) from error
        # narrow bars may fall between the middles of all cells
        centre, radius, doubt = _of_hull(views, replace(config, hull_cells=_FINER * config.hull_cells))
    return centre, radius * config.margin, doubt


def _of_hull(views: list[View], config: RegionConfig) -> tuple[Float64[np.ndarray, "3"], float, str | None]:
    """Bounding sphere of the visual hull: what lies inside the masks of all photographs that show it.

    With it what speaks against the masks.

    Photographs from nearly one side leave the hull open in depth; there the subject is taken to be
    at most half again as deep as it is wide.
    """
    first_centre, first_radius = around_masks(views)
    centre, radius = first_centre, first_radius
    steps = np.linspace(-1, 1, config.hull_cells)
    unit_cells = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1)
    for _ in range(3):
        cells = unit_cells * radius + centre
        counts = _masks_around(cells.reshape(-1, 3), views).reshape(cells.shape[:3])
        counts[np.linalg.norm(cells - first_centre, axis=-1) > first_radius] = 0
        kept = cells[without_ghosts(counts)]
        if not len(kept):
            raise ReconstructionError(
                ErrorCode.NO_SURFACE,
                "The masks have no part of space in common.",
                "Check that masks are white on the subject and belong to these photographs and cameras.",
            )
        low, high = kept.min(axis=0), kept.max(axis=0)
        centre = (low + high) / 2
        cell = 2 * radius / config.hull_cells
        radius = float(np.linalg.norm(kept - centre, axis=1).max()) + cell
    return centre, radius, _doubt_in_common(views, kept, cell)


def _doubt_in_common(views: list[View], hull: Float64[np.ndarray, "cells 3"], cell: float) -> str | None:
    """For a person, where the hull, in such cells, leaves a part of a mask empty; None where it does not.

    Raises ReconstructionError(MASK_UNUSABLE) where it leaves much of one empty.
    """
    filled = {view.name: _share_filled(view, hull, cell) for view in views}
    worst = min(filled, key=lambda name: filled[name])
    if filled[worst] >= DOUBTFUL_COMMON:
        return None
    text = (
        "The masks contradict each other: "
        f"what they have in common fills only {filled[worst]:.0%} of the mask of {worst}."
    )
    remedy = "Check that all masks are white on the subject and belong to these photographs and cameras."
    if filled[worst] < LEAST_COMMON:
        raise ReconstructionError(ErrorCode.MASK_UNUSABLE, text, remedy)
    return f"{text} What is cut off in one photograph is cut off the mesh. {remedy}"


def _share_filled(view: View, hull: Float64[np.ndarray, "cells 3"], cell: float) -> float:
    """Of a mask, by the hull's cells: of squares of the photograph that are a little wider than a cell."""
    assert view.mask is not None
    pixels, depth = projected(hull, view.camera)
    front = depth > 0
    if not front.any():
        return 0.0
    square_px = max(1.0, 1.5 * cell * view.camera.fx_px / float(np.median(depth[front])))
    squares = math.ceil(max(view.mask.shape) / square_px)
    filled, on = np.zeros((2, squares, squares), bool)
    column, row = (pixels[front] / square_px).astype(int).T
    inside = (row >= 0) & (row < squares) & (column >= 0) & (column < squares)
    filled[row[inside], column[inside]] = True
    rows, columns = np.nonzero(view.mask > 0.5)
    on[(rows / square_px).astype(int), (columns / square_px).astype(int)] = True
    return float(filled[on].mean())


def without_ghosts(counts: Int64[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """Cells in at least two masks, in pieces that somewhere more than half of the best number show.

    Between two cameras that face each other, near one of them, lies space that both masks hold and that
    no other photograph shows: a piece of its own, in few masks.
    """
    piece, num_pieces = label(counts >= 2, np.ones((3, 3, 3)))
    best = np.zeros(num_pieces + 1, np.int64)
    np.maximum.at(best, piece.ravel(), counts.ravel())
    best[0] = 0
    real = (best > best.max() / 2)[piece]
    return np.asarray(real, bool)


def shows_subject(mask: Mask) -> bool:
    """Whether there is anything but a slip on it."""
    return bool(np.count_nonzero(mask > 0.5) >= _FEWEST_SUBJECT_PX)


def around_masks(views: Sequence[View]) -> tuple[Float64[np.ndarray, "3"], float]:
    """Where the rays through the middles of the masks meet, and how large the masks are there."""
    directions, sizes_px = [], []
    for view in views:
        assert view.mask is not None
        rows, columns = np.nonzero(view.mask > 0.5)
        if not shows_subject(view.mask):
            raise ReconstructionError(
                ErrorCode.MASK_UNUSABLE,
                f"The mask of {view.name} is empty: only {len(rows)} pixels are brighter than half of white.",
                "Masks must be white on the subject and black elsewhere.",
            )
        middle = np.array([(columns.min() + columns.max() + 1) / 2, (rows.min() + rows.max() + 1) / 2, 1.0])
        direction = view.camera.camera_from_world[:3, :3].T @ np.linalg.solve(view.camera.intrinsics, middle)
        directions.append(direction / np.linalg.norm(direction))
        sizes_px.append(float(np.hypot(columns + 0.5 - middle[0], rows + 0.5 - middle[1]).max()))
    cameras = [view.camera for view in views]
    centre = nearest_to_lines(np.array([camera.position for camera in cameras]), np.array(directions))[0]
    depths = [np.linalg.norm(centre - camera.position) / camera.fx_px for camera in cameras]
    return centre, 1.5 * float(np.multiply(depths, sizes_px).max())


def _masks_around(points: Float64[np.ndarray, "points 3"], views: list[View]) -> Int64[np.ndarray, "points"]:
    """How many photographs show each point on the subject; 0 where one shows it off the subject."""
    on, left = np.zeros(len(points), np.int64), np.arange(len(points))
    for view in views:
        assert view.mask is not None
        pixels, depth = projected(points[left], view.camera)
        visible = shown(pixels, depth, view.camera)
        column, row = pixels[visible].astype(int).T
        off = np.zeros(len(left), bool)
        off[visible] = view.mask[row, column] <= 0.5
        on[left] = np.where(off, 0, on[left] + visible)
        left = left[~off]  # soon a few: most points are off the first masks
    return on
