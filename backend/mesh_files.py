"""Meshes and points as files: PLY with everything a vertex carries, glTF for every other program.

A texture is a PNG beside a PLY, which names it as MeshLab does, and a part of a glTF file.

The same record gives the same bytes. Both are written here rather than by trimesh, which drops
attributes of its own choosing from a PLY and stores glTF colours in 8 bits, where linear light needs 16.
Positions in a PLY are doubles: given cameras may live in map coordinates, far from the origin.
"""

import io
import json
import struct
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt8, UInt16
from PIL import Image

from .maths.srgb import linear_from_srgb
from .scene import Region, SurfaceMesh, SurfacePoints, Texture, transform_points

_POINT_FIELDS = [(axis, "<f8") for axis in ("x", "y", "z")] + [(axis, "<f4") for axis in ("nx", "ny", "nz")]
_COLOUR_FIELDS = [(channel, "u1") for channel in ("red", "green", "blue")]
_MESH_VERTEX = np.dtype([*_POINT_FIELDS, *_COLOUR_FIELDS, ("support", "<f4")])
_CLOUD_VERTEX = np.dtype([*_POINT_FIELDS, *_COLOUR_FIELDS, ("confidence", "<f4")])
_SPARSE_FIELDS = [*_POINT_FIELDS[:3], *_COLOUR_FIELDS]
_SEEN = "seen_{}"
"""Names of the bytes whose bits say which photographs show a sparse point, the first in the lowest bit."""
_FACE = np.dtype([("num_corners", "u1"), ("corners", "<i4", (3,))])
_TEXTURED_FACE = np.dtype([*_FACE.descr, ("num_coordinates", "u1"), ("coordinates", "<f4", (3, 2))])
_FACE_LISTS = {
    _FACE: ("property list uchar int vertex_indices",),
    _TEXTURED_FACE: ("property list uchar int vertex_indices", "property list uchar float texcoord"),
}
_PLY_NAMES = {"<f8": "double", "<f4": "float", "|u1": "uchar"}

_Y_UP_FROM_Z_UP = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], np.float64)
"""glTF has y up; the world of given cameras has z up by convention, so that Blender turns it back."""
_FAR_IN_SIZES = 16
"""From the origin; up to here single precision is good to a millionth of the size."""
_GLTF_FLOAT, _GLTF_USHORT, _GLTF_UINT = 5126, 5123, 5125
_GLTF_VERTICES, _GLTF_INDICES = 34962, 34963
_GLTF_SAMPLER = {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}
"""Linear, with mipmaps; nothing repeats."""


SPARSE = "sparse.ply"
TEXTURE = "texture.png"
_TEXTURE_COMMENT = f"comment TextureFile {TEXTURE}"


class MeshFileError(ValueError):
    """A file that is not one of those that are written here."""


def write_mesh(path: Path, mesh: SurfaceMesh) -> None:
    """Write mesh.ply: binary PLY with normals, colours and `support` at each vertex.

    The faces of a mesh with a texture have coordinates in it; texture.png is to lie beside, `png_of` it.
    """
    vertices = _vertex_table(_MESH_VERTEX, mesh.vertices, mesh.normals, mesh.colours_srgb)
    vertices["support"] = mesh.support
    faces = np.zeros(len(mesh.faces), _FACE if mesh.texture is None else _TEXTURED_FACE)
    faces["num_corners"] = 3
    faces["corners"] = mesh.faces
    if mesh.texture is not None:
        faces["num_coordinates"] = 6
        faces["coordinates"] = _coordinates(mesh.texture, y_down=False)
    header = _header(vertices, faces=faces)
    path.write_bytes(header + vertices.tobytes() + faces.tobytes())


