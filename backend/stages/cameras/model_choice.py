"""The best model of several attempts, each less strict than the one before."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import PIL.Image  # noqa: F401 - pycolmap loaded before Pillow corrupts memory when Pillow next saves
import pycolmap

from ...scene import Decision, Progress, within
from .confirmation import FEWEST_CONFIRMING
from .features import (
    LensGroup,
    extract_features,
    extract_thoroughly,
    match_pictures,
    match_thoroughly,
    register_pictures,
)
from .focal_search import FEW_PHOTOS, with_another_lens, without_contradicted_exif
from .mapping import Attempt, mapped_models
from .model_merit import fewest_confirming, merit

_ATTEMPTS = (
    Attempt(thorough=False, initial_angle_deg=16.0, initial_inliers=100, further_inliers=30),
    Attempt(thorough=False, initial_angle_deg=6.0, initial_inliers=40, further_inliers=20),
    Attempt(thorough=True, initial_angle_deg=16.0, initial_inliers=100, further_inliers=30),
    Attempt(thorough=True, initial_angle_deg=6.0, initial_inliers=40, further_inliers=20),
)
"""Tried in this order until all photographs are placed and confirmed."""

_DRAWS = 4
"""Of chance, for each thorough attempt. Three photographs of little texture come out right or 50 degrees
wrong by what the first pair happens to agree on, but then with a quarter of the points that three confirm."""

_EXTRACTED, _STEP = 0.4, 0.15
"""Of the progress: up to where the usual features are found, and what an attempt takes."""

_Matched = tuple[bool, int]
"""Whether thoroughly, and which draw of chance."""


@dataclass(frozen=True, kw_only=True)
class _Found:
    """A model, and what it was made of."""

    model: pycolmap.Reconstruction
    database: Path
    thorough: bool


def best_model(
    folder: Path,
    groups: Sequence[LensGroup],
    num_features: int,
    *,
    workdir: Path,
    seed: int,
    progress: Progress,
) -> tuple[pycolmap.Reconstruction | None, Path, tuple[Decision, ...]]:
    """The best model of all attempts, None where there is none at all, and the database of its features.

    With them the decision about features, where others than the usual ones were tried.
    """
    num_photos = sum(len(group.names) for group in groups)
    best: _Found | None = None
    usual: _Found | None = None
    database = workdir
    matched: _Matched | None = None
    for number, attempt in enumerate(_ATTEMPTS):
        if _is_enough(best, num_photos):
            break
        thorough, start = attempt.thorough, _EXTRACTED + number * _STEP
        if matched is None or thorough != matched[0]:
            usual = best
            database = workdir / ("thorough.db" if thorough else "features.db")
            database.unlink(missing_ok=True)
            register_pictures(database, folder, groups)
            extracting = within(progress, start if number else 0.0, start + 0.5 * _STEP)
            extract = extract_thoroughly if thorough else extract_features
            extract(database, folder, groups, num_features, progress=extracting)
        on_match = within(progress, start + 0.5 * _STEP, start + 0.75 * _STEP)
        on_photo = partial(progress, start + 0.75 * _STEP, "Placing cameras")
        for draw in range(_DRAWS if thorough else 1):
            matched = _match(database, (thorough, draw), matched, seed + draw, on_match)
            mapped = partial(mapped_models, folder, attempt, seed + draw, on_photo)
            model = max(mapped(database), key=merit, default=None)
            if model is not None and (best is None or merit(model) > merit(best.model)):
                best = _Found(model=model, database=database, thorough=thorough)
            if num_photos > FEW_PHOTOS and _is_enough(best, num_photos):
                break
        if best is not None:
            other = with_another_lens(best.model, database, mapped)
            other = without_contradicted_exif(other, database, mapped)
            if other is not best.model:
                best = _Found(model=other, database=database, thorough=thorough)
    if best is None or matched is None:
        return None, database, ()
    return best.model, best.database, (_why_thorough(usual, best, num_photos),) if matched[0] else ()


def _match(
    database: Path, wanted: _Matched, matched: _Matched | None, seed: int, progress: Progress
) -> _Matched:
    """What is matched in the database now: what was wanted, at once where it was that already."""
    thorough, _ = wanted
    if wanted == matched:
        return matched
    if thorough:
        again = matched is not None and matched[0]
        match_thoroughly(database, seed=seed, again=again, progress=progress)
    else:
        match_pictures(database, seed=seed, progress=progress)
    return wanted


def _is_enough(best: _Found | None, num_photos: int) -> bool:
    """Whether no further attempt is needed."""
    if best is None or best.model.num_reg_images() < num_photos:
        return False
    return num_photos < 3 or fewest_confirming(best.model) >= FEWEST_CONFIRMING


def _why_thorough(usual: _Found | None, best: _Found, num_photos: int) -> Decision:
    before = f"with the usual ones {_how_sure(usual, num_photos)}"
    if not best.thorough:
        because = f"{before}; fainter ones and those of pictures as seen from aside gave no more"
        return Decision(what="features", choice="the usual ones", because=because)
    return Decision(
        what="features",
        choice="fainter ones as well, and those of pictures as seen from aside",
        because=f"{before}, with these {_how_sure(best, num_photos)}",
    )


def _how_sure(found: _Found | None, num_photos: int) -> str:
    if found is None:
        return "no photographs could be placed"
    confirming = fewest_confirming(found.model)
    return (
        f"{found.model.num_reg_images()} of {num_photos} photographs were placed and the least sure of them "
        f"confirmed by {confirming} points that three see"
    )
