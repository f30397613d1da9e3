"""Reads the PLY files that the backend writes, and writes points for it; numpy and the standard library, no
Blender needed.

    mesh.ply preview.ply     positions, normals, 8-bit sRGB colours, `support`, triangles with or without
                             coordinates in a texture
    points.ply sparse.ply    the same without triangles, with `confidence` or nothing in place of `support`

Nothing in a file is believed before it is checked: the header first, against the size of the file, so
that a number that lies cannot make this program ask for memory; then every value.
"""

import os
import re
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_LARGEST_HEADER_BYTES = 16_384
_LARGEST_COUNT = 100_000_000
"""Of vertices and of triangles; Blender counts a mesh's corners in 32 bits."""
_END = b"end_header\n"
_NUMBERS = {
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
}
_CORNERS = re.compile(r"property list (?:uchar|uint8) (int|int32|uint|uint32) vertex_ind(?:ices|ex)")
_COORDINATES = re.compile(r"property list (?:uchar|uint8) (?:float|float32) texcoord")
_POSITION, _NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
_COLOUR = ("red", "green", "blue")
_SUPPORT = ("support", "confidence")


@dataclass(frozen=True, kw_only=True, eq=False)
class PlyMesh:
    """What a file holds, in the frame in which it was written; every index is that of a vertex."""

    positions: NDArray[np.float64]
    """(vertices, 3), finite."""
    faces: NDArray[np.int32]
    """(faces, 3), counter-clockwise seen from outside; none in a file of points."""
    normals: NDArray[np.float32] | None
    """(vertices, 3), finite."""
    colours_srgb: NDArray[np.uint8] | None
    """(vertices, 4): red, green, blue, alpha."""
    support: NDArray[np.float32] | None
    """(vertices,), finite: `support` or `confidence`."""
    coordinates: NDArray[np.float32] | None
    """(faces, 3, 2), finite: where in its texture each face's corners lie, u to the right and v up."""


@dataclass(frozen=True, kw_only=True)
class _Layout:
    """What a header promises."""

    vertex: np.dtype[np.void]
    num_vertices: int
    face: np.dtype[np.void] | None
    num_faces: int

    @property
    def num_bytes(self) -> int:
        return self.num_vertices * self.vertex.itemsize + (
            self.num_faces * self.face.itemsize if self.face is not None else 0
        )


def read_ply(path: Path) -> PlyMesh:
    """The mesh or the points of a file.

    Raises ValueError, in a sentence for the user, where the file is none that FewView writes or is
    damaged, and OSError where it cannot be read.
    """
    with open(path, "rb", opener=_open_without_waiting) as file:
        found = os.fstat(file.fileno())
        if not stat.S_ISREG(found.st_mode):
            raise ValueError(f"{path.name} is not a file")
        start = file.read(_LARGEST_HEADER_BYTES)
        header, end, _ = start.partition(_END)
        if not start.startswith(b"ply\n") or not end:
            raise ValueError(f"{path.name} is not a PLY file with a header")
        layout = _layout(header, path.name)
        offset = len(header) + len(end)
        if found.st_size != offset + layout.num_bytes:
            raise ValueError(
                f"{path.name} is damaged: {found.st_size} bytes, its header says {offset + layout.num_bytes}"
            )
        file.seek(offset)
        body = file.read(layout.num_bytes)
    if len(body) != layout.num_bytes:
        raise ValueError(f"{path.name} changed while it was read")
    return _mesh(body, layout, path.name)


def write_points(path: Path, positions: NDArray[np.float64], normals: NDArray[np.float64] | None) -> None:
    """Write points (points, 3), in double precision, with normals (points, 3) where there are any."""
    names = _POSITION if normals is None else (*_POSITION, *_NORMAL)
    table = positions if normals is None else np.hstack([positions, normals])
    properties = "".join(f"property double {name}\n" for name in names)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(table)}\n{properties}"
    path.write_bytes(header.encode("ascii") + _END + table.astype("<f8").tobytes())


def _open_without_waiting(path: str, flags: int) -> int:
    """A pipe that nobody writes to would keep Blender waiting for ever."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def _layout(header: bytes, name: str) -> _Layout:
    """What a header promises; ValueError unless it is in the backend's dialect."""
    try:
        lines = header.decode("ascii").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{name} has a header that is not text") from error
    lines = [line for line in lines[1:] if not line.startswith(("comment", "obj_info"))]
    if not lines or lines[0] != "format binary_little_endian 1.0":
        raise ValueError(f"{name} is not a binary PLY file (little endian)")
    elements = _elements(lines[1:], name)
    if [kind for kind, _, _ in elements] not in (["vertex"], ["vertex", "face"]):
        raise ValueError(f"{name} must hold vertices, and after them faces or nothing")
    _, num_vertices, properties = elements[0]
    face, num_faces = None, 0
    if len(elements) == 2:
        _, num_faces, lists = elements[1]
        face = _face_record(lists, name)
    return _Layout(
        vertex=_vertex_record(properties, name), num_vertices=num_vertices, face=face, num_faces=num_faces
    )


