"""Why photographs are left behind, told from a database that says it."""

from pathlib import Path

import numpy as np
import PIL.Image  # noqa: F401 - before pycolmap
import pycolmap
import pytest

from backend.stages.cameras.parallax import FEWEST_SHARED, why_unplaced

NUM_FEATURES = {"0.png": 400, "1.png": 300, "even.png": 3, "alone.png": 200, "few.png": 200, "many.png": 200}
SHARED = {
    ("0.png", "1.png"): 150,
    ("1.png", "few.png"): 9,
    ("0.png", "few.png"): 4,
    ("many.png", "0.png"): 40,
}


@pytest.fixture
def database(tmp_path: Path) -> Path:
    """With features in each picture, some of which pairs share."""
    path = tmp_path / "features.db"
    with pycolmap.Database.open(path) as opened:
        lens = pycolmap.Camera(model="PINHOLE", width=99, height=99, params=[90.0, 90.0, 50.0, 50.0])
        camera_id = opened.write_camera(lens)
        ids = {}
        for name, count in NUM_FEATURES.items():
            ids[name] = opened.write_image(pycolmap.Image(name=name, camera_id=camera_id))
            opened.write_keypoints(ids[name], np.zeros((count, 2), np.float32))
        for (one, other), count in SHARED.items():
            geometry = pycolmap.TwoViewGeometry()
            geometry.inlier_matches = np.stack([np.arange(count)] * 2, axis=1).astype(np.uint32)
            opened.write_two_view_geometry(ids[one], ids[other], geometry)
    return path


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("even.png", "hardly any feature"),
        ("alone.png", "shares no features with the others"),
        ("few.png", f"too few features with the others: 9 at best, {FEWEST_SHARED} are needed"),
        ("many.png", "shares features with the others, 40 at best, but"),
    ],
)
def test_a_photograph_is_told_why_it_was_left_behind(name: str, words: str, database: Path) -> None:
    (why,) = why_unplaced(database, [name])
    assert words in why
    assert not why.endswith(".")


def test_reasons_come_in_the_order_of_the_pictures(database: Path) -> None:
    names = ["few.png", "even.png", "alone.png"]
    assert why_unplaced(database, names) == [why_unplaced(database, [name])[0] for name in names]
    assert why_unplaced(database, []) == []
