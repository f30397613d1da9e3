"""Rendered scenes against facts: exact cameras, a true surface, repeatable bytes, usable photographs."""

import functools
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

bpy = pytest.importorskip("bpy", reason="needs Blender's Python, where `import bpy` works")

from bpy_extras.object_utils import world_to_camera_view  # noqa: E402
from mathutils import Vector  # noqa: E402
from mathutils.bvhtree import BVHTree  # noqa: E402

from addon.view_layout import LayoutKind, Lens, ViewLayout, place_cameras  # noqa: E402
from blender_scenes.render_views import RenderJob, main, own_words, render_views  # noqa: E402
from blender_scenes.rendering import add_camera, set_up_cycles  # noqa: E402
from blender_scenes.scenes import OWN_SURFACE, SCENES, build_from_file, build_scene  # noqa: E402
from blender_scenes.truth import TrueMesh, bounding_sphere, true_mesh, write_ply  # noqa: E402

pytestmark = pytest.mark.blender

SMALL = Lens(width=160, height=120, focal_px=222.0)
JOB = RenderJob(
    scene="monkey",
    surface=OWN_SURFACE,
    turn_deg=0.0,
    layout=ViewLayout(kind=LayoutKind.ARC, num_views=2, arc_deg=40.0),
    lens=SMALL,
    samples=4,
    exposure_stops=0.0,
    seed=0,
    passes=True,
)
SHARED_DATA = Path(__file__).resolve().parents[2] / ".." / "shared" / "data"
EULER_NUMBERS = {
    "monkey": 2,
    "glossy": 2,
    "plaster": 2,
    "thin": -30,
    "genus2": -2,
    "spots": 2,
    "house": 2,
    "table": 4,
}
"""2 - 2 genus for each closed piece. The table bears two; the chair's 49 rods meet in 34 joints: genus 16."""


@pytest.fixture(autouse=True)
def _empty_blender() -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("monkey")
    render_views(JOB, folder)
    return folder


def pixels_srgb(path: Path) -> NDArray[np.float32]:
    """(height, width, 4) stored values over 255, top row first."""
    image = bpy.data.images.load(str(path))
    width, height = image.size
    values = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(values)
    bpy.data.images.remove(image)
    return values.reshape(height, width, 4)[::-1]


def read_ply(path: Path) -> TrueMesh:
    """Reads the layout that `write_ply` states in its header."""
    header, body = path.read_bytes().split(b"end_header\n", 1)
    words = header.decode("ascii").split()
    num_vertices, num_faces = (int(words[words.index(name) + 1]) for name in ("vertex", "face"))
    vertex = np.frombuffer(body, "<f4", num_vertices * 6).reshape(-1, 6).astype(np.float64)
    rows = np.frombuffer(body, [("count", "u1"), ("corners", "<i4", 3)], num_faces, num_vertices * 24)
    assert (rows["count"] == 3).all()
    return TrueMesh(vertices=vertex[:, :3], normals=vertex[:, 3:], faces=rows["corners"])


@functools.cache
def true_surface(name: str) -> TrueMesh:
    """Of a scene's subjects, built once."""
    return true_mesh(build_scene(SCENES[name](name, 0)).subjects)


def diagonal(mesh: TrueMesh) -> float:
    return float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))


def assert_every_edge_is_passed_both_ways(faces: NDArray[np.int32]) -> None:
    """Closed and consistently turned: each directed edge once, and its reverse as well."""
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    unique = np.unique(directed, axis=0)
    assert len(unique) == len(directed)
    np.testing.assert_array_equal(unique, np.unique(directed[:, ::-1], axis=0))


def volume(mesh: TrueMesh) -> float:
    corners = mesh.vertices[mesh.faces]
    return float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6)


