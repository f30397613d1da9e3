"""The best model of several attempts, each less strict than the one before."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import PIL.Image  # noqa: F401 - pycolmap loaded before Pillow corrupts memory when Pillow next saves
import pycolmap

from ..scene import Decision, Progress
from .confirmation import FEWEST_CONFIRMING
from .features import LensGroup, extract_features, match_pictures, register_pictures
from .focal_search import FEW_PHOTOS, with_another_lens, without_contradicted_exif
from .mapping import Attempt, mapped_models
from .model_merit import fewest_confirming, merit

_ATTEMPTS = (
    Attempt(sensitive=False, guided=False, initial_angle_deg=16.0, initial_inliers=100, further_inliers=30),
    Attempt(sensitive=False, guided=False, initial_angle_deg=6.0, initial_inliers=40, further_inliers=20),
    Attempt(sensitive=True, guided=False, initial_angle_deg=16.0, initial_inliers=100, further_inliers=30),
    Attempt(sensitive=True, guided=False, initial_angle_deg=6.0, initial_inliers=40, further_inliers=20),
    Attempt(sensitive=True, guided=True, initial_angle_deg=16.0, initial_inliers=100, further_inliers=30),
    Attempt(sensitive=True, guided=True, initial_angle_deg=6.0, initial_inliers=40, further_inliers=15),
)
"""Tried in this order until all photographs are placed and confirmed, the guided ones until enough are."""

_DRAWS = 4
"""Of chance, for each sensitive attempt. The walnut's three photographs come out right or 55 degrees wrong by
what the first pair happens to agree on, but then with a quarter of the points that three confirm."""

_ENOUGH_SHARE = 0.75
"""Of the photographs. Guided matching takes longer than all the rest, too long for a last photograph."""


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

    With them the decision about features, where fainter ones were tried.
    """
    num_photos = sum(len(group.names) for group in groups)
    best: pycolmap.Reconstruction | None = None
    best_of_usual: pycolmap.Reconstruction | None = None
    best_database = database = workdir / "features.db"
    extracted: bool | None = None
    matched: tuple[bool, bool, int] | None = None
    for number, attempt in enumerate(_ATTEMPTS):
        if _is_enough(best, attempt, num_photos):
            break
        share = 0.5 + 0.08 * number
        if attempt.sensitive != extracted:
            database = workdir / ("sensitive.db" if attempt.sensitive else "features.db")
            on_feature = partial(_within, progress, share, share + 0.08) if attempt.sensitive else progress
            database.unlink(missing_ok=True)
            register_pictures(database, folder, groups)
            extract_features(
                database, folder, groups, num_features, sensitive=attempt.sensitive, progress=on_feature
            )
            extracted = attempt.sensitive
        on_photo = partial(progress, share + 0.06, "Placing cameras")
        for draw in range(_DRAWS if attempt.sensitive and not attempt.guided else 1):
            wanted = attempt.sensitive, attempt.guided, draw
            if wanted != matched:
                progress(share + 0.04, "Matching photographs")
                match_pictures(
                    database,
                    sensitive=attempt.sensitive,
                    guided=attempt.guided,
                    again=matched is not None and matched[:2] == wanted[:2],
                    seed=seed + draw,
                )
                matched = wanted
            mapped = partial(mapped_models, folder, attempt, seed + draw, on_photo)
            model = max(mapped(database), key=merit, default=None)
            if model is not None and (best is None or merit(model) > merit(best)):
                best, best_database = model, database
            if num_photos > FEW_PHOTOS and _is_enough(best, attempt, num_photos):
                break
        if not attempt.sensitive:
            best = with_another_lens(best, database, mapped)
            best = without_contradicted_exif(best, database, mapped)
            best_of_usual = best
    if best is None or not extracted:
        return best, database, ()
    return best, best_database, (_why_fainter(best_of_usual, best, num_photos),)


def _is_enough(model: pycolmap.Reconstruction | None, attempt: Attempt, num_photos: int) -> bool:
    """Whether the attempt is not needed any more."""
    if model is None:
        return False
    num_placed = model.num_reg_images()
    if attempt.guided and num_placed >= _ENOUGH_SHARE * num_photos:
        return True
    confirmed = num_photos < 3 or fewest_confirming(model) >= FEWEST_CONFIRMING
    return num_placed == num_photos and confirmed


def _why_fainter(
    usual: pycolmap.Reconstruction | None, best: pycolmap.Reconstruction, num_photos: int
) -> Decision:
    before = f"with the usual ones {_how_sure(usual, num_photos)}"
    if best is usual:
        return Decision(
            what="features", choice="the usual ones", because=f"{before}; fainter ones gave no more"
        )
    after = f"with fainter ones {_how_sure(best, num_photos)}"
    return Decision(what="features", choice="fainter ones", because=f"{before}, {after}")


def _how_sure(model: pycolmap.Reconstruction | None, num_photos: int) -> str:
    if model is None:
        return "no photographs could be placed"
    confirming = fewest_confirming(model)
    return (
        f"{model.num_reg_images()} of {num_photos} photographs were placed and the least sure of them "
        f"confirmed by {confirming} points that three see"
    )


def _within(progress: Progress, start: float, end: float, share: float, text: str) -> None:
    progress(start + (end - start) * share, text)
