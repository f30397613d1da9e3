"""Which files are photographs, and what each is called in results; standard library only.

The backend names photographs by it, and who shows its results finds them again.
"""

import unicodedata
from collections.abc import Collection, Sequence
from pathlib import Path, PurePosixPath

_OF_PHONES = (".heic", ".heif")
SUFFIXES = (".jpg", ".jpeg", ".jfif", *_OF_PHONES, ".png", ".tif", ".tiff", ".webp", ".bmp")
"""Of files that can be read, in small letters."""
KINDS = "JPEG, HEIC, PNG, TIFF, WebP and BMP"
"""The same in words."""
_OTHER_SUFFIXES = frozenset(
    {".avif", ".jxl", ".jp2", ".gif", ".exr", ".hdr", ".psd"}
    | {
        ".dng",
        ".cr2",
        ".cr3",
        ".nef",
        ".nrw",
        ".arw",
        ".raf",
        ".orf",
        ".rw2",
        ".pef",
        ".srw",
        ".x3f",
        ".3fr",
        ".iiq",
    }
)
"""Of pictures that cannot: phones and cameras write some of them beside those above."""
MASK_ENDINGS = ("_mask", ".mask")
"""Of a mask's name before its extension, as Metashape and RealityScan write them."""


def photographs_in(folder: Path) -> list[Path]:
    """The photographs right in the folder: its pictures but for masks of the others.

    Raises OSError where the folder cannot be read.
    """
    found = pictures_in(folder)
    masks = masks_among(found)
    return [path for path in found if path not in masks]


def pictures_in(folder: Path) -> list[Path]:
    """The pictures right in the folder that can be read, masks too.

    What a phone saved counts once where it lies beside a copy in another format, IMG_1.HEIC beside IMG_1.JPG:
    the copy. Raises OSError where the folder cannot be read.
    """
    found = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and _is_visible_file(path)]
    copies = {path.stem for path in found if not is_of_phone(path)}
    return [path for path in found if not (is_of_phone(path) and path.stem in copies)]


def masks_among(paths: Collection[Path]) -> list[Path]:
    """Those that are named as masks of others: as a_mask.png or a.jpg.mask.png where there is an a.jpg."""
    named = {spelling(name) for path in paths for name in (path.stem, path.name)}
    masks = {name + ending for name in named for ending in MASK_ENDINGS}
    return [path for path in paths if spelling(path.stem) in masks]


def is_readable(path: Path) -> bool:
    """Whether its name does not say that it is a picture of a kind that cannot be read."""
    return path.suffix.lower() not in _OTHER_SUFFIXES


def is_of_phone(path: Path) -> bool:
    """Whether the file has a format that phones write and Blender does not read."""
    return path.suffix.lower() in _OF_PHONES


def passed_over(sources: Sequence[Path]) -> tuple[str, ...]:
    """Names of the pictures among the sources, files or folders, that cannot be read.

    Those that lie beside a copy that can, IMG_1.CR2 beside IMG_1.JPG, are none. Raises OSError where a folder
    cannot be read.
    """
    members = [path for source in sources for path in (source.iterdir() if source.is_dir() else [source])]
    copies = {path.with_suffix("") for path in members if path.suffix.lower() in SUFFIXES}
    others = (path for path in members if not is_readable(path) and _is_visible_file(path))
    return tuple(sorted({path.name for path in others if path.with_suffix("") not in copies}))


def passed_over_text(names: Sequence[str]) -> str:
    """What to tell the user of pictures that were passed over; empty where there are none."""
    if not names:
        return ""
    return f"Passed over, because only {KINDS} can be read: {first_names(names)}. Convert them to JPEG."


def first_names(names: Sequence[str]) -> str:
    """Three of the names, and how many more there are."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def names_of(paths: Sequence[Path]) -> list[str]:
    """What photographs are called: the file's name, after as many folders as tell it from the others."""
    all_parts = [path.absolute().parts for path in paths]
    names = []
    for parts in all_parts:
        length = 1
        while sum(other[-length:] == parts[-length:] for other in all_parts) > 1 and length < len(parts):
            length += 1
        names.append(PurePosixPath(*parts[-length:]).as_posix())
    return names


def spelling(name: str) -> str:
    """The same for names that differ in letter case, or in how a Mac writes their accents."""
    return unicodedata.normalize("NFC", name).lower()


def is_named(path: Path, name: str) -> bool:
    """Whether a photograph in this file may be called so: whether its path ends in the name."""
    parts = PurePosixPath(name).parts
    return bool(parts) and path.parts[-len(parts) :] == parts


def _is_visible_file(path: Path) -> bool:
    return not path.name.startswith(".") and path.is_file()