def share_of_agreeing_normals(mesh: TrueMesh) -> float:
    """Share of triangles that are counter-clockwise about their corners' normals."""
    corners = mesh.vertices[mesh.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(np.mean(np.einsum("fi,fi->f", across, mesh.normals[mesh.faces].mean(axis=1)) > 0))


def euler_number(mesh: TrueMesh) -> int:
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    return len(mesh.vertices) - len(np.unique(np.sort(edges, axis=1), axis=0)) + len(mesh.faces)


def seen_points(folder: Path, index: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """World points of one depth map, by the pinhole formula of the written cameras alone."""
    cameras = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))
    depth = np.load(folder / "depth" / f"{index:03d}.npy").astype(np.float64)
    hit = np.isfinite(depth)
    rows, columns = np.nonzero(hit)
    x = (columns + 0.5 - cameras["cx"]) / cameras["fl_x"]
    y = (rows + 0.5 - cameras["cy"]) / cameras["fl_y"]
    opengl = np.stack([x, -y, -np.ones_like(x), 1.0 / depth[hit]]) * depth[hit]
    pose = np.array(cameras["frames"][index]["transform_matrix"])
    return (pose @ opengl)[:3].T, hit


@pytest.mark.parametrize("lens", [SMALL, Lens(width=150, height=233, focal_px=301.7)])
def test_cameras_agree_with_blenders_own_projection(lens: Lens) -> None:
    """To 0.01 px, in landscape and in portrait."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.0, 1.0, (30, 3)) + np.array([2.0, -1.0, 0.5])
    camera = add_camera(lens, distance=5.0)
    set_up_cycles(lens, samples=1, exposure_stops=0.0, transparent=True)
    for pose in place_cameras(replace(JOB.layout, num_views=4), lens, points=points):
        camera.matrix_world = pose.T.tolist()
        bpy.context.view_layer.update()
        in_camera = (points - pose[:3, 3]) @ pose[:3, :3]
        column = lens.width / 2 + lens.focal_px * in_camera[:, 0] / -in_camera[:, 2]
        row = lens.height / 2 - lens.focal_px * in_camera[:, 1] / -in_camera[:, 2]
        theirs = [world_to_camera_view(bpy.context.scene, camera, Vector(point)) for point in points]
        np.testing.assert_allclose([v.x * lens.width for v in theirs], column, atol=0.01)
        np.testing.assert_allclose([(1 - v.y) * lens.height for v in theirs], row, atol=0.01)


def test_depth_through_the_written_cameras_lies_on_the_true_mesh(rendered: Path) -> None:
    truth = read_ply(rendered / "truth.ply")
    tree = BVHTree.FromPolygons(truth.vertices.tolist(), truth.faces.tolist())
    for index in range(2):
        points, hit = seen_points(rendered, index)
        assert 0.2 < hit.mean() < 0.8
        errors = [tree.find_nearest(Vector(point))[3] for point in points[::5]]
        assert max(errors) < 1e-5 * diagonal(truth)


def test_normals_are_those_of_the_true_mesh_and_face_the_camera(rendered: Path) -> None:
    truth = read_ply(rendered / "truth.ply")
    tree = BVHTree.FromPolygons(truth.vertices.tolist(), truth.faces.tolist())
    cameras = json.loads((rendered / "transforms.json").read_text(encoding="utf-8"))
    for index in range(2):
        points, hit = seen_points(rendered, index)
        image = np.load(rendered / "normals" / f"{index:03d}.npy")
        assert not image[~hit].any()
        normals = image[hit].astype(np.float64)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
        nearest = np.array([tree.find_nearest(Vector(point))[1] for point in points[::5]])
        assert np.mean(np.einsum("ni,ni->n", nearest, normals[::5]) > 0.999) > 0.99
        position = np.array(cameras["frames"][index]["transform_matrix"])[:3, 3]
        assert (np.einsum("ni,ni->n", normals, position - points) > 0).all()


def test_the_picture_lies_on_the_depth_map(rendered: Path) -> None:
    """What Cycles draws and what the rays hit differ least without a shift, not even by a pixel."""
    for index in range(2):
        drawn = pixels_srgb(rendered / "images" / f"{index:03d}.png")[..., 3] > 0.5
        hit = np.isfinite(np.load(rendered / "depth" / f"{index:03d}.npy"))
        shifts = [(0, 0), (0, 1), (0, -1), (1, 0), (-1, 0)]
        differing = [np.mean(np.roll(hit, shift, axis=(0, 1)) != drawn) for shift in shifts]
        assert differing[0] < 0.005
        assert min(differing[1:]) > 2 * differing[0]


def test_the_same_job_gives_the_same_bytes(rendered: Path, tmp_path: Path) -> None:
    render_views(JOB, tmp_path)
    names = sorted(path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file())
    assert names == sorted(path.relative_to(rendered) for path in rendered.rglob("*") if path.is_file())
    assert len(names) == 3 + 3 * 2
    for name in names:
        assert (tmp_path / name).read_bytes() == (rendered / name).read_bytes(), name


def test_another_seed_gives_other_pictures_of_the_same_shape(rendered: Path, tmp_path: Path) -> None:
    render_views(replace(JOB, seed=1, passes=False), tmp_path)
    assert (tmp_path / "truth.ply").read_bytes() == (rendered / "truth.ply").read_bytes()
    first, other = (pixels_srgb(folder / "images" / "000.png") for folder in (rendered, tmp_path))
    assert np.abs(first - other)[first[..., 3] == 1].mean() > 0.05
    assert not (tmp_path / "depth").exists()


def test_the_description_tells_the_whole_job(rendered: Path) -> None:
    told = json.loads((rendered / "scene.json").read_text(encoding="utf-8"))
    for name, value in asdict(JOB).items():
        assert told[name] == value
    centre, radius = bounding_sphere(read_ply(rendered / "truth.ply"))
    np.testing.assert_allclose(told["bounding_sphere"]["centre_m"], centre, atol=1e-6)
    assert told["bounding_sphere"]["radius_m"] == pytest.approx(radius, rel=1e-6)


def test_pictures_are_well_exposed(rendered: Path) -> None:
    image = pixels_srgb(rendered / "images" / "000.png")
    inside = image[image[..., 3] == 1][:, :3]
    assert np.mean(inside > 0.98) < 0.002
    assert 0.35 < np.median(inside) < 0.75
    assert np.percentile(inside, 95) - np.percentile(inside, 5) > 0.35


def test_a_stop_less_halves_the_light(rendered: Path, tmp_path: Path) -> None:
    render_views(replace(JOB, exposure_stops=-1.0, passes=False), tmp_path)
    linear = []
    for folder in (rendered, tmp_path):
        image = pixels_srgb(folder / "images" / "000.png").astype(np.float64)
        linear.append(((image[image[..., 3] == 1][:, :3] + 0.055) / 1.055) ** 2.4)
    assert np.median(linear[1] / linear[0]) == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("name", SCENES)
def test_every_true_surface_is_closed_and_faces_outwards(name: str) -> None:
    mesh = true_surface(name)
    assert_every_edge_is_passed_both_ways(mesh.faces)
    assert volume(mesh) > 0
    assert share_of_agreeing_normals(mesh) > 0.999


@pytest.mark.parametrize(("name", "expected"), EULER_NUMBERS.items())
def test_shapes_have_the_holes_they_promise(name: str, expected: int) -> None:
    assert euler_number(true_surface(name)) == expected


def test_z_is_up() -> None:
    """The chair stands: it is taller than wide, its feet are at 0, its back rises on the +y side."""
    mesh = true_surface("thin")
    width, _, height = np.ptp(mesh.vertices, axis=0)
    assert height > 1.5 * width
    assert abs(mesh.vertices[:, 2].min()) < 0.03
    assert mesh.vertices[mesh.vertices[:, 2] > 0.6][:, 1].min() > 0.1


def test_the_table_has_surroundings_and_no_mask(tmp_path: Path) -> None:
    render_views(replace(JOB, scene="table", passes=False), tmp_path)
    assert (pixels_srgb(tmp_path / "images" / "000.png")[..., 3] == 1).all()
    subjects, around = (read_ply(tmp_path / f"{name}.ply") for name in ("truth", "surroundings"))
    assert diagonal(around) > 10 * diagonal(subjects)
    # Both subjects stand on the table and neither sink in nor float.
    for side in (-1, 1):
        heights = subjects.vertices[side * subjects.vertices[:, 0] > 0, 2]
        assert heights.min() == pytest.approx(0.0, abs=0.002)


def test_the_plaster_has_no_texture_and_the_monkey_has(rendered: Path, tmp_path: Path) -> None:
    """Colour, which light alone cannot bring."""
    render_views(replace(JOB, scene="plaster", passes=False), tmp_path)

    def colourfulness(folder: Path) -> float:
        image = pixels_srgb(folder / "images" / "000.png")
        inside = image[image[..., 3] == 1]
        return float(np.std(inside[:, 0] - inside[:, 2]))

    assert colourfulness(tmp_path) < 0.03
    assert colourfulness(rendered) > 0.1


TETRAHEDRON = TrueMesh(
    vertices=np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float64),
    normals=np.tile([0.0, 0.0, 1.0], (4, 1)),
    faces=np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32),
)


def in_order(vertices: NDArray[np.float64]) -> NDArray[np.float64]:
    return vertices[np.lexsort(vertices.round(5).T)]


def test_a_written_ply_comes_back_in_the_same_frame(tmp_path: Path) -> None:
    write_ply(tmp_path / "shape.ply", TETRAHEDRON)
    built = build_from_file(tmp_path / "shape.ply", surface_name=OWN_SURFACE, seed=0)
    mesh = true_mesh(built.subjects)
    np.testing.assert_allclose(in_order(mesh.vertices), in_order(TETRAHEDRON.vertices), atol=1e-6)
    assert volume(mesh) == pytest.approx(1.0)


def test_an_inside_out_or_mirrored_mesh_is_turned_outwards(tmp_path: Path) -> None:
    write_ply(tmp_path / "shape.ply", replace(TETRAHEDRON, faces=TETRAHEDRON.faces[:, ::-1]))
    (made,) = build_from_file(tmp_path / "shape.ply", surface_name=OWN_SURFACE, seed=0).subjects
    for scale, expected in ((1.0, 1.0), (-2.0, 2.0)):
        made.scale = (scale, 1.0, 1.0)
        mesh = true_mesh((made,))
        assert volume(mesh) == pytest.approx(expected)
        assert share_of_agreeing_normals(mesh) == 1.0


@pytest.mark.parametrize("scale", [1.0, -1.0])
def test_a_sheet_keeps_its_front_in_a_mirror(tmp_path: Path, scale: float) -> None:
    """It bounds no volume, so only the mirror itself can tell that its corners now run backwards."""
    sheet = TrueMesh(
        vertices=np.array([[0.1, 0.2, 0.7], [1.3, 0.4, 0.7], [0.3, 1.9, 0.7]]),
        normals=np.tile([0.0, 0.0, -1.0], (3, 1)),
        faces=np.array([[0, 1, 2]], np.int32),
    )
    write_ply(tmp_path / "sheet.ply", sheet)
    (made,) = build_from_file(tmp_path / "sheet.ply", surface_name=OWN_SURFACE, seed=0).subjects
    made.scale = (scale, 1.0, 1.0)
    mesh = true_mesh((made,))
    assert share_of_agreeing_normals(mesh) == 1.0
    np.testing.assert_allclose(mesh.normals, np.tile([0.0, 0.0, 1.0], (3, 1)), atol=1e-6)


def test_an_obj_is_stood_up(tmp_path: Path) -> None:
    """OBJ files are y-up: their (x, y, z) is (x, -z, y) here."""
    lines = [f"v {x} {y} {z}" for x, y, z in TETRAHEDRON.vertices]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in TETRAHEDRON.faces]
    (tmp_path / "shape.obj").write_text("\n".join(lines) + "\n", encoding="ascii")
    mesh = true_mesh(build_from_file(tmp_path / "shape.obj", surface_name="fine", seed=0).subjects)
    expected = TETRAHEDRON.vertices[:, [0, 2, 1]] * (1, -1, 1)
    np.testing.assert_allclose(in_order(mesh.vertices), in_order(expected), atol=1e-6)


def test_a_model_can_be_turned_to_the_light(tmp_path: Path) -> None:
    write_ply(tmp_path / "shape.ply", TETRAHEDRON)
    built = build_from_file(tmp_path / "shape.ply", turn_deg=90.0, surface_name=OWN_SURFACE, seed=0)
    expected = TETRAHEDRON.vertices[:, [1, 0, 2]] * (-1, 1, 1)
    np.testing.assert_allclose(in_order(true_mesh(built.subjects).vertices), in_order(expected), atol=1e-6)


def test_normals_survive_an_uneven_scale() -> None:
    """A stretched sphere's normals: the gradient of its equation."""
    made = build_scene(SCENES["monkey"]("monkey", 0)).subjects[0]
    made.modifiers.clear()
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=5)
    made.data = bpy.context.object.data
    made.scale = (1.0, 1.0, 3.0)
    mesh = true_mesh((made,))
    expected = mesh.vertices / (1.0, 1.0, 9.0)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert np.einsum("ni,ni->n", expected, mesh.normals).min() > 0.999


