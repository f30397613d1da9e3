"""Cameras of a file's own pixels, turned with their photograph: every lens, every orientation."""

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import ExifTags, Image

from backend.errors import ErrorCode, ReconstructionError
from backend.maths.sampling import colours_at
from backend.scene import Photo, Region, no_progress
from backend.stages.cameras.known_cameras import may_be_unturned, read_placement
from backend.stages.cameras.lenses import Placement, undistorted_view
from backend.stages.cameras.nerfstudio import transforms_json
from backend.stages.cameras.solving import CamerasConfig, solve_cameras
from backend.stages.cameras.stored_pixels import turned_clockwise
from backend.stages.cameras.which_way_up import read_placement_that_fits
from backend.stages.photos import PhotosConfig, load_photos
from tests.lens_models import LENSES
from tests.synthetic_scene import Scene, arc_cameras, photographed, write_scene

WIDTH, HEIGHT = 160, 120
RED_DOT_WORLD = np.array([[-0.3, -0.7, 3.0]])


def photographs(folder: Path, orientation: int, width: int = WIDTH) -> tuple[Photo, ...]:
    """Two files whose stored pixels show a red dot, around column 65 and row 25."""
    pixels = np.zeros((HEIGHT, width, 3), np.uint8)
    pixels[20:30, 60:70] = (255, 0, 0)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    for name in ("a.png", "b.png"):
        Image.fromarray(pixels).save(folder / name, exif=exif)
        pixels[0, 0] = 255  # no copy of the first
    return load_photos([folder / "a.png", folder / "b.png"], None, PhotosConfig(), progress=no_progress)


