"""Loading photographs: order, names, sizes, masks and refusals."""

import unicodedata
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image

from backend.errors import Cancelled, ErrorCode, ReconstructionError
from backend.scene import Photo, no_progress
from backend.stages.photos import (
    PhotosConfig,
    is_outline,
    load_photos,
    match_masks,
    natural_order,
    turned_text,
    unused_masks_text,
    white_masks_text,
)

CONFIG = PhotosConfig(max_side_px=100)
MASK_NAMES = ["a.png", "A.TIF", "a_mask.png", "a.jpg.png", "a.jpg_mask.png", "a.mask.png", "a.jpg.mask.png"]


def write(path: Path, width: int = 40, height: int = 30, level: int = 128) -> Path:
    path.parent.mkdir(exist_ok=True, parents=True)
    Image.new("L", (width, height), level).convert("RGB").save(path)
    return path


def load(sources: list[Path], masks: Path | None = None, config: PhotosConfig = CONFIG) -> tuple[Photo, ...]:
    return load_photos(sources, masks, config, progress=no_progress)


def refusal(sources: list[Path], masks: Path | None = None) -> ReconstructionError:
    with pytest.raises(ReconstructionError) as caught:
        load(sources, masks)
    assert caught.value.remedy
    return caught.value


def test_natural_order() -> None:
    names = ["b1.jpg", "a10.jpg", "A2.jpg", "10.jpg", "9.jpg"]
    assert sorted(names, key=natural_order) == ["9.jpg", "10.jpg", "A2.jpg", "a10.jpg", "b1.jpg"]


def test_a_folder_gives_its_visible_pictures(tmp_path: Path) -> None:
    for name in ["10.png", "9.JPG", "._9.jpg", ".hidden.png"]:
        write(tmp_path / name)
    (tmp_path / "notes.txt").write_text("no picture")
    (tmp_path / "folder.png").mkdir()
    assert [photo.name for photo in load([tmp_path])] == ["9.JPG", "10.png"]


def test_a_file_counts_once_and_equal_names_are_told_apart(tmp_path: Path) -> None:
    one, other = write(tmp_path / "a" / "x.png"), write(tmp_path / "b" / "x.png")
    photos = load([one, other, one, tmp_path / "a" / ".." / "a" / "x.png"])
    assert [photo.name for photo in photos] == ["a/x.png", "b/x.png"]


