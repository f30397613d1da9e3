"""Files of meshes and points: exact round trips, and what an independent reader sees."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from backend.mesh_files import (
    MeshFileError,
    png_of,
    read_mesh,
    read_sparse,
    write_glb,
    write_mesh,
    write_points,
    write_sparse,
)
from backend.scene import Region, SurfaceMesh, SurfacePoints, Texture


def random_mesh(seed: int = 0, offset: float = 0.0) -> SurfaceMesh:
    """An icosphere with random attributes at each vertex."""
    random = np.random.default_rng(seed)
    sphere = trimesh.creation.icosphere(subdivisions=1)
    return SurfaceMesh(
        vertices=np.asarray(sphere.vertices, np.float64) + offset,
        faces=np.asarray(sphere.faces, np.int64),
        normals=np.asarray(sphere.vertices, np.float32),
        colours_srgb=random.integers(0, 256, (len(sphere.vertices), 3), np.uint8),
        support=random.random(len(sphere.vertices), np.float32),
    )


def textured_mesh(seed: int = 0) -> SurfaceMesh:
    """The same, each face with a place of its own in a random picture."""
    mesh, random = random_mesh(seed), np.random.default_rng(seed)
    places = random.uniform(0, [40, 30], (len(mesh.faces), 3, 2)).astype(np.float32)
    picture = random.integers(0, 256, (30, 40, 3), np.uint8)
    return replace(mesh, texture=Texture(image_srgb=picture, corners_px=places))


def write_both(folder: Path, mesh: SurfaceMesh) -> Path:
    assert mesh.texture is not None
    write_mesh(folder / "mesh.ply", mesh)
    (folder / "texture.png").write_bytes(png_of(mesh.texture))
    return folder / "mesh.ply"


def assert_same(found: SurfaceMesh, expected: SurfaceMesh) -> None:
    for name in ("vertices", "faces", "normals", "colours_srgb", "support"):
        ours, theirs = getattr(found, name), getattr(expected, name)
        assert ours.dtype == theirs.dtype
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("offset", [0.0, 5e6])
def test_a_mesh_comes_back_to_the_bit(tmp_path: Path, offset: float) -> None:
    mesh = random_mesh(offset=offset)
    write_mesh(tmp_path / "mesh.ply", mesh)
    assert_same(read_mesh(tmp_path / "mesh.ply"), mesh)


def test_a_texture_comes_back(tmp_path: Path) -> None:
    mesh = textured_mesh()
    found = read_mesh(write_both(tmp_path, mesh))
    assert_same(found, mesh)
    assert found.texture is not None
    assert mesh.texture is not None
    np.testing.assert_array_equal(found.texture.image_srgb, mesh.texture.image_srgb)
    np.testing.assert_allclose(found.texture.corners_px, mesh.texture.corners_px, atol=1e-4)


@pytest.mark.parametrize("content", [None, b"", b"no picture"])
def test_a_mesh_whose_texture_is_gone_or_damaged_is_refused(tmp_path: Path, content: bytes | None) -> None:
    path = write_both(tmp_path, textured_mesh())
    (tmp_path / "texture.png").unlink()
    if content is not None:
        (tmp_path / "texture.png").write_bytes(content)
    with pytest.raises(MeshFileError, match=r"texture\.png is not beside the mesh"):
        read_mesh(path)


def test_another_reader_sees_the_same_texture(tmp_path: Path) -> None:
    mesh = textured_mesh()
    found = trimesh.load_mesh(write_both(tmp_path, mesh), process=False, fix_texture=True)
    assert mesh.texture is not None
    u, v = np.asarray(found.visual.uv)[found.faces].transpose(2, 0, 1)
    np.testing.assert_allclose(np.stack([40 * u, 30 - 30 * v], axis=-1), mesh.texture.corners_px, atol=1e-4)
    np.testing.assert_allclose(found.vertices[found.faces], mesh.vertices[mesh.faces])
    np.testing.assert_array_equal(
        np.asarray(found.visual.material.image.convert("RGB")), mesh.texture.image_srgb
    )


def test_glb_holds_the_texture_in_place_of_colours(tmp_path: Path) -> None:
    mesh = textured_mesh()
    write_glb(tmp_path / "mesh.glb", mesh)
    assert mesh.texture is not None
    (found,) = trimesh.load_scene(tmp_path / "mesh.glb", process=False).geometry.values()
    x, y, z = mesh.vertices[mesh.faces].transpose(2, 0, 1)
    np.testing.assert_allclose(found.vertices[found.faces], np.stack([x, z, -y], axis=-1), atol=1e-6)
    u, v = np.asarray(found.visual.uv)[found.faces].transpose(2, 0, 1)
    np.testing.assert_allclose(np.stack([40 * u, 30 - 30 * v], axis=-1), mesh.texture.corners_px, atol=1e-4)
    image = found.visual.material.baseColorTexture
    np.testing.assert_array_equal(np.asarray(image.convert("RGB")), mesh.texture.image_srgb)
    assert "color" not in found.visual.vertex_attributes  # viewers multiply both
    np.testing.assert_allclose(
        found.vertex_attributes["_SUPPORT"].ravel()[found.faces], mesh.support[mesh.faces]
    )


def test_glb_has_two_vertices_in_place_of_one_only_where_charts_meet(tmp_path: Path) -> None:
    mesh = random_mesh()
    corners = mesh.vertices[mesh.faces][..., :2].astype(np.float32)
    corners[mesh.faces.min(axis=1) == 0] += 5  # the faces around the first vertex are a chart of their own
    picture = np.zeros((4, 4, 3), np.uint8)
    write_glb(tmp_path / "mesh.glb", replace(mesh, texture=Texture(image_srgb=picture, corners_px=corners)))
    (found,) = trimesh.load_scene(tmp_path / "mesh.glb", process=False).geometry.values()
    around = (mesh.faces == 0).any(axis=1).sum()
    assert len(found.vertices) == len(mesh.vertices) + around


def test_an_empty_mesh_comes_back(tmp_path: Path) -> None:
    full = random_mesh()
    names = ("vertices", "faces", "normals", "colours_srgb", "support")
    empty = replace(full, **{name: getattr(full, name)[:0] for name in names})
    write_mesh(tmp_path / "mesh.ply", empty)
    assert_same(read_mesh(tmp_path / "mesh.ply"), empty)


def test_another_reader_sees_the_same_mesh(tmp_path: Path) -> None:
    mesh = random_mesh()
    write_mesh(tmp_path / "mesh.ply", mesh)
    found = trimesh.load_mesh(tmp_path / "mesh.ply", process=False)
    np.testing.assert_array_equal(found.vertices, mesh.vertices)
    np.testing.assert_array_equal(found.faces, mesh.faces)
    np.testing.assert_array_equal(found.visual.vertex_colors[:, :3], mesh.colours_srgb)
    np.testing.assert_array_equal(
        found.metadata["_ply_raw"]["vertex"]["data"]["support"].ravel(), mesh.support
    )
    assert found.is_watertight
    assert found.volume > 0


def test_the_header_names_every_property_and_its_size(tmp_path: Path) -> None:
    write_mesh(tmp_path / "mesh.ply", random_mesh())
    header = (tmp_path / "mesh.ply").read_bytes().partition(b"end_header")[0].decode("ascii").split("\n")
    assert header[:2] == ["ply", "format binary_little_endian 1.0"]
    assert [line.removeprefix("property ") for line in header if line.startswith("property")] == [
        *("double x", "double y", "double z", "float nx", "float ny", "float nz"),
        *("uchar red", "uchar green", "uchar blue", "float support"),
        "list uchar int vertex_indices",
    ]


@pytest.mark.parametrize("count", [0, 7])
def test_sparse_points_have_positions_colours_and_who_sees_them(tmp_path: Path, count: int) -> None:
    random = np.random.default_rng(0)
    positions, colours = random.normal(size=(count, 3)) + 5e6, random.integers(0, 256, (count, 3), np.uint8)
    visibility = random.random((count, 11)) < 0.5
    what = {"positions": positions, "colours_srgb": colours, "visibility": visibility}
    write_sparse(tmp_path / "sparse.ply", **what)
    header, _, body = (tmp_path / "sparse.ply").read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert lines[3:] == [
        f"element vertex {count}",
        *(f"property double {axis}" for axis in "xyz"),
        *(f"property uchar {name}" for name in ("red", "green", "blue", "seen_0", "seen_1")),
    ]
    rows = np.frombuffer(body, np.dtype([("xyz", "<f8", 3), ("rgb", "u1", 3), ("seen", "<u2")]))
    np.testing.assert_array_equal(rows["xyz"], positions)
    np.testing.assert_array_equal(rows["rgb"], colours)
    np.testing.assert_array_equal(rows["seen"][:, None] >> np.arange(11) & 1, visibility)
    read_positions, read_visibility = read_sparse(tmp_path / "sparse.ply", num_photos=11)
    np.testing.assert_array_equal(read_positions, positions)
    np.testing.assert_array_equal(read_visibility, visibility)


def test_sparse_points_of_other_cameras_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "sparse.ply"
    points = {"positions": np.ones((3, 3)), "colours_srgb": np.zeros((3, 3), np.uint8)}
    write_sparse(path, **points, visibility=np.ones((3, 4), bool))
    whole = path.read_bytes()
    with pytest.raises(MeshFileError, match="20 cameras"):
        read_sparse(path, num_photos=20)
    for content in (whole[:-1], whole + b"0", whole.replace(b"vertex 3", b"vertex 2"), b"", b"end_header\n"):
        path.write_bytes(content)
        with pytest.raises(MeshFileError):
            read_sparse(path, num_photos=4)
    write_sparse(path, **points | {"positions": np.full((3, 3), np.nan)}, visibility=np.ones((3, 4), bool))
    with pytest.raises(MeshFileError, match="not finite"):
        read_sparse(path, num_photos=4)


def test_a_picture_that_is_made_already_is_not_made_again(tmp_path: Path) -> None:
    mesh = textured_mesh()
    assert mesh.texture is not None
    write_glb(tmp_path / "made.glb", mesh)
    write_glb(tmp_path / "given.glb", mesh, png_of(mesh.texture))
    assert (tmp_path / "made.glb").read_bytes() == (tmp_path / "given.glb").read_bytes()
    write_glb(tmp_path / "other.glb", mesh, b"a picture of others")
    assert b"a picture of others" in (tmp_path / "other.glb").read_bytes()


def test_the_same_mesh_gives_the_same_bytes(tmp_path: Path) -> None:
    for index in range(2):
        write_mesh(tmp_path / f"{index}.ply", random_mesh())
        write_glb(tmp_path / f"{index}.glb", textured_mesh())
    for kind in ("ply", "glb"):
        assert (tmp_path / f"0.{kind}").read_bytes() == (tmp_path / f"1.{kind}").read_bytes()


@pytest.mark.parametrize(
    "damage", [lambda data: data[:-1], lambda data: data[100:], lambda data: data + b"x"]
)
def test_a_damaged_file_is_refused(tmp_path: Path, damage) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "mesh.ply"
    write_mesh(path, random_mesh())
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(MeshFileError):
        read_mesh(path)


def test_other_properties_of_the_same_size_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    write_mesh(path, random_mesh())
    path.write_bytes(path.read_bytes().replace(b"float support", b"float quality"))
    with pytest.raises(MeshFileError):
        read_mesh(path)


def test_glb_turns_z_up_into_y_up_and_keeps_handedness(tmp_path: Path) -> None:
    mesh = random_mesh(offset=2.0)
    write_glb(tmp_path / "mesh.glb", mesh)
    found = trimesh.load_scene(tmp_path / "mesh.glb").to_mesh()
    x, y, z = mesh.vertices.T
    np.testing.assert_allclose(found.vertices, np.stack([x, z, -y], axis=-1), rtol=1e-6)
    np.testing.assert_array_equal(found.faces, mesh.faces)
    assert found.volume == pytest.approx(trimesh.Trimesh(mesh.vertices, mesh.faces).volume, rel=1e-5)


def test_glb_colours_are_linear_light(tmp_path: Path) -> None:
    mesh = random_mesh()
    greys = np.array([[0, 0, 0], [5, 5, 5], [128, 128, 128], [255, 255, 255]], np.uint8)
    mesh = replace(mesh, colours_srgb=np.resize(greys, mesh.colours_srgb.shape))
    write_glb(tmp_path / "mesh.glb", mesh)
    scene = trimesh.load_scene(tmp_path / "mesh.glb", process=False)
    (found,) = scene.geometry.values()
    colours = np.asarray(found.visual.vertex_attributes["color"], np.float64)[:4, 0]
    np.testing.assert_allclose(colours / 65535, [0.0, 5 / 255 / 12.92, 0.2158605, 1.0], atol=1e-5)


def test_points_leave_in_the_world_frame(tmp_path: Path) -> None:
    object_from_world = np.diag([0.5, 0.5, 0.5, 1.0])
    object_from_world[:3, :3] = object_from_world[:3, :3] @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    object_from_world[:3, 3] = [1, 2, 3]
    world = np.array([[1.0, 2.0, 3.0], [-4.0, 5.0, 6.0]])
    normals_world = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
    positions = world @ object_from_world[:3, :3].T + object_from_world[:3, 3]
    points = SurfacePoints(
        positions=positions.astype(np.float32),
        normals=(normals_world @ object_from_world[:3, :3].T * 2).astype(np.float32),
        colours_srgb=np.array([[0.0, 0.5, 1.0], [1.0, 1.0, 0.0]], np.float32),
        confidence=np.array([0.25, 1.0], np.float32),
        num_views=np.array([2, 3]),
        view_index=np.array([0, 1]),
    )
    write_points(tmp_path / "points.ply", points, Region(object_from_world=object_from_world))
    cloud = trimesh.load(tmp_path / "points.ply")
    raw = cloud.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_allclose(cloud.vertices, world, atol=1e-6)
    np.testing.assert_allclose(
        np.stack([raw[n].ravel() for n in ("nx", "ny", "nz")], -1), normals_world, atol=1e-6
    )
    np.testing.assert_array_equal(cloud.colors[:, :3], [[0, 128, 255], [255, 255, 0]])
    np.testing.assert_array_equal(raw["confidence"].ravel(), points.confidence)
