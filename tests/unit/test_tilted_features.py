"""Pictures as seen from aside: where they show what, and what is found in them."""

from pathlib import Path

import numpy as np
import PIL.Image
import pycolmap
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from backend.scene import no_progress
from backend.stages.cameras import features
from backend.stages.cameras.features import LensGroup
from backend.stages.cameras.tilted_features import narrowed
from tests.ridge_photos import HEIGHT, WIDTH, arc_pose, render

NAMES = ("0000.png", "0001.png")


@pytest.mark.parametrize("direction_deg", [0.0, 36.0, 72.0, 108.0, 144.0])
@pytest.mark.parametrize("place", [(40.5, 30.5), (150.2, 90.7)])
def test_a_place_is_found_where_the_narrowed_picture_shows_it(
    direction_deg: float, place: tuple[float, float]
) -> None:
    columns, rows = np.meshgrid(np.arange(200) + 0.5, np.arange(121) + 0.5)
    dot = np.exp(-((columns - place[0]) ** 2 + (rows - place[1]) ** 2) / (2 * 5.0**2))
    picture = PIL.Image.fromarray(np.rint(255 * dot).astype(np.uint8))
    seen, picture_from_narrowed = narrowed(picture, np.radians(direction_deg))
    shown = np.asarray(seen, np.float64)
    columns, rows = np.meshgrid(np.arange(seen.width) + 0.5, np.arange(seen.height) + 0.5)
    middle = np.array([(columns * shown).sum(), (rows * shown).sum(), shown.sum()]) / shown.sum()
    np.testing.assert_allclose(picture_from_narrowed @ middle, place, atol=0.05)
    widths = [
        np.sqrt(((axis - at) ** 2 * shown).sum() / shown.sum())
        for axis, at in zip((columns, rows), middle[:2], strict=True)
    ]
    assert widths == pytest.approx([2.5, 5.0], rel=0.05), "narrow along its rows alone"


def test_what_is_too_fine_for_a_narrowed_picture_is_evened_out() -> None:
    """Stripes of a pixel would be stripes of half of one."""
    stripes = np.tile(np.array([0, 255], np.uint8), (64, 32))
    seen, _ = narrowed(PIL.Image.fromarray(stripes), 0.0)
    along, _ = narrowed(PIL.Image.fromarray(stripes), np.pi / 2)
    assert np.asarray(seen)[:, 4:-4].std() < 5
    assert np.asarray(along)[4:-4].std() > 100


@pytest.fixture(scope="module")
def extracted(tmp_path_factory: pytest.TempPathFactory) -> dict[bool, Path]:
    """Databases of two photographs of the ridge, by whether features were sought thoroughly."""
    folder = tmp_path_factory.mktemp("pictures")
    for name, angle_deg in zip(NAMES, (-25.0, 25.0), strict=True):
        grey = features.brightness(render(arc_pose(angle_deg), 0.3))
        PIL.Image.fromarray(grey).save(folder / name)
    group = LensGroup(names=NAMES, width=WIDTH, height=HEIGHT, focal_px=None)
    found = {}
    for thorough in (False, True):
        database = found[thorough] = folder / f"{thorough}.db"
        features.register_pictures(database, folder, [group])
        if thorough:
            features.extract_thoroughly(database, folder, [group], 3000, progress=no_progress)
            features.match_thoroughly(database, seed=0, again=False, progress=no_progress)
        else:
            features.extract_features(database, folder, [group], 3000, progress=no_progress)
            features.match_pictures(database, seed=0, progress=no_progress)
    return found


def places_of(database: Path) -> list[NDArray[np.float32]]:
    with pycolmap.Database.open(database) as opened:
        ids = sorted(image.image_id for image in opened.read_all_images())
        return [np.asarray(opened.read_keypoints(i))[:, :2] for i in ids]


def test_the_usual_features_stay_and_others_join_them(extracted: dict[bool, Path]) -> None:
    usual, tilted = (places_of(extracted[thorough]) for thorough in (False, True))
    for few, many in zip(usual, tilted, strict=True):
        assert len(many) > 2 * len(few)
        away, _ = cKDTree(many).query(few)
        assert np.mean(away == 0) > 0.8
        assert np.mean(away < 2.0) > 0.99, "features within a pixel of each other are at one place"
        assert (many > 0).all()
        assert (many < (WIDTH, HEIGHT)).all()
        assert len(np.unique(many, axis=0)) < 0.9 * len(many), "places that are found again"


def test_more_features_of_photographs_far_apart_match(extracted: dict[bool, Path]) -> None:
    verified = []
    for database in extracted.values():
        with pycolmap.Database.open(database) as opened:
            one, other = (image.image_id for image in opened.read_all_images())
            pairs = np.asarray(opened.read_two_view_geometry(one, other).inlier_matches)
        verified.append(len(pairs))
        assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs)
    assert verified[1] > 2 * verified[0]
