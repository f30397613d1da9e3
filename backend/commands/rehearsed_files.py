"""What a rehearsal leaves: a tetrahedron around the origin and three cameras that look at it, in exactly the
files of a run. Standard library only, so the PLY dialect of backend/mesh_files.py is written here once more;
tests hold the two together.
"""

import json
import math
import struct
import zlib
from pathlib import Path
from types import MappingProxyType
from typing import Any

_CORNERS = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))
_FACES = ((0, 1, 2), (0, 3, 1), (0, 2, 3), (1, 3, 2))
"""Counter-clockwise seen from outside."""
_COLOURS = ((200, 60, 60), (60, 200, 60), (60, 60, 200), (200, 200, 60))
_SIDES = ((230, 230, 230), (160, 160, 160), (110, 110, 110), (60, 60, 60))
"""Colours of the faces in the texture."""
_SUPPORT = (1.0, 0.7, 0.3, 0.0)

_POSITION = tuple(f"property double {axis}" for axis in "xyz")
_NORMAL = tuple(f"property float n{axis}" for axis in "xyz")
_COLOUR = tuple(f"property uchar {channel}" for channel in ("red", "green", "blue"))

_DISTANCE = 5.0
_WIDTH, _HEIGHT, _FOCAL_PX = 640, 480, 700.0
_AZIMUTHS_DEG, _ELEVATION_DEG = (-40.0, 0.0, 40.0), 20.0

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>FewView rehearsal</title></head>
<body><h1>FewView rehearsal</h1><p>A tetrahedron; no photograph was read.</p></body></html>
"""


def write_mesh(path: Path, *, size: float = 1.0) -> None:
    """Write the tetrahedron as mesh.ply; its corners are `size` times the root of 3 from the origin."""
    vertex = (*_POSITION, *_NORMAL, *_COLOUR, "property float support")
    face = (
        f"element face {len(_FACES)}",
        "property list uchar int vertex_indices",
        "property list uchar float texcoord",
    )
    unit = 1 / math.sqrt(3)
    body = b"".join(
        struct.pack("<3d3f3Bf", *(size * x for x in corner), *(unit * x for x in corner), *colour, support)
        for corner, colour, support in zip(_CORNERS, _COLOURS, _SUPPORT, strict=True)
    )
    for number, corners in enumerate(_FACES):
        left, right = (number + 0.125) / len(_FACES), (number + 0.875) / len(_FACES)
        body += struct.pack("<B3iB6f", 3, *corners, 6, left, 0.125, right, 0.125, left, 0.875)
    path.write_bytes(_header((*vertex, *face), texture=True) + body)


def write_texture(path: Path) -> None:
    """Write texture.png: a square in the colour of each face, side by side."""
    side = 8
    row = b"\0" + b"".join(bytes(colour) * side for colour in _SIDES)
    size = struct.pack(">2I5B", side * len(_SIDES), side, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", size), (b"IDAT", zlib.compress(row * side)), (b"IEND", b""))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(name, content) for name, content in chunks))


def _chunk(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))


def write_sparse(path: Path) -> None:
    """Write the corners as sparse.ply; all cameras see them."""
    points = zip(_CORNERS, _COLOURS, strict=True)
    all_cameras = 2 ** len(_AZIMUTHS_DEG) - 1
    body = b"".join(struct.pack("<3d4B", *corner, *colour, all_cameras) for corner, colour in points)
    path.write_bytes(_header((*_POSITION, *_COLOUR, "property uchar seen_0")) + body)


def write_cameras(path: Path) -> None:
    """Write cameras.json."""
    content = {
        "camera_model": "PINHOLE",
        "fewview": {
            "estimated": True,
            "reprojection_error_px": 0.5,
            "region": {"centre_world": [0.0, 0.0, 0.0], "radius_world": 2.0},
            "unplaced": [{"name": "3.png", "why": "this is a rehearsal"}],
        },
        "frames": [_frame(f"{index}.png", azimuth_deg) for index, azimuth_deg in enumerate(_AZIMUTHS_DEG)],
    }
    _write_json(path, content)


def write_report_numbers(path: Path) -> None:
    """Write report.json, with the keys of a run's that are told to users."""
    content = {
        "job": "rehearsal",
        "seed": 0,
        "warnings": ["This is a rehearsal: no photograph is read."],
        "decisions": [],
        "stages": [],
        "total_seconds": 0.0,
        "peak_memory_bytes": None,
        "cameras": {
            "estimated": True,
            "num_placed": len(_AZIMUTHS_DEG),
            "unplaced": ["3.png"],
            "unplaced_because": ["this is a rehearsal"],
            "reprojection_error_px": 0.5,
        },
        "num_stereo_points": len(_CORNERS),
        "region": {"centre_world": [0.0, 0.0, 0.0], "radius_world": 2.0},
        "mesh": {
            "num_vertices": len(_CORNERS),
            "num_faces": len(_FACES),
            "num_pieces": 1,
            "watertight": True,
            "size_world": [2.0, 2.0, 2.0],
            "support_histogram": [0.0, 0.0, 0.0, 0.25, 0.25, 0.25, 0.25, 0.0, 0.0, 0.0],
            "guessed_share": 0.0,
            "measured_share": 0.25,
        },
        "mean_psnr_db": None,
        "photos": [],
        "error": None,
    }
    _write_json(path, content)


def write_page(path: Path) -> None:
    """Write report.html."""
    path.write_text(_PAGE, encoding="utf-8")


RESULTS = MappingProxyType(
    {
        "mesh.ply": write_mesh,
        "texture.png": write_texture,
        "sparse.ply": write_sparse,
        "cameras.json": write_cameras,
        "report.json": write_report_numbers,
        "report.html": write_page,
    }
)
"""How each file is written, by its name."""


def _header(lines: tuple[str, ...], *, texture: bool = False) -> bytes:
    comments = ("comment FewView", *(("comment TextureFile texture.png",) if texture else ()))
    first = ("ply", "format binary_little_endian 1.0", *comments, f"element vertex {len(_CORNERS)}")
    return "\n".join([*first, *lines, "end_header\n"]).encode("ascii")


def _frame(name: str, azimuth_deg: float) -> dict[str, Any]:
    """A camera that looks at the origin with z up; azimuth 0 is on -y, as seen from Blender's front."""
    around, up = math.radians(azimuth_deg), math.radians(_ELEVATION_DEG)
    right = (math.cos(around), math.sin(around), 0.0)
    backward = (math.sin(around) * math.cos(up), -math.cos(around) * math.cos(up), math.sin(up))
    upward = (-math.sin(around) * math.sin(up), math.cos(around) * math.sin(up), math.cos(up))
    columns = zip(right, upward, backward, strict=True)
    return {
        "file_path": name,
        "camera_model": "PINHOLE",
        "w": _WIDTH,
        "h": _HEIGHT,
        "fl_x": _FOCAL_PX,
        "fl_y": _FOCAL_PX,
        "cx": _WIDTH / 2,
        "cy": _HEIGHT / 2,
        "transform_matrix": [
            *([*axes, _DISTANCE * back] for axes, back in zip(columns, backward, strict=True)),
            [0.0, 0.0, 0.0, 1.0],
        ],
    }


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