@pytest.mark.skipif(not (SHARED_DATA / "mesh_spot").is_dir(), reason="../shared/data/mesh_spot is not here")
def test_a_mesh_file_keeps_its_own_texture_or_takes_another(tmp_path: Path) -> None:
    spot = replace(JOB, scene=f"mesh:{SHARED_DATA / 'mesh_spot' / 'spot.obj'}", passes=False)
    pictures = {}
    for surface in (OWN_SURFACE, "plain"):
        render_views(replace(spot, surface=surface), tmp_path / surface)
        image = pixels_srgb(tmp_path / surface / "images" / "000.png")
        pictures[surface] = image[image[..., 3] == 1][:, :3]
    assert np.percentile(pictures[OWN_SURFACE], 5) < 0.3 < np.percentile(pictures["plain"], 5)
    told = json.loads((tmp_path / "plain" / "scene.json").read_text(encoding="utf-8"))
    assert told["scene"] == "mesh:spot.obj"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--scene", "teapot"], "unknown scene"),
        (["--scene", "mesh:nowhere.obj"], "no mesh file"),
        (["--scene", "monkey", "--views", "0"], "num_views"),
        (["--scene", "monkey", "--samples", "0"], "must be positive"),
        (["--scene", f"mesh:{__file__}"], "none of the mesh files"),
    ],
)
def test_wrong_arguments_end_with_a_sentence(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*words, "--output", str(tmp_path / "out")])
    assert ended.value.code == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_file_without_a_mesh_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty.obj").write_text("# nothing\n", encoding="ascii")
    with pytest.raises(ValueError, match="holds no mesh"):
        build_from_file(tmp_path / "empty.obj", surface_name=OWN_SURFACE, seed=0)


@pytest.mark.parametrize(
    ("command_line", "expected"),
    [
        (["render_views.py", "--views", "3"], ["--views", "3"]),
        (["blender", "-b", "--python", "render_views.py", "--", "--views", "3"], ["--views", "3"]),
        (["blender", "-b", "--"], []),
    ],
)
def test_arguments_meant_for_blender_are_left_to_it(command_line: Any, expected: list[str]) -> None:
    assert own_words(command_line) == expected
