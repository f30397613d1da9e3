"""The size of pictures from their headers, against the library that writes them."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from addon.image_header import size_or_none


@pytest.mark.parametrize("size", [(1, 1), (640, 480), (3, 5000)])
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.png", {}),
        ("a.jpg", {}),
        ("progressive.jpg", {"progressive": True}),
        ("exif.jpg", {"exif": b"Exif\0\0" + bytes(5000)}),
        ("thumb.jpg", {"comment": b"\xff\xc0" * 300}),
    ],
)
def test_it_is_what_was_written(
    tmp_path: Path, name: str, options: dict[str, object], size: tuple[int, int]
) -> None:
    path = tmp_path / name
    Image.new("RGB", size).save(path, **options)
    assert size_or_none(path) == size


def test_what_is_no_picture_has_no_size(tmp_path: Path) -> None:
    assert size_or_none(tmp_path / "missing.png") is None
    assert size_or_none(tmp_path) is None
    (tmp_path / "text.jpg").write_text("hello")
    assert size_or_none(tmp_path / "text.jpg") is None


@given(st.binary(max_size=300), st.sampled_from([b"\xff\xd8", b"\x89PNG\r\n\x1a\n"]))
def test_a_damaged_file_is_read_in_an_orderly_way(
    tmp_path_factory: pytest.TempPathFactory, tail: bytes, start: bytes
) -> None:
    path = tmp_path_factory.getbasetemp() / "damaged"
    path.write_bytes(start + tail)
    found = size_or_none(path)
    assert found is None or (len(found) == 2 and min(found) >= 0)
