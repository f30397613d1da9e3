"""Which files are photographs, and what each is called."""

from pathlib import Path

import pytest

from backend.wire.photographs import is_named, names_of, passed_over, passed_over_text, photographs_in


def touched(folder: Path, *names: str) -> list[Path]:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return [folder / name for name in names]


@pytest.mark.parametrize(
    ("files", "names"),
    [
        (["a/1.jpg", "b/2.jpg"], ["1.jpg", "2.jpg"]),
        (["a/1.jpg", "b/1.jpg", "b/2.jpg"], ["a/1.jpg", "b/1.jpg", "2.jpg"]),
        (["x/a/1.jpg", "y/a/1.jpg", "y/b/1.jpg"], ["x/a/1.jpg", "y/a/1.jpg", "b/1.jpg"]),
        (["/1.jpg", "/a/1.jpg"], ["/1.jpg", "a/1.jpg"]),
    ],
)
def test_names_tell_photographs_apart_and_are_ends_of_their_paths(files: list[str], names: list[str]) -> None:
    paths = [Path("/photos") / file for file in files]
    assert names_of(paths) == names
    for path in paths:
        assert [is_named(path, name) for name in names] == [path == other for other in paths]


def test_a_name_is_an_end_in_whole_words() -> None:
    assert is_named(Path("/a/b/1.jpg"), "b/1.jpg")
    for name in ("c/1.jpg", ".jpg", "", "/", "b", "/x/a/b/1.jpg", "\0"):
        assert not is_named(Path("/a/b/1.jpg"), name)


def test_pictures_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    touched(tmp_path, "1.jpg", "2.NEF", "3.jxl", "4.dng", "5.gif", "notes.txt", ".6.dng", "sub/7.dng")
    names = passed_over([tmp_path, tmp_path / "9.avif", tmp_path / "8.dng"])
    assert names == ("2.NEF", "3.jxl", "4.dng", "5.gif")
    assert "2.NEF, 3.jxl, 4.dng and 1 more" in passed_over_text(names)
    assert passed_over_text(()) == ""


def test_raw_photographs_beside_their_copies_are_not_passed_over(tmp_path: Path) -> None:
    """As of a camera that is set to save both."""
    touched(tmp_path, "IMG_1.CR2", "IMG_1.JPG", "IMG_2.CR2", "masks/IMG_2.png")
    assert passed_over([tmp_path, tmp_path / "masks"]) == ("IMG_2.CR2",)
    assert passed_over([tmp_path / "IMG_1.CR2", tmp_path / "IMG_1.JPG"]) == ()


def test_photographs_of_a_folder(tmp_path: Path) -> None:
    touched(tmp_path, "1.jpg", "2.HEIC", "3.WEBP", "4.bmp", ".5.jpg", "sub/6.jpg", "8.dng")
    (tmp_path / "7.png").mkdir()
    assert sorted(path.name for path in photographs_in(tmp_path)) == ["1.jpg", "2.HEIC", "3.WEBP", "4.bmp"]


def test_masks_of_photographs_are_none(tmp_path: Path) -> None:
    touched(tmp_path, "1.jpg", "1_mask.png", "2.HEIC", "2.JPG", "2.jpg_MASK.png", "2.Mask.tif", "3_mask.png")
    assert sorted(path.name for path in photographs_in(tmp_path)) == ["1.jpg", "2.JPG", "3_mask.png"]


def test_what_a_phone_saved_and_its_copy_are_one_photograph(tmp_path: Path) -> None:
    touched(tmp_path, "IMG_1.HEIC", "IMG_1.JPG", "IMG_2.HEIC", "IMG_3.jpg", "IMG_4.heif", "IMG_4.png")
    found = sorted(path.name for path in photographs_in(tmp_path))
    assert found == ["IMG_1.JPG", "IMG_2.HEIC", "IMG_3.jpg", "IMG_4.png"]
