"""Features of pictures as they look from aside, for photographs that are far apart.

What another photograph sees from 45 degrees aside is narrower there, and its features no longer look the
same. So each picture is also shown narrowed along several directions, and what is found there is found in the
picture: a simulated tilt (Morel and Yu, "ASIFT", 2009).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import PIL.Image
import pycolmap
from jaxtyping import Float32, Float64, UInt8
from scipy.spatial import cKDTree

from ...maths.descriptors import Descriptors, matched_descriptors
from ...scene import Progress

_TILT = 2.0
"""By which pictures are narrowed: what turns away by 60 degrees."""
DIRECTIONS = 5
"""Of narrowing, over half a turn."""
_SAME_PX = 1.0
"""Features nearer than this to one that was found before are at its place."""
_BORDER_SCALES = 6.0
"""Features nearer than so many of their scales to the border may be of the border."""


_Features = tuple[Float32[np.ndarray, "features numbers"], Descriptors]
"""Keypoints, of which the first two numbers are the place in pixels, and descriptors."""


@dataclass(frozen=True, kw_only=True)
class _Tilted:
    """A picture as seen from aside; pixel (0, 0) has its middle at (0.5, 0.5)."""

    name: str
    picture_size_px: tuple[int, int]
    picture_from_tilted: Float64[np.ndarray, "2 3"]


def add_tilted_features(
    database: Path,
    folder: Path,
    names: Sequence[str],
    options: pycolmap.FeatureExtractionOptions,
    progress: Progress,
) -> None:
    """To the features of these pictures in the database, add those of the pictures as seen from aside.

    Features at one place of a picture have the same position afterwards, to the bit.
    """
    aside = database.parent / f"{database.stem}_aside"
    aside.mkdir(exist_ok=True)
    database_aside = aside / "features.db"
    database_aside.unlink(missing_ok=True)
    pycolmap.Database.open(database_aside).close()
    tilted: dict[str, list[_Tilted]] = {}
    for number, name in enumerate(names):
        progress(number / len(names), "Finding features from aside")
        tilted[name] = _write_tilted(folder, name, aside)
        files = [one.name for one in tilted[name]]
        pycolmap.import_images(
            database_aside, aside, camera_mode=pycolmap.CameraMode.PER_IMAGE, image_names=files
        )
        pycolmap.extract_features(
            database_aside,
            aside,
            image_names=files,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
    _merge(database, database_aside, tilted)


def match_tilted_features(database: Path, largest_ratio: float, progress: Progress) -> None:
    """Matches between all pictures, of features of which several may be at one place."""
    with pycolmap.Database.open(database) as opened:
        ids = sorted(image.image_id for image in opened.read_all_images())
        features = {i: _read_features(opened, i) for i in ids}
        pairs = list(combinations(ids, 2))
        for number, (one, other) in enumerate(pairs):
            progress(number / len(pairs), "Matching photographs")
            (places, descriptors), (other_places, other_descriptors) = features[one], features[other]
            matches = matched_descriptors(
                places[:, :2], descriptors, other_places[:, :2], other_descriptors, largest_ratio
            )
            opened.write_matches(one, other, matches.astype(np.uint32))


def narrowed(
    picture: PIL.Image.Image, direction_rad: float
) -> tuple[PIL.Image.Image, Float64[np.ndarray, "2 3"]]:
    """The grey picture narrowed along a direction, which is that of its rows then.

    With it the picture's place of each of its own; pixel (0, 0) has its middle at (0.5, 0.5).
    """
    cos, sin = np.cos(direction_rad), np.sin(direction_rad)
    picture_from_turned = np.array([[cos, -sin], [sin, cos]])
    corners = np.array([[0, 0], [picture.width, 0], [0, picture.height], picture.size], np.float64)
    turned_corners = corners @ picture_from_turned
    low, high = turned_corners.min(axis=0), turned_corners.max(axis=0)
    width, height = np.ceil(high - low).astype(int).tolist()
    origin = (picture_from_turned @ low)[:, None]
    turned = picture.transform(
        (width, height),
        PIL.Image.Transform.AFFINE,
        np.hstack([picture_from_turned, origin]).ravel().tolist(),
        resample=PIL.Image.Resampling.BICUBIC,
    )
    narrow = round(width / _TILT)
    turned_from_narrowed = np.diag([width / narrow, 1.0])
    picture_from_narrowed = np.hstack([picture_from_turned @ turned_from_narrowed, origin])
    # Pillow's filter is as wide as what it narrows by, so nothing finer is left than pixels can hold
    return turned.resize((narrow, height), PIL.Image.Resampling.BICUBIC), picture_from_narrowed


def _write_tilted(folder: Path, name: str, aside: Path) -> list[_Tilted]:
    with PIL.Image.open(folder / name) as opened:
        picture = opened.convert("L")
    written = []
    for number in range(DIRECTIONS):
        seen, picture_from_tilted = narrowed(picture, np.pi * number / DIRECTIONS)
        file = f"{Path(name).stem}_{number}.png"
        seen.save(aside / file, compress_level=1)
        written.append(
            _Tilted(name=file, picture_size_px=picture.size, picture_from_tilted=picture_from_tilted)
        )
    return written


def _merge(database: Path, database_aside: Path, tilted: Mapping[str, Sequence[_Tilted]]) -> None:
    """Add what was found in tilted pictures to what was found in those of these names."""
    usual, found = _read_all(database), _read_all(database_aside)
    with pycolmap.Database.open(database) as opened:
        ids = _image_ids(opened)
        opened.clear_keypoints()
        opened.clear_descriptors()
        for name, from_aside in tilted.items():
            keypoints, described = usual[name]
            places, descriptors = [keypoints[:, :2]], [described]
            for one in from_aside:
                inside = _inside(*found[one.name], one)
                places.append(inside[0])
                descriptors.append(inside[1])
            opened.write_keypoints(ids[name], _at_first_of_place(np.concatenate(places)))
            written = pycolmap.FeatureDescriptors()
            written.type = pycolmap.FeatureExtractorType.SIFT
            written.data = np.concatenate(descriptors)
            opened.write_descriptors(ids[name], written)


def _read_all(database: Path) -> dict[str, _Features]:
    """Features of each picture, by its name."""
    with pycolmap.Database.open(database) as opened:
        return {name: _read_features(opened, image_id) for name, image_id in _image_ids(opened).items()}


def _image_ids(opened: pycolmap.Database) -> dict[str, int]:
    return {image.name: image.image_id for image in opened.read_all_images()}


def _read_features(opened: pycolmap.Database, image_id: int) -> _Features:
    keypoints: Float32[np.ndarray, "features numbers"] = np.asarray(opened.read_keypoints(image_id))
    return keypoints, opened.read_descriptors(image_id).data


def _inside(
    keypoints: Float32[np.ndarray, "features 6"],
    descriptors: Descriptors,
    tilted: _Tilted,
) -> tuple[Float32[np.ndarray, "inside 2"], UInt8[np.ndarray, "inside bytes"]]:
    """Places in the picture of those that do not see its border, and their descriptors."""
    picture_from_tilted = tilted.picture_from_tilted
    places = keypoints[:, :2] @ picture_from_tilted[:, :2].T + picture_from_tilted[:, 2]
    shape = keypoints[:, 2:].reshape(-1, 2, 2)
    margin = _BORDER_SCALES * np.sqrt(np.abs(np.linalg.det(shape)))[:, None]
    inside = ((places > margin) & (places < np.array(tilted.picture_size_px) - margin)).all(axis=1)
    return places[inside].astype(np.float32), descriptors[inside]


def _at_first_of_place(places_px: Float32[np.ndarray, "features 2"]) -> Float32[np.ndarray, "features 2"]:
    """Each where the first of those is that are at one place."""
    near = cKDTree(places_px).query_pairs(_SAME_PX, output_type="ndarray")
    first = np.arange(len(places_px))
    np.minimum.at(first, near.max(axis=1), near.min(axis=1))
    while (first[first] != first).any():
        first = first[first]
    return places_px[first]
