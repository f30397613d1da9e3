"""The add-on's PLY reader against the backend's writer, and against files that lie."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from addon.mesh_arrays import mesh_arrays
from addon.ply import PlyMesh, read_ply
from addon.ply import write_points as write_cloud
from backend.mesh_files import write_mesh, write_points
from backend.scene import Region, SurfaceMesh, SurfacePoints, Texture, to_unit_sphere
from backend.stages.points.point_cloud import read_cloud

TRIANGLE = b"""ply
format binary_little_endian 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
"""
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
FACE = b"\x03" + np.array([0, 1, 2], "<i4").tobytes()


def some_mesh(num_vertices: int, num_faces: int, *, seed: int = 0) -> SurfaceMesh:
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(num_vertices, 3)).astype(np.float32)
    return SurfaceMesh(
        vertices=rng.normal(size=(num_vertices, 3)) * 1e6,
        faces=rng.integers(0, max(num_vertices, 1), size=(num_faces, 3)),
        normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        colours_srgb=rng.integers(0, 256, size=(num_vertices, 3), dtype=np.uint8),
        support=rng.uniform(size=num_vertices).astype(np.float32),
    )


@pytest.mark.parametrize(("num_vertices", "num_faces"), [(0, 0), (1, 0), (3, 1), (1000, 1990)])
def test_it_reads_what_the_backend_writes(tmp_path: Path, num_vertices: int, num_faces: int) -> None:
    mesh = some_mesh(num_vertices, num_faces)
    write_mesh(tmp_path / "mesh.ply", mesh)
    found = read_ply(tmp_path / "mesh.ply")
    np.testing.assert_array_equal(found.positions, mesh.vertices)
    np.testing.assert_array_equal(found.faces, mesh.faces)
    np.testing.assert_array_equal(found.normals, mesh.normals)
    assert found.colours_srgb is not None
    np.testing.assert_array_equal(found.colours_srgb[:, :3], mesh.colours_srgb)
    assert (found.colours_srgb[:, 3] == 255).all()
    np.testing.assert_array_equal(found.support, mesh.support)
    assert found.faces.dtype == np.int32


def test_it_reads_where_faces_lie_in_a_texture(tmp_path: Path) -> None:
    mesh = some_mesh(30, 50)
    places = np.random.default_rng(1).uniform(0, 16, (50, 3, 2)).astype(np.float32)
    picture = np.zeros((32, 16, 3), np.uint8)
    write_mesh(tmp_path / "mesh.ply", replace(mesh, texture=Texture(image_srgb=picture, corners_px=places)))
    found = read_ply(tmp_path / "mesh.ply")
    np.testing.assert_array_equal(found.faces, mesh.faces)
    assert found.coordinates is not None
    # u to the right and v up, as Blender has them
    np.testing.assert_allclose(found.coordinates[..., 0], places[..., 0] / 16, atol=1e-6)
    np.testing.assert_allclose(found.coordinates[..., 1], 1 - places[..., 1] / 32, atol=1e-6)


def test_faces_that_are_left_out_take_their_places_with_them() -> None:
    faces = np.array([[0, 1, 2], [1, 1, 2], [2, 0, 1], [1, 2, 3]], np.int32)
    mesh = PlyMesh(
        positions=np.eye(4, 3),
        faces=faces,
        normals=None,
        colours_srgb=None,
        support=None,
        coordinates=np.arange(24, dtype=np.float32).reshape(4, 3, 2),
    )
    found = mesh_arrays(mesh, np.eye(4))
    assert found.corner_vertices.tolist() == [0, 1, 2, 1, 2, 3]
    assert found.corner_coordinates is not None
    np.testing.assert_array_equal(found.corner_coordinates.ravel(), [*range(6), *range(18, 24)])


def test_it_reads_points(tmp_path: Path) -> None:
    mesh = some_mesh(50, 0)
    points = SurfacePoints(
        positions=np.full((50, 3), 0.5, np.float32),
        normals=mesh.normals,
        colours_srgb=mesh.colours_srgb.astype(np.float32) / 255,
        confidence=mesh.support,
        num_views=np.full(50, 2),
        view_index=np.zeros(50, np.int64),
    )
    region = Region(object_from_world=to_unit_sphere(np.ones(3), 2.0), decisions=())
    write_points(tmp_path / "points.ply", points, region)
    found = read_ply(tmp_path / "points.ply")
    np.testing.assert_allclose(found.positions, 2.0)
    assert found.faces.shape == (0, 3)
    np.testing.assert_array_equal(found.support, mesh.support)


@pytest.mark.parametrize("with_normals", [False, True])
def test_the_backend_reads_the_points_that_it_writes(tmp_path: Path, with_normals: bool) -> None:
    mesh = some_mesh(50, 0)
    normals = mesh.normals.astype(np.float64) if with_normals else None
    write_cloud(tmp_path / "cloud.ply", mesh.vertices, normals)
    found = read_cloud(tmp_path / "cloud.ply")
    np.testing.assert_array_equal(found.positions, mesh.vertices)
    if normals is None:
        assert found.normals is None
    else:
        np.testing.assert_allclose(found.normals, normals, atol=1e-6)
    own = read_ply(tmp_path / "cloud.ply")
    np.testing.assert_array_equal(own.positions, mesh.vertices)
    assert (own.normals is None) == (normals is None)


def test_what_is_not_there_is_none(tmp_path: Path) -> None:
    found = read_ply(written(tmp_path, TRIANGLE + CORNERS + FACE))
    assert found.normals is None
    assert found.colours_srgb is None
    assert found.support is None
    assert found.coordinates is None
    assert found.faces.tolist() == [[0, 1, 2]]


def written(folder: Path, content: bytes) -> Path:
    path = folder / "some.ply"
    path.write_bytes(content)
    return path


def changed(old: bytes, new: bytes) -> bytes:
    assert old in TRIANGLE + CORNERS + FACE
    return (TRIANGLE + CORNERS + FACE).replace(old, new)


COORDINATES = b"property list uchar float texcoord\n"
TEXTURED = (
    TRIANGLE.replace(b"end_header", COORDINATES + b"end_header")
    + CORNERS
    + FACE
    + b"\x06"
    + np.full(6, 0.5, "<f4").tobytes()
)
NAN = np.array([np.nan], "<f4").tobytes()
LYING = {
    "nothing": b"",
    "no header": b"ply\n" + b"\0" * 100,
    "endless header": b"ply\n" + b"comment x\n" * 100_000 + TRIANGLE[4:] + CORNERS + FACE,
    "text": changed(b"binary_little_endian", b"ascii"),
    "big endian": changed(b"little", b"big"),
    "header not ascii": changed(b"vertex_indices", "vertëx_indices".encode()),
    "cut short": (TRIANGLE + CORNERS + FACE)[:-1],
    "too long": TRIANGLE + CORNERS + FACE + b"\0",
    "more vertices than bytes": changed(b"vertex 3", b"vertex 99999999"),
    "count of 12 digits": changed(b"vertex 3", b"vertex 999999999999"),
    "count of 40 digits": changed(b"vertex 3", b"vertex " + b"9" * 40),
    "negative count": changed(b"vertex 3", b"vertex -3"),
    "count in other digits": changed(b"vertex 3", "vertex ٣".encode()),
    "vertices twice": changed(b"element face 1", b"element vertex 1"),
    "unknown element": changed(b"element face", b"element edge"),
    "unknown line": changed(b"property float x", b"proprety float x"),
    "property before element": changed(b"element vertex 3\n", b""),
    "no z": changed(b"property float z", b"property float w"),
    "y missing": changed(b"property float y", b"property float x"),
    "x twice": changed(b"property float x\n", b"property float x\nproperty float x\n"),
    "integer positions": changed(b"property float x", b"property int x"),
    "float colours": TRIANGLE.replace(b"float x\n", b"float x\nproperty float red\n") + b"\0" * 48 + FACE,
    "unknown type": changed(b"property float x", b"property quad x"),
    "list at vertices": changed(b"property float x", b"property list uchar int x"),
    "coordinates of four corners": TEXTURED.replace(b"\x06", b"\x08"),
    "coordinates that are no numbers": TEXTURED[:-4] + NAN,
    "coordinates cut short": TEXTURED[:-4],
    "coordinates as bytes": TEXTURED.replace(b"uchar float texcoord", b"uchar uchar texcoord"),
    "coordinates alone": TEXTURED.replace(b"property list uchar int vertex_indices\n", b""),
    "coordinates twice": TEXTURED.replace(COORDINATES, COORDINATES * 2),
    "faces with a second property": changed(b"end_header", b"property int material\nend_header"),
    "float corners": changed(b"uchar int vertex", b"uchar float vertex"),
    "quad": changed(b"\x03\0\0\0\0\x01", b"\x04\0\0\0\0\x01"),
    "corner too large": changed(b"\x02\0\0\0", b"\x03\0\0\0"),
    "corner negative": changed(b"\x02\0\0\0", b"\xff\xff\xff\xff"),
    "not a number": TRIANGLE + NAN + CORNERS[4:] + FACE,
}


@pytest.mark.parametrize("content", LYING.values(), ids=LYING)
def test_a_file_that_lies_is_refused_in_a_sentence(tmp_path: Path, content: bytes) -> None:
    with pytest.raises(ValueError, match=r"^some\.ply [a-z]"):
        read_ply(written(tmp_path, content))


def test_a_huge_count_asks_for_no_memory(tmp_path: Path) -> None:
    import tracemalloc

    path = written(tmp_path, changed(b"vertex 3", b"vertex 99999999"))
    tracemalloc.start()
    with pytest.raises(ValueError, match="damaged"):
        read_ply(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1_000_000


def test_more_than_blender_can_count_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, changed(b"vertex 3", b"vertex 400000000"))
    os.truncate(path, len(TRIANGLE) + 8 + 400_000_000 * 12 + len(FACE))
    with pytest.raises(ValueError, match="too many"):  # before the 5 GB are read, which lie on no disk
        read_ply(path)


def test_only_files_are_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.ply")  # nobody writes: opening it as a file would wait for ever
    with pytest.raises(ValueError, match="not a file"):
        read_ply(tmp_path / "pipe.ply")
    with pytest.raises(OSError, match="directory"):
        read_ply(tmp_path)
    with pytest.raises(OSError, match="No such file"):
        read_ply(tmp_path / "missing.ply")


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_damaged_files_never_do_more_than_raise(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    content = bytearray(TRIANGLE + CORNERS + FACE)
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = written(tmp_path_factory.getbasetemp(), bytes(content))
    try:
        found = read_ply(path)
    except ValueError:
        return
    assert np.isfinite(found.positions).all()
    assert not found.faces.size or (found.faces.min() >= 0 and found.faces.max() < len(found.positions))


def test_a_double_that_is_no_float_is_refused(tmp_path: Path) -> None:
    header = TRIANGLE.replace(b"float z", b"float z\nproperty double support")
    vertex = np.zeros(3, [("p", "<f4", 3), ("support", "<f8")])
    vertex["support"] = 1e300
    with pytest.raises(ValueError, match="support"):
        read_ply(written(tmp_path, header + vertex.tobytes() + FACE))
