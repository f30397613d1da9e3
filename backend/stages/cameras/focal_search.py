"""Other focal lengths to map with: where nothing tells one, and where the photographs contradict EXIF."""

import shutil
from collections.abc import Callable, Set
from itertools import chain
from pathlib import Path

import PIL.Image  # noqa: F401 - pycolmap loaded before Pillow corrupts memory when Pillow next saves
import pycolmap

from ...kernels.side_by_side import side_by_side
from .confirmation import FEWEST_CONFIRMING
from .features import UNKNOWN_FOCAL_FACTOR, num_threads
from .lens_doubt import contradicted_lenses
from .lenses import sparse_points
from .model_merit import fewest_confirming, is_clearly_better, merit

_OTHER_FOCAL_FACTORS = (0.4, 4.0, 12.0)
"""Where nothing tells the focal length: begun with that of a usual lens, the mapper takes a very short or
very long one for such, and turns 30 degrees off for right; but then fewer points are confirmed."""
FEW_PHOTOS = 5
"""Time grows faster than their number. Of more photographs, another focal length is tried with so many first,
and chance is not drawn again once all are confirmed: the walnut's twelve then take 90 s instead of 212 on one
core, and their worst camera is off by 1.7 degrees instead of 1.9."""


def with_another_lens(
    model: pycolmap.Reconstruction,
    database: Path,
    mapped: Callable[..., list[pycolmap.Reconstruction]],
) -> pycolmap.Reconstruction:
    """The model, or one begun with another focal length, where that places more or confirms clearly more.

    Of many photographs it has to do so with a few first. Nothing is tried where all focal lengths are known.
    They are tried side by side, each with a database of its own.
    """
    with pycolmap.Database.open(database) as opened:
        known = all(lens.has_prior_focal_length for lens in opened.read_all_cameras())
    if known:
        return model
    few = _few_that_share_most(model)
    best_of_few = max(mapped(database, few), key=merit, default=None) if few else None

    def begun_with(factor: float) -> list[pycolmap.Reconstruction]:
        own = _copied(database, f"begun_with_{factor:g}")
        _begin_with(own, factor)
        if few and not any(is_clearly_better(of_few, best_of_few) for of_few in mapped(own, few)):
            return []
        return mapped(own)

    best = model
    for other in chain.from_iterable(side_by_side(begun_with, _OTHER_FOCAL_FACTORS, num_threads())):
        if is_clearly_better(other, best):
            best = other
    return best


def without_contradicted_exif(
    model: pycolmap.Reconstruction,
    database: Path,
    mapped: Callable[..., list[pycolmap.Reconstruction]],
) -> pycolmap.Reconstruction:
    """The model, or one in which focal lengths from EXIF that it contradicts are as unknown.

    The other must not be clearly worse, and be confirmed: where there is little texture EXIF knows best.
    """
    contradicted = contradicted_lenses(model)
    if not contradicted:
        return model
    own = _copied(database, "without_exif")
    _forget_focal_lengths(own, contradicted)
    other = max(mapped(own), key=merit, default=None)
    if other is None or is_clearly_better(model, other):
        return model
    return other if fewest_confirming(other) >= FEWEST_CONFIRMING else model


def _few_that_share_most(model: pycolmap.Reconstruction) -> list[str]:
    """Names of photographs to try a focal length with: each shares the most points with those before it.

    None if there are not more than that.
    """
    ids = sorted(model.reg_image_ids())
    if len(ids) <= FEW_PHOTOS:
        return []
    _, visibility = sparse_points(model, ids)
    chosen = [int(visibility.sum(axis=0).argmax())]
    while len(chosen) < FEW_PHOTOS:
        shared = visibility[visibility[:, chosen].any(axis=1)].sum(axis=0)
        shared[chosen] = -1
        chosen.append(int(shared.argmax()))
    return [model.images[ids[index]].name for index in chosen]


def _copied(database: Path, folder: str) -> Path:
    """A copy of the database in a folder of its own beside it."""
    own = database.parent / folder / database.name
    own.parent.mkdir(exist_ok=True)
    shutil.copyfile(database, own)
    return own


def _begin_with(database: Path, factor: float) -> None:
    """Enter so many times the longer side as the focal length of lenses that have none."""
    with pycolmap.Database.open(database) as opened:
        for lens in opened.read_all_cameras():
            if lens.has_prior_focal_length:
                continue
            lens.focal_length = factor * max(lens.width, lens.height)
            opened.update_camera(lens)


def _forget_focal_lengths(database: Path, camera_ids: Set[int]) -> None:
    """Make the focal lengths of these lenses unknown, as those of photographs without EXIF."""
    with pycolmap.Database.open(database) as opened:
        for lens in opened.read_all_cameras():
            if lens.camera_id in camera_ids:
                lens.has_prior_focal_length = False
                lens.focal_length = UNKNOWN_FOCAL_FACTOR * max(lens.width, lens.height)
                opened.update_camera(lens)
