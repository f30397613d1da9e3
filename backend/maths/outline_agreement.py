"""What the outlines of one subject, as several photographs show it, ask of their cameras.

Two things. A plane through two cameras that touches the subject touches its outline in both photographs (the
epipolar tangency of Cipolla, Astrom and Giblin, 1995); there are two such planes, one on each side. And each
ray through an outline touches the subject somewhere, so that somewhere along it all other photographs show
the subject (the coherence of silhouettes of Hernandez, Schmitt and Cipolla, 2007). The first is an equation,
the second an inequality; both hold exactly whatever the shape, and need no texture.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float64, Int64

from .bilinear import bilinear
from .lines import nearest_along
from .posed_views import PosedViews
from .silhouette import Silhouette

_DEPTHS = 48
"""Tried along a ray; then twice as many steps of an eighth around the best."""
_FINER = 8
_HALF_STEP_PX = 0.5
_TOLERATED_PX = 0.1
"""Off the subject: outlines are not known better."""
_LARGEST_SPAN = 2.6
"""Radians that a silhouette takes of the planes through two cameras: more, and it may hold the epipole."""


@dataclass(frozen=True, kw_only=True)
class Lines:
    """Places on rays of photographs, each beside a line on which another photograph should show it.

    How far beside changes with the views, to first order, as if place and line stood on the two photographs
    where they stand.
    """

    view: Int64[np.ndarray, "lines"]
    pixels: Float64[np.ndarray, "lines 2"]
    depth: Float64[np.ndarray, "lines"]
    """Of the place, along the axis of its view."""
    other: Int64[np.ndarray, "lines"]
    """The view that shows it beside the line."""
    normal: Float64[np.ndarray, "lines 2"]
    """Of the line, in that view's picture."""
    beside_px: Float64[np.ndarray, "lines"]
    """How far along that normal."""

    def chosen(self, which: Bool[np.ndarray, "lines"]) -> "Lines":
        """Some of them."""
        return Lines(**{field.name: getattr(self, field.name)[which] for field in fields(self)})

    def change(self, views: PosedViews) -> Float64[np.ndarray, "lines unknowns"]:
        """Of `beside_px` with a step of the views."""
        places = views.places(self.view, self.pixels, self.depth)
        of_other, of_place = views.change_of_shown(self.other, places)
        by_step = of_other + of_place @ views.change_of_places(self.view, self.pixels, self.depth)
        change: Float64[np.ndarray, "lines unknowns"] = np.einsum("ki,kiu->ku", self.normal, by_step)
        return change


def tangencies(views: PosedViews, silhouettes: Sequence[Silhouette]) -> Lines:
    """For each two views and each side, both ways: where one's outline is touched, beside the other's."""
    found = [_no_lines()]
    for a, b in combinations(range(len(silhouettes)), 2):
        axis = views.positions[b] - views.positions[a]
        if not axis.any():  # from one place all planes are told, and none of them
            continue
        of_a = _touched(views, silhouettes[a], a, axis=axis, other=b)
        of_b = _touched(views, silhouettes[b], b, axis=axis, other=a)
        if of_a is not None and of_b is not None:
            touched, others = np.concatenate([of_a, of_b]), np.concatenate([of_b, of_a])
            view = np.array([a, a, b, b])
            found.append(_beside_epipolar_lines(views, view, touched, view[::-1], others))
    return Lines(
        **{
            field.name: np.concatenate([getattr(lines, field.name) for lines in found])
            for field in fields(Lines)
        }
    )


def _touched(
    views: PosedViews, silhouette: Silhouette, view: int, *, axis: Float64[np.ndarray, "3"], other: int
) -> Float64[np.ndarray, "2 2"] | None:
    """Corners of the hull touched by the first and the last plane around the axis; None if it holds that."""
    corners = silhouette.hull_px
    directions = views.directions(np.full(len(corners), view), corners)
    middle = views.rotation[view][2] + views.rotation[other][2]
    out = middle - axis * (middle @ axis) / (axis @ axis)
    side = np.cross(axis, out) / np.linalg.norm(axis)
    angle = np.arctan2(directions @ side, directions @ out)
    if not np.ptp(angle) < _LARGEST_SPAN:
        return None
    return corners[[angle.argmin(), angle.argmax()]]


def _beside_epipolar_lines(
    views: PosedViews,
    view: Int64[np.ndarray, "pairs"],
    pixels: Float64[np.ndarray, "pairs 2"],
    other: Int64[np.ndarray, "pairs"],
    other_pixels: Float64[np.ndarray, "pairs 2"],
) -> Lines:
    """How far the pixels' epipolar lines pass beside those of the other views; of rays that meet in front."""
    apart = views.positions[other] - views.positions[view]
    depth = nearest_along(apart, views.directions(view, pixels), views.directions(other, other_pixels))
    kept = depth > 0
    view, pixels, other, depth = view[kept], pixels[kept], other[kept], depth[kept]
    shown, in_front = views.shown(other, views.places(view, pixels, depth))
    along = views.shown(other, views.places(view, pixels, 1.01 * depth))[0] - shown
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    beside = ((shown - other_pixels[kept]) * normal).sum(axis=1)
    lines = Lines(view=view, pixels=pixels, depth=depth, other=other, normal=normal, beside_px=beside)
    return lines.chosen(in_front > 0)