def test_scaled_down_upright_with_the_original_size(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 43
    Image.new("RGB", (400, 300)).save(tmp_path / "turned.jpg", exif=exif)
    write(tmp_path / "wide.png", 50, 20)
    turned, wide = load([tmp_path])
    assert turned.image_srgb.shape == (100, 75, 3)
    assert (turned.original_width, turned.original_height) == (300, 400)
    assert turned.focal_px == pytest.approx(500, rel=0.01), "of the original"
    assert wide.image_srgb.shape == (20, 50, 3), "never scaled up"


def test_no_photographs(tmp_path: Path) -> None:
    assert refusal([tmp_path]).code == ErrorCode.NO_PHOTOS
    assert refusal([]).code == ErrorCode.NO_PHOTOS
    missing = refusal([tmp_path / "nowhere"])
    assert missing.code == ErrorCode.NO_PHOTOS
    assert "nowhere" in missing.text


def test_one_photograph_is_too_few(tmp_path: Path) -> None:
    assert refusal([write(tmp_path / "a.png")]).code == ErrorCode.TOO_FEW_PHOTOS


def test_an_unreadable_photograph_is_named(tmp_path: Path) -> None:
    write(tmp_path / "a.png")
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8\xff no")
    error = refusal([tmp_path])
    assert error.code == ErrorCode.PHOTO_UNREADABLE
    assert "broken.jpg" in error.text


@pytest.mark.parametrize("mask_name", MASK_NAMES)
def test_masks_are_found_by_name(mask_name: str, tmp_path: Path) -> None:
    path = write(tmp_path / mask_name)
    write(tmp_path / "ab.png")
    assert match_masks({name: Path("photos") / name for name in ("a.jpg", "c.jpg")}, tmp_path) == {
        "a.jpg": path
    }


def test_a_mask_of_another_size_is_scaled(tmp_path: Path) -> None:
    """As in DTU: masks smaller than the photographs. Half white at the mask's size is half white at ours."""
    for name in ["a.png", "b.png"]:
        write(tmp_path / "photos" / name, 160, 120)
    half = np.zeros((48, 64), np.uint8)
    half[:, 32:] = 255
    (tmp_path / "masks").mkdir()
    Image.fromarray(half).save(tmp_path / "masks" / "a.png")
    with_mask, without = load([tmp_path / "photos"], tmp_path / "masks")
    assert with_mask.mask is not None
    assert with_mask.mask.shape == with_mask.image_srgb.shape[:2] == (75, 100)
    assert (with_mask.mask[:, :48] == 0).all()
    assert (with_mask.mask[:, 52:] == 1).all()
    assert with_mask.mask.mean() == pytest.approx(0.5, abs=1e-3)
    assert without.mask is None


def test_masks_of_zeros_and_ones_count_as_black_and_white(tmp_path: Path) -> None:
    for name in ["a.png", "b.png"]:
        write(tmp_path / name)
    (tmp_path / "m").mkdir()
    Image.fromarray(np.eye(30, 40, dtype=np.uint8)).save(tmp_path / "m" / "a.png")
    first = load([tmp_path], tmp_path / "m")[0]
    assert first.mask is not None
    np.testing.assert_array_equal(first.mask, np.eye(30, 40))


def test_a_mask_counts_before_alpha(tmp_path: Path) -> None:
    for name in ["a.png", "b.png"]:
        Image.new("LA", (40, 30), (100, 51)).save(tmp_path / name)
    write(tmp_path / "m" / "a.png", level=255)
    masked, alpha = load([tmp_path], tmp_path / "m")
    assert masked.mask is not None
    assert alpha.mask is not None
    assert masked.mask.min() == 1
    np.testing.assert_allclose(alpha.mask, 0.2, atol=1e-6)


@pytest.mark.parametrize("alpha", [0, 128, 254, "one pixel", "a border", "the subject away"])
def test_an_alpha_that_cuts_out_nothing_hides_no_mask_in_colours(alpha: int | str, tmp_path: Path) -> None:
    photos = [write(tmp_path / name) for name in ["a.png", "b.png"]]
    subject = np.zeros((30, 40), np.uint8)
    subject[10:20, 10:30] = 255
    channel = np.full_like(subject, alpha if isinstance(alpha, int) else 255)
    if alpha == "the subject away":
        channel -= subject
    elif alpha == "a border":
        channel[0] = 0
    elif alpha == "one pixel":
        channel[3, 3] = 0
    (tmp_path / "m").mkdir()
    Image.fromarray(np.dstack([subject, subject, subject, channel])).save(tmp_path / "m" / "a.png")
    mask = load(photos, tmp_path / "m")[0].mask
    assert mask is not None
    np.testing.assert_array_equal(mask > 0.5, subject > 0)


def test_alpha_alone_is_a_mask_also_of_what_fills_the_picture(tmp_path: Path) -> None:
    photos = [write(tmp_path / name) for name in ["a.png", "b.png"]]
    alpha = np.full((30, 40), 255, np.uint8)
    alpha[10:20, 10:30] = 0
    (tmp_path / "m").mkdir()
    Image.fromarray(np.dstack([np.zeros_like(alpha), alpha])).save(tmp_path / "m" / "a.png")
    mask = load(photos, tmp_path / "m")[0].mask
    assert mask is not None
    np.testing.assert_array_equal(mask > 0.5, alpha > 0)


def test_a_photograph_that_is_transparent_all_over_is_told_as_such(tmp_path: Path) -> None:
    for name in ["a.png", "b.png"]:
        Image.new("LA", (40, 30), (100, 0)).save(tmp_path / name)
    error = refusal([tmp_path])
    assert "alpha channel of a.png is empty" in error.text
    assert "opaque" in error.remedy


def test_masks_of_a_kind_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    photos = [write(tmp_path / name) for name in ["a.png", "b.png"]]
    write(tmp_path / "m" / "a_mask.gif")
    assert "a_mask.gif. Convert" in refusal(photos, tmp_path / "m").remedy


@pytest.mark.parametrize("as_files", [False, True])
def test_raw_photographs_are_named_and_their_thumbnails_no_photographs(
    as_files: bool, tmp_path: Path
) -> None:
    """As in `--images *.NEF`: a raw photograph is a TIFF whose first picture is a small one."""
    for name in ["1.NEF", "2.dng"]:
        write(tmp_path / f"{name}.tif").rename(tmp_path / name)
    sources = sorted(tmp_path.iterdir()) if as_files else [tmp_path]
    error = refusal(sources)
    assert error.code == ErrorCode.NO_PHOTOS
    assert "1.NEF, 2.dng. Convert" in error.remedy
    sources.append(write(tmp_path / "3.jpg"))
    error = refusal(sources)
    assert error.code == ErrorCode.TOO_FEW_PHOTOS
    assert "1.NEF, 2.dng. Convert" in error.remedy
    sources.append(write(tmp_path / "4.jfif.jpg").rename(tmp_path / "4.jfif"))
    assert [photo.name for photo in load(sources)] == ["3.jpg", "4.jfif"]


def test_masks_that_cut_nothing_out_are_told(tmp_path: Path) -> None:
    for name in ["a.png", "b.png"]:
        write(tmp_path / name)
        write(tmp_path / "white" / name, level=255)
    assert "white all over" in white_masks_text(load([tmp_path], tmp_path / "white"))
    assert white_masks_text(load([tmp_path])) == ""
    Image.fromarray(255 * np.eye(30, 40, dtype=np.uint8)).save(tmp_path / "white" / "a.png")
    assert white_masks_text(load([tmp_path], tmp_path / "white")) == ""


def test_inverted_masks_are_told(tmp_path: Path) -> None:
    subject = np.zeros((30, 40), np.uint8)
    subject[10:20, 10:30] = 255
    facade = np.full_like(subject, 255)
    facade[:4] = 0
    (tmp_path / "m").mkdir()
    for name in ["a.png", "b.png"]:
        write(tmp_path / name)
        Image.fromarray(255 - subject).save(tmp_path / "m" / name)
    assert "of the background" in white_masks_text(load([tmp_path], tmp_path / "m"))
    for right in (subject, facade):
        Image.fromarray(right).save(tmp_path / "m" / "b.png")
        assert white_masks_text(load([tmp_path], tmp_path / "m")) == ""


def test_unusable_masks_are_refused(tmp_path: Path) -> None:
    photos = [write(tmp_path / name) for name in ["a.png", "b.png"]]
    write(tmp_path / "shape" / "a.png", 40, 40, level=255)
    write(tmp_path / "names" / "c.png", level=255)
    write(tmp_path / "empty" / "a.png", level=0)
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "b.png").write_bytes(b"no picture")
    for folder, named in [("shape", "a.png"), ("names", "names"), ("empty", "a.png"), ("broken", "b.png")]:
        error = refusal(photos, tmp_path / folder)
        assert error.code == ErrorCode.MASK_UNUSABLE, folder
        assert named in error.text
    assert refusal(photos, tmp_path / "nowhere").code == ErrorCode.MASK_UNUSABLE