def read_mesh(path: Path) -> SurfaceMesh:
    """The mesh of a file written by write_mesh, and its texture, without its decisions.

    Raises MeshFileError for any other file, and where the texture is not beside it.
    """
    header, _, body = path.read_bytes().partition(b"end_header\n")
    num_vertices, num_faces = _counts(header)
    textured = f"{_TEXTURE_COMMENT}\n".encode() in header
    kind = _TEXTURED_FACE if textured else _FACE
    faces_start = num_vertices * _MESH_VERTEX.itemsize
    if len(body) != faces_start + num_faces * kind.itemsize:
        raise MeshFileError(f"{path.name} is cut short or has other properties than a FewView mesh")
    vertices = np.frombuffer(body, _MESH_VERTEX, num_vertices)
    faces = np.frombuffer(body, kind, num_faces, faces_start)
    if header + b"end_header\n" != _header(vertices, faces=faces):
        raise MeshFileError(f"{path.name} has other properties than a FewView mesh")
    return SurfaceMesh(
        vertices=np.stack([vertices[axis] for axis in ("x", "y", "z")], axis=-1).astype(np.float64),
        faces=faces["corners"].astype(np.int64),
        normals=np.stack([vertices[axis] for axis in ("nx", "ny", "nz")], axis=-1).astype(np.float32),
        colours_srgb=np.stack([vertices[name] for name, _ in _COLOUR_FIELDS], axis=-1),
        support=vertices["support"].astype(np.float32),
        texture=_read_texture(path.with_name(TEXTURE), faces["coordinates"]) if textured else None,
    )


def _read_texture(path: Path, coordinates: Float32[np.ndarray, "faces 3 2"]) -> Texture:
    try:
        with Image.open(path) as file:
            image = np.asarray(file.convert("RGB"))
    except (OSError, SyntaxError, ValueError) as error:  # SyntaxError: Pillow, of a damaged PNG
        raise MeshFileError(f"{path.name} is not beside the mesh, or damaged") from error
    height, width = image.shape[:2]
    corners = [0, height] + coordinates.astype(np.float64) * [width, -height]
    return Texture(image_srgb=image, corners_px=corners.astype(np.float32))


def _coordinates(texture: Texture, *, y_down: bool) -> Float32[np.ndarray, "faces 3 2"]:
    """From 0 to 1 over the picture, to the right and, as glTF has it, down, or up as others do."""
    height, width = texture.image_srgb.shape[:2]
    shares = texture.corners_px.astype(np.float64) / [width, height]
    if not y_down:
        shares[..., 1] = 1 - shares[..., 1]
    return shares.astype(np.float32)


def png_of(texture: Texture) -> bytes:
    """The picture as a file, texture.png beside a PLY."""
    file = io.BytesIO()
    # the last tenth of the size takes most of the time
    Image.fromarray(texture.image_srgb).save(file, "PNG", compress_level=3)
    return file.getvalue()


def write_points(path: Path, points: SurfacePoints, region: Region) -> None:
    """Write points.ply: the points in the world frame with normals, colours and `confidence`."""
    rotation = region.world_from_object[:3, :3] / region.radius_world
    table = _vertex_table(
        _CLOUD_VERTEX,
        transform_points(region.world_from_object, points.positions.astype(np.float64)),
        (points.normals @ rotation.T).astype(np.float32),
        np.round(points.colours_srgb.clip(0.0, 1.0) * 255).astype(np.uint8),
    )
    table["confidence"] = points.confidence
    path.write_bytes(_header(table) + table.tobytes())


def write_sparse(
    path: Path,
    *,
    positions: Float64[np.ndarray, "points 3"],
    colours_srgb: UInt8[np.ndarray, "points 3"],
    visibility: Bool[np.ndarray, "points photos"],
) -> None:
    """Write sparse.ply: the features that photographs share, world frame, with colours; there may be none.

    `visibility` says which photographs, in the order of cameras.json, show each.
    """
    seen = np.packbits(visibility, axis=1, bitorder="little")
    table = np.zeros(len(positions), _sparse_layout(visibility.shape[1]))
    columns = np.hsplit(positions, 3) + np.hsplit(colours_srgb, 3) + np.split(seen, seen.shape[1], axis=1)
    for name, column in zip(table.dtype.names or (), columns, strict=True):
        table[name] = column[:, 0]
    path.write_bytes(_header(table) + table.tobytes())


