"""How a JPEG photograph was turned when it was taken, which Blender does not look at; no Blender needed.

EXIF 2.32: the APP1 segment "Exif" holds a TIFF header, whose first directory has the tag 0x0112.
"""

import struct
from pathlib import Path

_READ_BYTES = 1 << 17
"""The segment stands at the beginning and is no longer than 64 KiB."""
_EXIF = b"Exif\0\0"
_ORIENTATION = 0x0112
_MOST_ENTRIES = 200
_CLOCKWISE_DEG = {1: 0, 3: 180, 6: 90, 8: 270}


def clockwise_turn_deg(path: Path) -> int:
    """Degrees, 0 to 270, by which the stored picture must be turned clockwise to be upright.

    0 where the file does not say, and for mirrored pictures, which no camera takes.
    """
    try:
        with path.open("rb") as file:
            start = file.read(_READ_BYTES)
        return _CLOCKWISE_DEG.get(_orientation(start), 0)
    except (OSError, struct.error):
        return 0


def _orientation(start: bytes) -> int:
    """The tag's value, 1 where there is none. Raises struct.error where the file ends early."""
    at = start.find(_EXIF)
    if not start.startswith(b"\xff\xd8") or at < 0:
        return 1
    tiff = start[at + len(_EXIF) :]
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None:
        return 1
    (directory,) = struct.unpack_from(f"{order}I", tiff, 4)
    (count,) = struct.unpack_from(f"{order}H", tiff, directory)
    for index in range(min(count, _MOST_ENTRIES)):
        tag, _, _, value = struct.unpack_from(f"{order}HHIH", tiff, directory + 2 + 12 * index)
        if tag == _ORIENTATION:
            return int(value)
    return 1