def test_progress_can_cancel(tmp_path: Path) -> None:
    write(tmp_path / "a.png")
    write(tmp_path / "b.png")

    def cancel(share: float, _text: str) -> None:
        if share >= 0.5:
            raise Cancelled

    with pytest.raises(Cancelled):
        load_photos([tmp_path], None, CONFIG, progress=cancel)


def test_an_alpha_that_is_opaque_along_the_edges_is_no_outline() -> None:
    subject = np.zeros((60, 80), np.float32)
    subject[20:40, 30:50] = 1
    valid = np.ones((60, 80), np.float32)
    valid[:2], valid[:, -1] = 0, 0  # what undistortion leaves
    assert is_outline(subject)
    assert not is_outline(valid)


def test_masks_beside_the_photographs_are_masks_and_no_photographs(tmp_path: Path) -> None:
    """Photographs are given as their folder, or as everything in it."""
    for name in ["a.jpg", "b.JPG", "c.png"]:
        write(tmp_path / name)
    for name in ["a_mask.png", "B.mask.png", "c.png.mask.png", "another_mask.png"]:
        write(tmp_path / name, level=255)
    for sources in ([tmp_path], sorted(tmp_path.iterdir())):
        photos = load(sources, tmp_path)
        assert [photo.name for photo in photos] == ["a.jpg", "another_mask.png", "b.JPG", "c.png"]
        masked = [photo.name for photo in photos if photo.mask is not None and photo.mask.min() == 1]
        assert masked == ["a.jpg", "b.JPG", "c.png"]
        assert "a_mask.png, B.mask.png, c.png.mask.png" in unused_masks_text(sources)
    assert unused_masks_text([tmp_path / "a.jpg", tmp_path / "b.JPG"]) == ""