def incoherences(
    views: PosedViews, silhouettes: Sequence[Silhouette], nearest: float, farthest: float
) -> Lines:
    """For each ray through an outline, the other view that shows all of it farthest off the subject.

    The place is where all views together show it least off it, between two distances from the cameras;
    none where that is on the subject in all of them.
    """
    view = np.concatenate([np.full(len(s.outline_px), i) for i, s in enumerate(silhouettes)])
    pixels = np.concatenate([s.outline_px for s in silhouettes])
    steps = np.linspace(nearest, farthest, _DEPTHS)
    depth = steps[_worst(views, silhouettes, view, pixels, np.tile(steps, (len(view), 1)))[0].argmin(axis=1)]
    width = steps[1] - steps[0]
    for _ in range(2):
        around = depth[:, None] + width * np.linspace(-1, 1, 2 * _FINER + 1)
        off, _ = _worst(views, silhouettes, view, pixels, around)
        depth = np.take_along_axis(around, off.argmin(axis=1)[:, None], axis=1)[:, 0]
        width /= _FINER
    off, other = (values[:, 0] for values in _worst(views, silhouettes, view, pixels, depth[:, None]))
    off -= _TOLERATED_PX
    missed = (off > 0) & np.isfinite(off)
    view, pixels, depth, other = view[missed], pixels[missed], depth[missed], other[missed]
    shown, _ = views.shown(other, views.places(view, pixels, depth))
    normal = np.stack([_slope(silhouettes, other, shown, axis) for axis in np.eye(2)], axis=1)
    return Lines(view=view, pixels=pixels, depth=depth, other=other, normal=normal, beside_px=off[missed])


def _worst(
    views: PosedViews,
    silhouettes: Sequence[Silhouette],
    view: Int64[np.ndarray, "rays"],
    pixels: Float64[np.ndarray, "rays 2"],
    depth: Float64[np.ndarray, "rays depths"],
) -> tuple[Float64[np.ndarray, "rays depths"], Int64[np.ndarray, "rays depths"]]:
    """At each depth how far off the subject the worst of the other views shows it, and which that is."""
    rays, depths = depth.shape
    every = np.repeat(view, depths)
    places = views.places(every, np.repeat(pixels, depths, axis=0), depth.ravel())
    worst, which = np.full(rays * depths, -np.inf), np.zeros(rays * depths, np.int64)
    for other, silhouette in enumerate(silhouettes):
        shown, in_front = views.shown(np.full(len(places), other), places)
        off = np.where(in_front > 0, _off_px(silhouette, shown), np.inf)
        off[every == other] = -np.inf
        worse = off > worst
        worst, which = np.where(worse, off, worst), np.where(worse, other, which)
    return worst.reshape(depth.shape), which.reshape(depth.shape)


def _slope(
    silhouettes: Sequence[Silhouette],
    of: Int64[np.ndarray, "places"],
    pixels: Float64[np.ndarray, "places 2"],
    axis: Float64[np.ndarray, "2"],
) -> Float64[np.ndarray, "places"]:
    """Of the distance to the outline, along an axis of the picture."""
    slope = np.zeros(len(pixels))
    for number, silhouette in enumerate(silhouettes):
        there: Bool[np.ndarray, "places"] = of == number
        ahead, behind = (
            _off_px(silhouette, pixels[there] + s * axis) for s in (_HALF_STEP_PX, -_HALF_STEP_PX)
        )
        slope[there] = (ahead - behind) / (2 * _HALF_STEP_PX)
    return slope


def _off_px(silhouette: Silhouette, pixels: Float64[np.ndarray, "places 2"]) -> Float64[np.ndarray, "places"]:
    """Signed distance to the outline, also beyond the picture, where nothing of the subject is."""
    height, width = silhouette.off_px.shape
    within = np.clip(pixels, 0.5, np.array([width, height]) - 0.5)
    beyond = np.linalg.norm(pixels - within, axis=1)
    off: Float64[np.ndarray, "places"] = bilinear(silhouette.off_px[..., None], within)[:, 0] + beyond
    return off


def _no_lines() -> Lines:
    none, numbers, pixels = np.zeros(0), np.zeros(0, np.int64), np.zeros((0, 2))
    return Lines(view=numbers, pixels=pixels, depth=none, other=numbers, normal=pixels, beside_px=none)