def _elements(lines: list[str], name: str) -> list[tuple[str, int, list[str]]]:
    """(kind, count, lines of its properties) of each element."""
    elements: list[tuple[str, int, list[str]]] = []
    for line in lines:
        if element := re.fullmatch(r"element ([a-z]+) ([0-9]{1,12})", line):
            elements.append((element[1], int(element[2]), []))
            if elements[-1][1] > _LARGEST_COUNT:
                raise ValueError(f"{name} claims to hold {element[2]} of {element[1]}, which is too many")
        elif line.startswith("property ") and elements:
            elements[-1][2].append(line)
        else:
            raise ValueError(f"{name} has a header line that is unknown: {line[:60]!r}")
    return elements


def _vertex_record(properties: list[str], name: str) -> np.dtype[np.void]:
    """Of the numbers at each vertex."""
    pairs = []
    for line in properties:
        words = line.split(" ")
        if len(words) != 3 or words[1] not in _NUMBERS:
            raise ValueError(f"{name} has vertices with a property of unknown type: {line[:60]!r}")
        pairs.append((words[2], _NUMBERS[words[1]]))
    names = [field for field, _ in pairs]
    if len(set(names)) < len(names) or not set(_POSITION) <= set(names):
        raise ValueError(f"{name} has vertices without x, y and z, or with a property twice")
    record = np.dtype(pairs)
    _check_types(record, (*_POSITION, *_NORMAL, *_SUPPORT), "f", name)
    _check_types(record, (*_COLOUR, "alpha"), "u", name)
    return record


def _check_types(record: np.dtype[np.void], fields: tuple[str, ...], kind: str, name: str) -> None:
    for field in fields:
        if field in (record.names or ()) and (record[field].kind != kind or record[field].str == "<u4"):
            raise ValueError(f"{name} has {field} in a type that FewView does not write")


def _face_record(properties: list[str], name: str) -> np.dtype[np.void]:
    """Of a triangle, with the number of its corners, and of their coordinates where it has any."""
    patterns = (_CORNERS, _COORDINATES)[: max(1, len(properties))]
    found = [pattern.fullmatch(line) for pattern, line in zip(patterns, properties, strict=False)]
    if len(properties) not in (1, 2) or found[0] is None or None in found:
        raise ValueError(f"{name} has faces with other properties than their corners")
    fields: list[Any] = [("num_corners", "u1"), ("corners", _NUMBERS[found[0][1]], (3,))]
    if len(properties) == 2:
        fields += [("num_coordinates", "u1"), ("coordinates", "<f4", (3, 2))]
    return np.dtype(fields)


def _mesh(body: bytes, layout: _Layout, name: str) -> PlyMesh:
    """The values, checked."""
    vertices = np.frombuffer(body, layout.vertex, layout.num_vertices)
    colours = _columns(vertices, _COLOUR, np.uint8)
    if colours is not None:
        colours = np.concatenate([colours, np.full((len(colours), 1), 255, np.uint8)], axis=1)
        if "alpha" in (layout.vertex.names or ()):
            colours[:, 3] = vertices["alpha"]
    positions = _columns(vertices, _POSITION, np.float64)
    normals = _columns(vertices, _NORMAL, np.float32)
    support = next(
        (_columns(vertices, (f,), np.float32) for f in _SUPPORT if f in (vertices.dtype.names or ())), None
    )
    assert positions is not None
    faces, coordinates = _faces(body, layout, name)
    checked = {"positions": positions, "normals": normals, "support": support, "coordinates": coordinates}
    for what, values in checked.items():
        if values is not None and not np.isfinite(values).all():
            raise ValueError(f"{name} has {what} that are not finite numbers")
    return PlyMesh(
        positions=positions,
        faces=faces,
        normals=normals,
        colours_srgb=colours,
        support=None if support is None else support[:, 0],
        coordinates=coordinates,
    )


def _columns(
    vertices: NDArray[np.void], fields: tuple[str, ...], kind: type[np.generic]
) -> NDArray[Any] | None:
    """(vertices, fields), or None where the file does not have them all."""
    if not set(fields) <= set(vertices.dtype.names or ()):
        return None
    columns: NDArray[Any] = np.empty((len(vertices), len(fields)), kind)
    with np.errstate(over="ignore"):  # a double that is no float becomes infinite, which is found later
        for index, field in enumerate(fields):
            columns[:, index] = vertices[field]
    return columns


def _faces(body: bytes, layout: _Layout, name: str) -> tuple[NDArray[np.int32], NDArray[np.float32] | None]:
    """Corners of the triangles, and their coordinates where there are any."""
    if layout.face is None:
        return np.zeros((0, 3), np.int32), None
    records = np.frombuffer(body, layout.face, layout.num_faces, layout.num_vertices * layout.vertex.itemsize)
    if (records["num_corners"] != 3).any():
        raise ValueError(f"{name} has faces that are no triangles")
    corners = records["corners"]
    if corners.size and (corners.min() < 0 or corners.max() >= layout.num_vertices):
        raise ValueError(f"{name} has faces with corners that do not exist")
    if "coordinates" not in (layout.face.names or ()):
        return corners.astype(np.int32), None
    if (records["num_coordinates"] != 6).any():
        raise ValueError(f"{name} has faces with other coordinates than two for each corner")
    return corners.astype(np.int32), records["coordinates"].astype(np.float32)
