"""The size of a picture from the beginning of its file, so that large photographs need not be decoded.

PNG (W3C PNG specification, 11.2.2) and JPEG (ITU T.81, B.2.2); no Blender needed.
"""

import struct
from pathlib import Path
from typing import BinaryIO

_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"
_MOST_JPEG_SEGMENTS = 500
_FRAME_HEADERS = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})
"""Markers of JPEG segments that hold the size."""
_WITHOUT_LENGTH = frozenset({0x01, *range(0xD0, 0xD8)})


def size_or_none(path: Path) -> tuple[int, int] | None:
    """Width and height in pixels, as stored; None where the file is no readable PNG or JPEG."""
    try:
        with path.open("rb") as file:
            start = file.read(24)
            if start.startswith(_PNG) and len(start) == 24:
                width, height = struct.unpack(">II", start[16:24])
                return width, height
            if start.startswith(_JPEG):
                file.seek(2)
                return _jpeg_size(file)
    except OSError:
        pass
    return None


def _jpeg_size(file: BinaryIO) -> tuple[int, int] | None:
    """From the first frame header; segments before it are passed over by their lengths."""
    for _ in range(_MOST_JPEG_SEGMENTS):
        marker = file.read(2)
        if len(marker) < 2 or marker[0] != 0xFF:
            return None
        if marker[1] == 0xFF:  # a fill byte
            file.seek(-1, 1)
            continue
        if marker[1] in _WITHOUT_LENGTH:
            continue
        header = file.read(2)
        if len(header) < 2:
            return None
        (length,) = struct.unpack(">H", header)
        if marker[1] in _FRAME_HEADERS:
            frame = file.read(5)
            if len(frame) < 5:
                return None
            height, width = struct.unpack(">HH", frame[1:])
            return width, height
        file.seek(length - 2, 1)
    return None