def read_sparse(
    path: Path, num_photos: int
) -> tuple[Float64[np.ndarray, "points 3"], Bool[np.ndarray, "points {num_photos}"]]:
    """Positions and visibility of a file written by write_sparse beside so many cameras.

    Raises MeshFileError for any other file, OSError where it cannot be read.
    """
    header, end, body = path.read_bytes().partition(b"end_header\n")
    layout = _sparse_layout(num_photos)
    table = np.frombuffer(body[: len(body) // layout.itemsize * layout.itemsize], layout)
    if len(body) != table.nbytes or header + end != _header(table):
        raise MeshFileError(f"{path.name} is cut short, or not of {num_photos} cameras")
    positions = np.stack([table[axis] for axis in ("x", "y", "z")], axis=-1)
    if not np.isfinite(positions).all():
        raise MeshFileError(f"{path.name} has positions that are not finite")
    seen = np.stack([table[name] for name in (table.dtype.names or ())[len(_SPARSE_FIELDS) :]], axis=-1)
    return positions, np.unpackbits(seen, axis=1, count=num_photos, bitorder="little").astype(bool)


def write_glb(path: Path, mesh: SurfaceMesh, texture_png: bytes | None = None) -> None:
    """Write a binary glTF 2.0: y up, the custom attribute `_SUPPORT`, and the texture or, without one,
    linear vertex colours. Where charts of the texture meet there are two vertices in place of one.
    `texture_png` is `png_of` the texture, if that is made already: it takes longer than all else here.

    Positions are in single precision, so those of a mesh far from the origin are relative to its middle,
    which the node's translation holds in double precision.
    """
    positions = mesh.vertices @ _Y_UP_FROM_Z_UP.T
    middle = _middle_if_far(positions)
    attributes = {
        "POSITION": (positions - middle).astype("<f4"),
        "NORMAL": (mesh.normals @ _Y_UP_FROM_Z_UP.T).astype("<f4"),
        "_SUPPORT": mesh.support.astype("<f4"),
    }
    if mesh.texture is None:
        attributes["COLOR_0"] = _linear_rgba(mesh.colours_srgb).astype("<u2")
        corners, picture = mesh.faces, b""
    else:
        vertex, coordinates, corners = _split_at_seams(mesh.faces, _coordinates(mesh.texture, y_down=True))
        attributes = {name: values[vertex] for name, values in attributes.items()}
        attributes["TEXCOORD_0"] = coordinates.astype("<f4")
        picture = texture_png or png_of(mesh.texture)
    indices = corners.astype("<u4").ravel()
    binary = b"".join(array.tobytes() for array in (*attributes.values(), indices)) + picture
    structure = json.dumps(_gltf(attributes, indices, len(picture), middle), separators=(",", ":")).encode()
    structure += b" " * (-len(structure) % 4)
    binary += b"\0" * (-len(binary) % 4)
    size = 12 + 8 + len(structure) + 8 + len(binary)
    path.write_bytes(
        struct.pack("<4sII", b"glTF", 2, size)
        + struct.pack("<I4s", len(structure), b"JSON")
        + structure
        + struct.pack("<I4s", len(binary), b"BIN\0")
        + binary
    )


def _split_at_seams(
    faces: Int64[np.ndarray, "faces 3"], coordinates: Float32[np.ndarray, "faces 3 2"]
) -> tuple[Int64[np.ndarray, "split"], Float32[np.ndarray, "split 2"], Int64[np.ndarray, "faces 3"]]:
    """Of vertices that have one place in the texture each: which they were, their places, and the faces."""
    corners = np.empty(faces.size, np.dtype([("vertex", "i8"), ("u", "f4"), ("v", "f4")]))
    corners["vertex"] = faces.ravel()
    corners["u"], corners["v"] = coordinates.reshape(-1, 2).T
    found, number = np.unique(corners, return_inverse=True)
    places = np.stack([found["u"], found["v"]], axis=-1)
    return found["vertex"], places, number.reshape(-1, 3).astype(np.int64)


def _sparse_layout(num_photos: int) -> np.dtype[np.void]:
    return np.dtype([*_SPARSE_FIELDS, *((_SEEN.format(i), "u1") for i in range(-(-num_photos // 8)))])


def _vertex_table(
    layout: np.dtype[np.void],
    positions: Float[np.ndarray, "vertices 3"],
    normals: Float[np.ndarray, "vertices 3"],
    colours_srgb: UInt8[np.ndarray, "vertices 3"],
) -> np.ndarray:
    """A structured array of the layout, its last field still 0."""
    table = np.zeros(len(positions), layout)
    columns = np.hsplit(positions, 3) + np.hsplit(normals, 3) + np.hsplit(colours_srgb, 3)
    for name, column in zip(layout.names or (), columns, strict=False):
        table[name] = column[:, 0]
    return table


def _header(table: np.ndarray, *, faces: np.ndarray | None = None) -> bytes:
    """PLY header of a vertex table, and of triangles after it."""
    lines = ["ply", "format binary_little_endian 1.0", "comment FewView"]
    if faces is not None and faces.dtype == _TEXTURED_FACE:
        lines.append(_TEXTURE_COMMENT)
    lines.append(f"element vertex {len(table)}")
    for name in table.dtype.names or ():
        lines.append(f"property {_PLY_NAMES[table.dtype[name].str]} {name}")
    if faces is not None:
        lines += [f"element face {len(faces)}", *_FACE_LISTS[faces.dtype]]
    return "\n".join([*lines, "end_header\n"]).encode("ascii")


def _counts(header: bytes) -> tuple[int, int]:
    """Numbers of vertices and faces that a PLY header declares."""
    counts = {"vertex": -1, "face": -1}
    for line in header.split(b"\n"):
        words = line.decode("ascii", "replace").split()
        if len(words) == 3 and words[0] == "element" and words[1] in counts and words[2].isdecimal():
            counts[words[1]] = int(words[2])
    if min(counts.values()) < 0:
        raise MeshFileError("not a PLY file with vertices and faces")
    return counts["vertex"], counts["face"]


def _linear_rgba(colours_srgb: UInt8[np.ndarray, "vertices 3"]) -> UInt16[np.ndarray, "vertices 4"]:
    """Linear light, 65535 = 1, opaque: glTF's COLOR_0 is linear."""
    linear = linear_from_srgb(np.arange(256) / 255.0)
    rgba = np.full((len(colours_srgb), 4), 65535, np.uint16)
    rgba[:, :3] = np.round(linear * 65535).astype(np.uint16)[colours_srgb]
    return rgba


def _middle_if_far(positions: Float64[np.ndarray, "vertices 3"]) -> Float64[np.ndarray, "3"]:
    """The middle of the box of positions that lie far from the origin for their size; else the origin."""
    if not len(positions):
        return np.zeros(3)
    low, high = positions.min(axis=0), positions.max(axis=0)
    middle = (low + high) / 2
    far = np.abs(middle).max() > _FAR_IN_SIZES * (high - low).max()
    return np.asarray(middle if far else np.zeros(3))


def _gltf(
    attributes: dict[str, np.ndarray],
    indices: np.ndarray,
    picture_bytes: int,
    translation: Float64[np.ndarray, "3"],
) -> dict[str, object]:
    """The JSON part of the file; the arrays, and a picture, follow each other in the binary part."""
    types = {"<f4": _GLTF_FLOAT, "<u2": _GLTF_USHORT, "<u4": _GLTF_UINT}
    accessors: list[dict[str, object]] = []
    views: list[dict[str, object]] = []
    offset = 0
    for name, array in (*attributes.items(), ("indices", indices)):
        target = _GLTF_INDICES if name == "indices" else _GLTF_VERTICES
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": target})
        shape = "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}"
        kind = types[array.dtype.str]
        accessor = {
            "bufferView": len(accessors),
            "componentType": kind,
            "count": len(array),
            "type": shape,
        }
        if kind == _GLTF_USHORT:
            accessor["normalized"] = True
        if name == "POSITION" and len(array):  # the format demands the bounds of positions
            accessor |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        accessors.append(accessor)
        offset += array.nbytes
    primitive = {
        "attributes": {name: index for index, name in enumerate(attributes)},
        "indices": len(attributes),
        "material": 0,
    }
    surface: dict[str, object] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    pictures: dict[str, object] = {}
    if picture_bytes:
        surface["baseColorTexture"] = {"index": 0}
        pictures = {
            "images": [{"bufferView": len(views), "mimeType": "image/png", "name": "FewView"}],
            "samplers": [_GLTF_SAMPLER],
            "textures": [{"source": 0, "sampler": 0}],
        }
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": picture_bytes})
        offset += picture_bytes
    node: dict[str, object] = {"mesh": 0, "name": "FewView"}
    if translation.any():
        node["translation"] = translation.tolist()
    return {
        "asset": {"version": "2.0", "generator": "FewView"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"name": "FewView", "primitives": [primitive]}],
        "materials": [{"pbrMetallicRoughness": surface, "doubleSided": True}],
        **pictures,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset + -offset % 4}],
    }