def model(folder: Path, width: int = WIDTH) -> Path:
    """A COLMAP model that sees the dot in the stored pixels."""
    (folder / "cameras.txt").write_text(f"1 PINHOLE {width} {HEIGHT} 150 150 80 60\n")
    (folder / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 0 0 0 1 b.png\n\n")
    (folder / "points3D.txt").write_text("")
    return folder


def transforms(folder: Path, width: int = WIDTH, height: int = HEIGHT) -> Path:
    """The same cameras as a transforms.json."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0]).tolist()
    frames = [{"file_path": name, "transform_matrix": pose} for name in ("a.png", "b.png")]
    lens = {"w": width, "h": height, "fl_x": 150, "fl_y": 150, "cx": 80, "cy": 60}
    path = folder / "transforms.json"
    path.write_text(json.dumps({**lens, "frames": frames}))
    return path


def redness_of_the_dot(photos: tuple[Photo, ...], placement: Placement) -> float:
    view = undistorted_view(photos[0], placement.placed[0])
    return float(colours_at(view, RED_DOT_WORLD)[0, 0])


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
@pytest.mark.parametrize("width", [WIDTH, HEIGHT])
def test_cameras_of_a_colmap_model_are_turned_with_their_photographs(
    orientation: int, width: int, tmp_path: Path
) -> None:
    """Also where a square picture does not tell whether it lies on its side."""
    photos = photographs(tmp_path, orientation, width)
    placement = read_placement(photos, model(tmp_path, width))
    assert redness_of_the_dot(photos, placement) == 1
    told = [f"{decision.choice} {decision.because}" for decision in placement.decisions]
    assert len(told) == (orientation != 1)
    assert all("a.png, b.png" in text for text in told)


@pytest.mark.parametrize("orientation", [6, 8])
def test_cameras_of_a_transforms_json_are_turned_where_their_shape_says_so(
    orientation: int, tmp_path: Path
) -> None:
    photos = photographs(tmp_path, orientation)
    placement = read_placement(photos, transforms(tmp_path))
    assert redness_of_the_dot(photos, placement) == 1
    assert len(placement.decisions) == 1


@pytest.mark.parametrize(("orientation", "shape"), [(3, (WIDTH, HEIGHT)), (6, (HEIGHT, WIDTH))])
def test_else_they_are_those_of_upright_photographs(
    orientation: int, shape: tuple[int, int], tmp_path: Path
) -> None:
    photos = photographs(tmp_path, orientation)
    given = transforms(tmp_path, *shape)
    placement = read_placement(photos, given)
    np.testing.assert_array_equal(placement.placed[0].camera_from_world, np.eye(4))
    assert (placement.placed[0].lens.width, placement.placed[0].lens.height) == shape
    assert placement.decisions == ()
    assert may_be_unturned(given)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return photographed(arc_cameras(4, 60, 320), wall=True).without_masks()


@pytest.mark.parametrize("upside_down", [(0, 1, 2, 3), (1,)])
@pytest.mark.parametrize("stored", [True, False])
def test_of_photographs_upside_down_the_cameras_that_fit_are_taken(
    upside_down: tuple[int, ...], stored: bool, scene: Scene, tmp_path: Path
) -> None:
    """An arc seen upside down is nearly that of a hollow: pairs alone hardly tell."""
    write_scene(scene, tmp_path)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 3
    for index in upside_down:
        path = tmp_path / "images" / scene.views[index].name
        pixels = np.asarray(Image.open(path).convert("RGB"))
        Image.fromarray(pixels if stored else pixels[::-1, ::-1]).save(path, exif=exif)
    photos = load_photos([tmp_path / "images"], None, PhotosConfig(), progress=no_progress)
    given = tmp_path / "images" / "transforms.json"
    solved = solve_cameras(photos, given, CamerasConfig(), workdir=tmp_path, seed=0, progress=no_progress)
    assert solved.way_up_told
    assert solved.decisions[-1].choice == (
        "of pixels as they are stored" if stored else "of upright photographs"
    )
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    for index, (view, true) in enumerate(zip(solved.views, scene.views, strict=True)):
        pose = true.camera.camera_from_world
        expected = half_turn @ pose if stored and index in upside_down else pose
        np.testing.assert_allclose(view.camera.camera_from_world, expected, atol=1e-9)


def test_nothing_is_decided_where_photographs_share_too_little(tmp_path: Path) -> None:
    photos = photographs(tmp_path, 3)
    nothing = np.zeros((0, 2), bool)
    placement = read_placement_that_fits(photos, transforms(tmp_path), lambda _: nothing)
    np.testing.assert_array_equal(placement.placed[0].camera_from_world, np.eye(4))
    assert placement.decisions == ()


def test_our_own_file_and_a_model_say_how_they_are_turned(tmp_path: Path) -> None:
    path = transforms(tmp_path)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"fewview": {"estimated": False}}))
    assert not may_be_unturned(path)
    path.unlink()
    assert not may_be_unturned(model(tmp_path))


def test_cameras_of_copies_that_were_saved_upright_stay(tmp_path: Path) -> None:
    photos = photographs(tmp_path, 6)
    (tmp_path / "copies").mkdir()
    folder = model(tmp_path / "copies")
    (folder / "cameras.txt").write_text(f"1 PINHOLE {HEIGHT} {WIDTH} 150 150 60 80\n")
    placement = read_placement(photos, folder)
    np.testing.assert_array_equal(placement.placed[0].camera_from_world, np.eye(4))


@pytest.mark.parametrize("orientation", [2, 4, 5, 7])
def test_mirrored_files_are_refused(orientation: int, tmp_path: Path) -> None:
    """No camera in a right-handed world sees what COLMAP saw."""
    photos = photographs(tmp_path, orientation)
    with pytest.raises(ReconstructionError, match=r"a\.png is stored mirrored") as caught:
        read_placement(photos, model(tmp_path))
    assert caught.value.code == ErrorCode.CAMERAS_UNUSABLE


@pytest.mark.parametrize("name", LENSES)
def test_a_turned_lens_sees_what_the_lens_sees_turned(name: str) -> None:
    lens = pycolmap.Camera(model=name, width=WIDTH, height=HEIGHT, params=LENSES[name])
    turned = turned_clockwise(lens)
    assert (turned.width, turned.height) == (HEIGHT, WIDTH)
    x, y, z = np.random.default_rng(0).uniform([[-0.4], [-0.3], [1.0]], [[0.4], [0.3], [1.2]], (3, 50))
    column, row = lens.img_from_cam(np.column_stack([x, y, z])).T
    seen = turned.img_from_cam(np.column_stack([-y, x, z]))
    np.testing.assert_allclose(seen, np.column_stack([HEIGHT - row, column]), atol=1e-9)


@pytest.mark.parametrize("orientation", [3, 6])
def test_what_is_written_of_turned_cameras_is_not_turned_again(orientation: int, tmp_path: Path) -> None:
    photos = photographs(tmp_path, orientation)
    solved = solve_cameras(
        photos, model(tmp_path), CamerasConfig(), workdir=tmp_path, seed=0, progress=no_progress
    )
    region = Region(object_from_world=np.eye(4))
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps(transforms_json(solved, region)))
    assert redness_of_the_dot(photos, read_placement(photos, path)) == 1