def test_no_photograph_is_its_own_mask(tmp_path: Path) -> None:
    for name in ["a.png", "b.png"]:
        write(tmp_path / name, level=255)
    error = refusal([tmp_path], tmp_path)
    assert error.code == ErrorCode.MASK_UNUSABLE
    assert error.remedy == "Name the mask of a.png a_mask.png."


def test_what_a_phone_saved_beside_the_photograph_is_no_mask(tmp_path: Path) -> None:
    for name in ["a.JPG", "b.JPG", "b_mask.png"]:
        write(tmp_path / name, level=255)
    (tmp_path / "a.heic").touch()
    assert [photo.mask is None for photo in load([tmp_path], tmp_path)] == [True, False]


def test_a_mask_of_two_photographs_is_refused(tmp_path: Path) -> None:
    photos = [write(tmp_path / folder / "IMG_1.jpg") for folder in "lr"]
    write(tmp_path / "masks" / "IMG_1.png", level=255)
    error = refusal(photos, tmp_path / "masks")
    assert error.code == ErrorCode.MASK_UNUSABLE
    assert "IMG_1.png could be that of l/IMG_1.jpg or of r/IMG_1.jpg" in error.text


def test_masks_named_in_full_tell_photographs_apart(tmp_path: Path) -> None:
    photos = {name: tmp_path / name for name in ("a.jpg", "a.tif")}
    masks = {name: write(tmp_path / "masks" / f"{name}.png") for name in photos}
    write(tmp_path / "masks" / "a.png")
    assert match_masks(photos, tmp_path / "masks") == masks


def test_accents_may_be_written_as_a_mac_does(tmp_path: Path) -> None:
    name, mask = (unicodedata.normalize(form, "Fuß für.jpg") for form in ("NFC", "NFD"))
    path = write(tmp_path / mask)
    assert match_masks({name: Path("photos") / name}, tmp_path) == {name: path}


def write_turned(path: Path, pixels: np.ndarray, orientation: int) -> None:
    path.parent.mkdir(exist_ok=True)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    Image.fromarray(pixels).save(path, exif=exif)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("mask_knows", [True, False])
def test_masks_are_turned_with_their_photographs(orientation: int, mask_knows: bool, tmp_path: Path) -> None:
    """Those of the pixels as stored: they say so themselves, or their shape tells."""
    pixels = np.zeros((30, 40), np.uint8)
    pixels[4:10, 2:12] = 255
    for name in ["a.png", "b.png"]:
        write_turned(tmp_path / "photos" / name, pixels, orientation)
    write_turned(tmp_path / "masks" / "a.png", pixels, orientation if mask_knows else 1)
    photo = load([tmp_path / "photos"], tmp_path / "masks")[0]
    assert photo.mask is not None
    assert photo.exif_orientation == orientation
    if mask_knows or orientation == 1 or orientation >= 5:
        np.testing.assert_array_equal(photo.mask, photo.image_srgb[..., 0])
    assert ("a.png" in turned_text("masks", [photo])) == (orientation in (2, 3, 4))


def test_an_upright_mask_stays_so(tmp_path: Path) -> None:
    pixels = np.zeros((30, 40), np.uint8)
    pixels[4:10, 2:12] = 255
    for name in ["a.png", "b.png"]:
        write_turned(tmp_path / "photos" / name, pixels, 6)
    write_turned(tmp_path / "masks" / "a.png", np.rot90(pixels, -1), 1)
    photo = load([tmp_path / "photos"], tmp_path / "masks")[0]
    assert photo.mask is not None
    np.testing.assert_array_equal(photo.mask, photo.image_srgb[..., 0])
