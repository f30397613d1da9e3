"""The turn of a photograph against Pillow, which writes the tag and turns pictures by it."""

from pathlib import Path

import pytest
from PIL import Image, ImageOps

from addon.exif_orientation import clockwise_turn_deg


def photograph(path: Path, orientation: int | None) -> Path:
    exif = Image.Exif()
    if orientation is not None:
        exif[0x010F] = "A maker"
        exif[0x0112] = orientation
    image = Image.new("RGB", (32, 16))
    image.paste((255, 255, 255), (0, 0, 8, 8))
    image.save(path, exif=exif)
    return path


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_turning_by_it_is_what_pillow_does(tmp_path: Path, orientation: int) -> None:
    path = photograph(tmp_path / "a.jpg", orientation)
    with Image.open(path) as image:
        turned = image.rotate(-clockwise_turn_deg(path), expand=True)
        assert turned.tobytes() == ImageOps.exif_transpose(image).tobytes()


@pytest.mark.parametrize("orientation", [None, 0, 2, 9, 65535])
def test_what_is_not_a_turn_is_none(tmp_path: Path, orientation: int | None) -> None:
    assert clockwise_turn_deg(photograph(tmp_path / "a.jpg", orientation)) == 0


def test_damaged_files_have_no_turn(tmp_path: Path) -> None:
    whole = photograph(tmp_path / "a.jpg", 6).read_bytes()
    end = whole.index(b"Exif") + 60
    for length in range(end):
        path = tmp_path / "short.jpg"
        path.write_bytes(whole[:length])
        assert clockwise_turn_deg(path) in {0, 90}
    path.write_bytes(b"\xff\xd8\xff\xe1Exif\0\0MM\0*\xff\xff\xff\xff")
    assert clockwise_turn_deg(path) == 0
    assert clockwise_turn_deg(tmp_path / "missing.jpg") == 0


def test_other_byte_order(tmp_path: Path) -> None:
    entry = b"\x01\x12\x00\x03\x00\x00\x00\x01\x00\x08\x00\x00"
    path = tmp_path / "a.jpg"
    path.write_bytes(b"\xff\xd8\xff\xe1\x00\x20Exif\0\0MM\x00*\x00\x00\x00\x08\x00\x01" + entry)
    assert clockwise_turn_deg(path) == 270
