"""Cut-outs of one subject held against each other: what nearly all of them show is the subject.

A network takes a box behind the subject for a part of it in one photograph, and forgets an arm in another.
But a point of the subject lies inside its outline in every photograph that shows it. So triangulated points
vote: what lies on nearly all cut-outs is the subject, and a cut-out that lacks some of it is not used. And
space is carved: what most photographs that show it have not in their cut-outs is taken off the others; and a
cut-out that lacks a part which the others have, so that together they would leave it empty, is not used.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64

from ...maths.beside_mask import FEWEST_MASKS, from_mask_px, on_and_beside_mask
from ...maths.projection import projected, shown
from ...scene import Mask, View
from ..region import around_masks, shows_subject, without_ghosts

_CELLS = 64
"""Along each axis."""
_ROUNDS = 3
"""In which the cells close in on the subject."""
_HALF_DIAGONAL = math.sqrt(3) / 2
"""Of a cell: only what is farther from the subject's outline is off it as a whole."""
_SQUARE = 1.5
"""Width of the squares that cells cover in a photograph, in cells: no gaps are left between them."""
_MOST_OFF = 1 / 3
"""Of the photographs that show a part of the subject, those that may lack it."""
_MOST_LACKING = 0.03
"""Of the points on most cut-outs, those off one that is used. Measured: 0 to 0.013 where it is right; of a
doll three of nine 0.08 to 0.10, with a sleeve or an arm missing; of another thing cut out 0.13 to 0.54."""
_LEAST_FILLED = 0.97
"""Of a cut-out, by what all that are used have in common. Measured: 0.984 to 1 where all are right; of nine
photographs of a doll, arms and sleeves missing in some, 0.948 to 0.996."""
_LEAST_USED = 0.5
"""Of the photographs: where fewer agree, none is to be believed."""


def agreed(
    masks: Sequence[Mask | None], views: Sequence[View], points: Float64[np.ndarray, "points 3"]
) -> list[Mask | None]:
    """As much of each mask as agrees with the others; None for one that contradicts them.

    `points` were triangulated, world frame. None at all where too few agree, or have anything in common. A
    view's own mask stands, as the user's word.
    """
    known = [mask if view.mask is None else view.mask for mask, view in zip(masks, views, strict=True)]
    shown_in = [index for index, mask in enumerate(known) if mask is not None and shows_subject(mask)]
    lacking = _lacking([replace(views[index], mask=known[index]) for index in shown_in], points)
    given = {index for index, view in enumerate(views) if view.mask is not None}
    which = [
        index
        for index, lacks in zip(shown_in, lacking, strict=True)
        if lacks < _MOST_LACKING or index in given
    ]
    masked = [replace(views[index], mask=known[index]) for index in which]
    nothing: list[Mask | None] = [None] * len(views)
    cells = _around_most(masked) if len(masked) >= FEWEST_MASKS else None
    if cells is None:
        return nothing
    seen = [_seen(view, cells) for view in masked]
    most = _in_most(seen)
    trimmed = [
        view if index in given else _only_where(sees.covered_by(most), view)
        for index, view, sees in zip(which, masked, seen, strict=True)
    ]
    held = [index in given for index in which]
    kept = _without_contradictions([_seen(view, cells) for view in trimmed], held)
    if len(kept) < max(FEWEST_MASKS, _LEAST_USED * len(views)):
        return nothing
    used = {which[number]: trimmed[number].mask for number in kept if not held[number]}
    return [used.get(index) for index in range(len(views))]


def _lacking(views: Sequence[View], points: Float64[np.ndarray, "points 3"]) -> list[float]:
    """Of each photograph, the share of the points on most masks that it shows off its own."""
    if not views or not len(points):
        return [0.0] * len(views)
    said = [on_and_beside_mask(v.camera, from_mask_px(v.mask), points) for v in views if v.mask is not None]
    on, beside = np.stack(said, axis=1)
    few_off = beside.sum(axis=0) <= _MOST_OFF * (on | beside).sum(axis=0)
    subject = few_off & (on.sum(axis=0) >= FEWEST_MASKS)
    return [float(lacks.mean()) for lacks in beside[:, subject]] if subject.any() else [0.0] * len(views)


@dataclass(frozen=True, kw_only=True)
class _Cells:
    """A cube of them."""

    middles: Float64[np.ndarray, "cells 3"]
    width: float


