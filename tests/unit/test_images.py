"""Image files against what was written into them."""

import struct
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import ExifTags, Image, ImageCms, ImageOps

from backend.errors import ErrorCode, ReconstructionError
from backend.images import (
    FULL_FRAME_DIAGONAL_MM,
    fitted_size,
    focal_px_or_none,
    read_image,
    resized,
    same_shape,
    upright,
)


@pytest.fixture
def noise() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (37, 53, 3), dtype=np.uint8)


def mean_over_areas(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """The definition, pixel by pixel: each old pixel cut into one piece for each new pixel."""
    fine = np.repeat(np.repeat(image, height, axis=0), width, axis=1)
    old_height, old_width = image.shape[:2]
    return fine.reshape(height, old_height, width, old_width).mean(axis=(1, 3))


@pytest.mark.parametrize("size", [(5, 4), (7, 3), (1, 1), (9, 6)])
def test_shrinking_is_the_mean_over_areas(size: tuple[int, int]) -> None:
    image = np.random.default_rng(1).random((6, 9))
    np.testing.assert_allclose(resized(image, *size), mean_over_areas(image, *size), rtol=1e-5)


def test_shrinking_many_strips_keeps_the_mean() -> None:
    image = np.random.default_rng(1).random((1500, 40, 3)).astype(np.float32)
    small = resized(image, 20, 750)
    by_blocks = image.reshape(750, 2, 20, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(small, by_blocks, rtol=1e-5)


@pytest.mark.parametrize("size", [(16, 12), (40, 30), (90, 61)])
def test_a_ramp_stays_a_ramp_at_any_size(size: tuple[int, int]) -> None:
    """Borders stay in place: a pixel's value is the position of its centre, in shares of the width."""
    width, height = size
    ramp = np.tile((np.arange(40) + 0.5) / 40, (30, 1))
    expected = np.tile((np.arange(width) + 0.5) / width, (height, 1))
    inner = slice(2, -2)  # Growing, the outermost new centres lie beyond the outermost old ones.
    tenth_of_an_old_pixel = 0.1 / 40  # The ramp is a staircase: areas that cut a step are off by less.
    np.testing.assert_allclose(
        resized(ramp, width, height)[:, inner], expected[:, inner], atol=tenth_of_an_old_pixel
    )


@given(st.integers(1, 5000), st.integers(1, 5000), st.integers(1, 3000))
@settings(max_examples=50, deadline=None)
def test_fitted_size_keeps_the_shape_and_the_limit(width: int, height: int, limit: int) -> None:
    new_width, new_height = fitted_size(width, height, limit)
    assert 1 <= max(new_width, new_height) <= max(1, limit)
    assert (new_width, new_height) == (width, height) or max(new_width, new_height) == limit
    if min(new_width, new_height) > 1:
        assert same_shape(width, height, new_width, new_height)


def test_same_shape_tells_a_crop_and_a_turn() -> None:
    assert same_shape(3072, 2048, 1600, 1067)
    assert not same_shape(1600, 1200, 1600, 1195)
    assert not same_shape(1600, 1200, 1200, 1600)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_agrees_with_pillow(orientation: int, noise: np.ndarray, tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    Image.fromarray(noise).save(tmp_path / "a.png", exif=exif)
    with Image.open(tmp_path / "a.png") as file:
        expected = np.asarray(ImageOps.exif_transpose(file))
    np.testing.assert_array_equal(upright(noise, orientation), expected)
    decoded = read_image(tmp_path / "a.png")
    np.testing.assert_allclose(decoded.image_srgb, expected / 255, atol=1e-6)
    assert (decoded.original_height, decoded.original_width) == expected.shape[:2]


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_what_an_iphone_saves(orientation: int, tmp_path: Path) -> None:
    """Turned by the file's own box, which EXIF repeats: once, not twice."""
    rows, columns = np.mgrid[0:48, 0:64]
    image = Image.fromarray(np.stack([4 * columns, 5 * rows, 128 + 0 * rows], axis=-1).astype(np.uint8))
    exif = exif_with({ExifTags.Base.FocalLengthIn35mmFilm: 26})
    exif[ExifTags.Base.Orientation] = orientation
    image.save(tmp_path / "a.jpg", exif=exif, quality=95)
    image.save(tmp_path / "a.HEIC", exif=exif.tobytes(), quality=95)
    heic, jpeg = read_image(tmp_path / "a.HEIC"), read_image(tmp_path / "a.jpg")
    assert (heic.original_width, heic.original_height) == (jpeg.original_width, jpeg.original_height)
    np.testing.assert_allclose(heic.image_srgb, jpeg.image_srgb, atol=0.04)
    assert heic.focal_px is not None
    assert heic.focal_px == pytest.approx(jpeg.focal_px)
    assert heic.mask is None


def test_a_cutout_of_a_phone_has_its_mask(noise: np.ndarray, tmp_path: Path) -> None:
    alpha = np.zeros(noise.shape[:2], np.uint8)
    alpha[10:20, 10:40] = 255
    Image.fromarray(np.dstack([noise, alpha])).save(tmp_path / "a.heic", quality=100)
    mask = read_image(tmp_path / "a.heic").mask
    assert mask is not None
    np.testing.assert_array_equal(mask > 0.5, alpha > 0)


@pytest.mark.parametrize("mode", ["L", "LA", "P", "RGB", "RGBA", "1"])
@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_modes_give_the_colours_pillow_gives(
    mode: str, suffix: str, noise: np.ndarray, tmp_path: Path
) -> None:
    image = Image.fromarray(noise).convert("L" if mode == "LA" else mode).convert(mode)
    image.save(tmp_path / f"a.{suffix}")
    decoded = read_image(tmp_path / f"a.{suffix}")
    np.testing.assert_allclose(decoded.image_srgb, np.asarray(image.convert("RGB")) / 255, atol=1e-6)
    assert decoded.image_srgb.dtype == np.float32
    assert decoded.mask is None, "an opaque alpha channel says nothing"


@pytest.mark.parametrize("mode", ["RGBA", "LA"])
def test_alpha_becomes_the_mask(mode: str, noise: np.ndarray, tmp_path: Path) -> None:
    image = Image.fromarray(noise).convert("L" if mode == "LA" else "RGB").convert(mode)
    image.putalpha(Image.fromarray(noise[..., 1]))
    image.save(tmp_path / "a.png")
    mask = read_image(tmp_path / "a.png").mask
    assert mask is not None
    np.testing.assert_allclose(mask, noise[..., 1] / 255, atol=1e-6)


def test_transparent_palette_becomes_the_mask(tmp_path: Path) -> None:
    image = Image.fromarray(np.array([[0, 1], [1, 0]], np.uint8), mode=None).convert("P")
    image.putpalette([255, 0, 0, 0, 0, 255])
    image.save(tmp_path / "a.png", transparency=1)
    mask = read_image(tmp_path / "a.png").mask
    np.testing.assert_array_equal(mask, [[1, 0], [0, 1]])


def test_cmyk_jpeg_is_read_as_colour(tmp_path: Path) -> None:
    Image.new("CMYK", (16, 16), (0, 255, 255, 0)).save(tmp_path / "a.jpg", quality=95)
    np.testing.assert_allclose(
        read_image(tmp_path / "a.jpg").image_srgb[8, 8], [1, 0, 0], atol=0.03, err_msg="no cyan: red"
    )


def _with_red_and_green_exchanged() -> bytes:
    """sRGB's colour profile but for its primaries: its table of tags has at 4 an offset and a size."""
    profile = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    red, green = (slice(profile.index(tag) + 4, profile.index(tag) + 12) for tag in (b"rXYZ", b"gXYZ"))
    profile[red], profile[green] = profile[green], profile[red]
    return bytes(profile)


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.webp", "a.heic", "a.jpg"])
def test_a_colour_profile_is_applied(name: str, tmp_path: Path) -> None:
    image = Image.new("RGB", (64, 64), (200, 60, 30))
    image.save(tmp_path / name, icc_profile=_with_red_and_green_exchanged(), quality=100)
    read = read_image(tmp_path / name).image_srgb[32, 32]
    np.testing.assert_allclose(read * 255, [60, 200, 30], atol=4)


def test_a_colour_profile_leaves_alpha_grey_and_what_is_srgb(noise: np.ndarray, tmp_path: Path) -> None:
    cut_out = Image.fromarray(np.dstack([noise, noise[..., 0]]))
    cut_out.save(tmp_path / "a.png", icc_profile=_with_red_and_green_exchanged())
    read = read_image(tmp_path / "a.png")
    np.testing.assert_allclose(read.mask, noise[..., 0] / 255, atol=1e-6)
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for name, profile in [("grey.png", srgb), ("colour.png", srgb), ("damaged.png", b"no profile")]:
        image = Image.fromarray(noise).convert("L" if name == "grey.png" else "RGB")
        image.save(tmp_path / name, icc_profile=profile)
        expected = np.asarray(image.convert("RGB")) / 255
        np.testing.assert_allclose(read_image(tmp_path / name).image_srgb, expected, atol=1e-6)


def test_inks_of_sixteen_bits_are_read_as_colour(tmp_path: Path) -> None:
    red = np.zeros((16, 16, 4), np.uint16)
    red[..., 1:3] = 65535
    tifffile.imwrite(tmp_path / "a.tif", red, photometric="separated")
    read = read_image(tmp_path / "a.tif")
    np.testing.assert_allclose(read.image_srgb[8, 8], [1, 0, 0], atol=0.01, err_msg="no cyan: red")
    assert read.mask is None, "black ink is no alpha"


def test_floating_point_numbers_are_from_black_to_white(noise: np.ndarray, tmp_path: Path) -> None:
    """Some programs write 0 to 255; a few lights beyond white are lights."""
    values = noise.astype(np.float32) / 255
    values[0, 0] = 20
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="rgb")
    np.testing.assert_allclose(read_image(tmp_path / "a.tif").image_srgb, np.minimum(values, 1), atol=1e-6)
    tifffile.imwrite(tmp_path / "b.tif", noise.astype(np.float32), photometric="rgb")
    with pytest.raises(ReconstructionError, match=r"Most of b.tif is brighter than white") as raised:
        read_image(tmp_path / "b.tif")
    assert raised.value.remedy


def test_sixteen_bits_are_kept(noise: np.ndarray, tmp_path: Path) -> None:
    deep = noise.astype(np.uint16) * 256 + 77
    tifffile.imwrite(tmp_path / "colour.tif", deep, photometric="rgb")
    tifffile.imwrite(
        tmp_path / "planes.tif", np.moveaxis(deep, -1, 0), photometric="rgb", planarconfig="separate"
    )
    Image.fromarray(deep[..., 0]).save(tmp_path / "grey.png")
    Image.fromarray(deep[..., 0]).save(tmp_path / "grey.tif")
    for name, expected in [
        ("colour.tif", deep),
        ("planes.tif", deep),
        ("grey.png", deep[..., :1].repeat(3, axis=2)),
        ("grey.tif", deep[..., :1].repeat(3, axis=2)),
    ]:
        read = read_image(tmp_path / name).image_srgb
        np.testing.assert_allclose(read, expected / 65535, atol=1e-6, err_msg=name)


def exif_with(entries: dict[int, float]) -> Image.Exif:
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif).update(entries)
    return exif


def test_focal_length_from_the_equivalent_is_by_the_diagonal() -> None:
    exif = exif_with({ExifTags.Base.FocalLengthIn35mmFilm: 50})
    expected_on_film_px = 50 / 36 * 6000
    assert focal_px_or_none(exif, 6000, 4000) == pytest.approx(expected_on_film_px)
    assert focal_px_or_none(exif, 4000, 6000) == pytest.approx(expected_on_film_px), "upright"
    phone = focal_px_or_none(exif, 4000, 3000)
    assert phone == pytest.approx(50 / FULL_FRAME_DIAGONAL_MM * 5000)


@pytest.mark.parametrize("size", [(2000, 1500), (1500, 2000)])
def test_focal_length_from_the_density_of_the_sensor(size: tuple[int, int]) -> None:
    """4000 pixels at 100 a millimetre: 40 mm wide; the file holds it at half the size, perhaps turned."""
    tags = ExifTags.Base
    entries = {tags.FocalLength: 60.0, tags.FocalPlaneXResolution: 1000.0, tags.FocalPlaneResolutionUnit: 3}
    entries |= {tags.ExifImageWidth: 4000, tags.ExifImageHeight: 3000}
    assert focal_px_or_none(exif_with(entries), *size) == pytest.approx(60 / 40 * 2000)


@pytest.mark.parametrize("value", [0, float("nan"), "wide", None])
def test_senseless_exif_is_no_focal_length(value: object) -> None:
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = value
    assert focal_px_or_none(exif, 100, 100) is None


@pytest.mark.parametrize(
    ("size", "words"),
    [
        ((16320, 12240), "a.bmp cannot be read"),  # as phones have: only the pixels are missing
        ((23200, 17400), "a.bmp cannot be read"),  # of a sensor that is shifted
        ((30_000, 30_000), "a.bmp is too large: more than 500 million pixels"),
    ],
)
def test_more_pixels_than_any_camera_has_are_refused(
    size: tuple[int, int], words: str, tmp_path: Path
) -> None:
    """A bitmap's header is enough: its size is looked at before its pixels."""
    path = tmp_path / "a.bmp"
    Image.new("1", (8, 8)).save(path)
    content = bytearray(path.read_bytes())
    content[18:26] = struct.pack("<ii", *size)
    path.write_bytes(content)
    with pytest.raises(ReconstructionError) as caught:
        read_image(path)
    assert caught.value.code == ErrorCode.PHOTO_UNREADABLE
    assert words in caught.value.text
    assert "bomb" not in caught.value.text


@pytest.mark.parametrize(
    "entries",
    [
        {ExifTags.Base.FocalLengthIn35mmFilm: 1},
        {ExifTags.Base.FocalLength: 0.1, ExifTags.Base.FocalPlaneXResolution: 2540.0},
    ],
    ids=["equivalent", "density"],
)
def test_a_focal_length_shorter_than_any_lens_is_none(entries: dict[int, float]) -> None:
    assert focal_px_or_none(exif_with(entries), 640, 480) is None
    longer = {tag: 10 * value for tag, value in entries.items()}
    assert focal_px_or_none(exif_with(longer), 640, 480) is not None


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "heic"])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.6])
def test_a_file_cut_short_is_refused_by_name(
    suffix: str, share: float, noise: np.ndarray, tmp_path: Path
) -> None:
    path = tmp_path / f"holiday.{suffix}"
    Image.fromarray(noise).save(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    with pytest.raises(ReconstructionError, match="holiday") as caught:
        read_image(path)
    assert caught.value.code == ErrorCode.PHOTO_UNREADABLE
