"""PNG files without what Blender adds to them; no Blender needed."""

import struct

PNG_SIGNATURE_BYTES = 8
PNG_CHUNK_FRAME_BYTES = 12
"""Length, type and checksum around the content of each chunk."""


def critical_chunks(png: bytes) -> bytes:
    """The PNG file without its optional chunks, where Blender writes date and render time.

    A chunk is critical where its type begins with a capital letter (PNG specification, 5.4).
    """
    kept, at = [png[:PNG_SIGNATURE_BYTES]], PNG_SIGNATURE_BYTES
    while at < len(png):
        length, kind = struct.unpack_from(">I4s", png, at)
        end = at + length + PNG_CHUNK_FRAME_BYTES
        if kind[:1].isupper():
            kept.append(png[at:end])
        at = end
    return b"".join(kept)