@dataclass(frozen=True, kw_only=True)
class _Seen:
    """What a photograph says of cells."""

    on: Bool[np.ndarray, "cells"]
    """Those that it shows, and not off the subject as a whole."""
    off: Bool[np.ndarray, "cells"]
    square: Int64[np.ndarray, "cells"]
    """The square of the photograph that each covers; the last one is none."""
    square_of_pixel: Int64[np.ndarray, "height width"]
    subject: Float64[np.ndarray, "squares"]
    """The share of the mask that lies in each."""

    def covered_by(self, cells: Bool[np.ndarray, "cells"]) -> Bool[np.ndarray, "height width"]:
        """The pixels of the squares that these cells cover."""
        covered: Bool[np.ndarray, "height width"] = self._squares(cells)[self.square_of_pixel]
        return covered

    def filled_by(self, cells: Bool[np.ndarray, "cells"]) -> float:
        """Share of the mask that these cells cover."""
        return float(self.subject[self._squares(cells)].sum())

    def _squares(self, cells: Bool[np.ndarray, "cells"]) -> Bool[np.ndarray, "squares"]:
        squares = np.zeros(len(self.subject), np.bool_)
        squares[self.square[cells]] = True
        squares[-1] = False
        return squares


def _only_where(kept: Bool[np.ndarray, "height width"], view: View) -> View:
    assert view.mask is not None
    return replace(view, mask=np.where(kept, view.mask, np.float32(0)))


def _cube(centre: Float64[np.ndarray, "3"], radius: float) -> _Cells:
    steps = np.linspace(-1, 1, _CELLS)
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return _Cells(middles=grid * radius + centre, width=2 * radius / (_CELLS - 1))


def _around_most(views: Sequence[View]) -> _Cells | None:
    """Cells around what most masks have in common; None where there is nothing."""
    centre, radius = around_masks(views)
    for _ in range(_ROUNDS):
        cells = _cube(centre, radius)
        common = cells.middles[_in_most([_seen(view, cells) for view in views])]
        if not len(common):
            return None
        centre = (common.min(axis=0) + common.max(axis=0)) / 2
        radius = float(np.abs(common - centre).max()) + cells.width
    return _cube(centre, radius)


def _seen(view: View, cells: _Cells) -> _Seen:
    assert view.mask is not None
    pixels, depth = projected(cells.middles, view.camera)
    visible = shown(pixels, depth, view.camera)
    column, row = pixels[visible].astype(int).T
    subject = view.mask > 0.5
    near = (
        from_mask_px(view.mask)[row, column]
        <= _HALF_DIAGONAL * cells.width * view.camera.fx_px / depth[visible]
    )
    on, off = np.zeros((2, len(depth)), np.bool_)
    on[visible], off[visible] = near, ~near
    middle_depth = float(np.median(depth[visible])) if visible.any() else 1.0
    square_px = max(1.0, _SQUARE * cells.width * view.camera.fx_px / middle_depth)
    height, width = subject.shape
    across, down = math.ceil(width / square_px), math.ceil(height / square_px)
    rows, columns = (np.arange(length) / square_px for length in (height, width))
    square_of_pixel = rows.astype(np.int64)[:, None] * across + columns.astype(np.int64)
    square = np.full(len(depth), across * down)
    square[visible] = square_of_pixel[row, column]
    counts = np.bincount(square_of_pixel[subject], minlength=across * down + 1)
    return _Seen(
        on=on,
        off=off,
        square=square,
        square_of_pixel=square_of_pixel,
        subject=counts / max(int(counts.sum()), 1),
    )


def _in_most(seen: Sequence[_Seen]) -> Bool[np.ndarray, "cells"]:
    """Cells that are off the subject in few of the photographs that show them."""
    on = np.sum([sees.on for sees in seen], axis=0)
    off = np.sum([sees.off for sees in seen], axis=0)
    side = (_CELLS,) * 3
    counts = np.where(off <= _MOST_OFF * (on + off), on, 0)
    return without_ghosts(counts.reshape(side)).ravel()


def _without_contradictions(seen: Sequence[_Seen], given: Sequence[bool]) -> list[int]:
    """Those whose masks what they have in common fills: without the worst, one after the other.

    The worst is the one without which the others are filled best; one that was given never is.
    """
    on, off = np.stack([sees.on for sees in seen]), np.stack([sees.off for sees in seen])
    kept = list(range(len(seen)))

    def filled(used: list[int]) -> list[float]:
        common = ~off[used].any(axis=0) & (on[used].sum(axis=0) >= FEWEST_MASKS)
        return [seen[number].filled_by(common) for number in used]

    while len(kept) > FEWEST_MASKS and min(filled(kept)) < _LEAST_FILLED:
        others = {number: [k for k in kept if k != number] for number in kept if not given[number]}
        if not others:
            break
        kept = max(others.values(), key=lambda used: float(np.mean(filled(used))))
    return kept if min(filled(kept)) >= _LEAST_FILLED else []
