"""A result on disk becomes a mesh of the scene: in its place, in its colours, as one undo step."""

import importlib
import os
import shutil
import struct
import sys
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="needs Blender's Python, where `import bpy` works")

pytestmark = [pytest.mark.blender, pytest.mark.usefixtures("addon")]

VERTEX = np.dtype(
    [(n, "<f8") for n in ("x", "y", "z")]
    + [(n, "<f4") for n in ("nx", "ny", "nz")]
    + [(n, "u1") for n in ("red", "green", "blue")]
    + [("support", "<f4")]
)
FACE = np.dtype([("num", "u1"), ("corners", "<i4", 3)])
TYPES = {"<f8": "double", "<f4": "float", "|u1": "uchar"}


@pytest.fixture
def parts(addon: ModuleType) -> SimpleNamespace:
    """The add-on's modules under their names."""
    names = ("colours", "mesh_import", "mesh_arrays", "heat_map", "ply", "error_map", "result_import")
    names = (*names, "result_mesh", "jobs", "operators.result_files")
    found = {n.rpartition(".")[2]: importlib.import_module(f"{addon.__name__}.{n}") for n in names}
    return SimpleNamespace(**found)


def sphere(subdivisions: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of an ico sphere of radius 1."""
    mesh = bpy.data.meshes.new("source")
    import bmesh

    made = bmesh.new()
    bmesh.ops.create_icosphere(made, subdivisions=subdivisions, radius=1.0)
    made.to_mesh(mesh)
    made.free()
    vertices = np.array([v.co[:] for v in mesh.vertices], np.float64)
    faces = np.array([p.vertices[:] for p in mesh.polygons], np.int32)
    bpy.data.meshes.remove(mesh)
    return vertices, faces


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray | None, **changed: np.ndarray) -> None:
    """A file in the backend's dialect; x tells red, y green, z support."""
    table = np.zeros(len(vertices), VERTEX)
    table["x"], table["y"], table["z"] = vertices.T
    unit = (vertices - vertices.min(axis=0)) / np.ptp(vertices, axis=0)
    table["red"], table["green"], table["blue"] = np.round(unit[:, 0] * 255), np.round(unit[:, 1] * 255), 40
    table["support"] = unit[:, 2]
    for name, values in changed.items():
        table[name] = values
    lines = ["ply", "format binary_little_endian 1.0", "comment FewView", f"element vertex {len(table)}"]
    lines += [f"property {TYPES[VERTEX[name].str]} {name}" for name in VERTEX.names]
    records = np.zeros(0 if faces is None else len(faces), FACE)
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        records["num"], records["corners"] = 3, faces
    header = "\n".join([*lines, "end_header\n"]).encode()
    path.write_bytes(header + table.tobytes() + records.tobytes())


def camera_frame(index: int) -> str:
    angle = (index - 1) * 0.4
    cosine, sine = np.cos(angle), np.sin(angle)
    # Level cameras around y, which is up in this solved frame; they look at the origin.
    rows = [[cosine, 0, sine, 5 * sine], [0, 1, 0, 0], [-sine, 0, cosine, 5 * cosine], [0, 0, 0, 1]]
    return (
        f'{{"file_path": "{index}.png", "w": 64, "h": 48, "fl_x": 80, "fl_y": 80, "cx": 32, "cy": 24,'
        f'"transform_matrix": {[[float(v) for v in row] for row in rows]}}}'
    )


def write_cameras(path: Path, *, estimated: bool) -> None:
    frames = ", ".join(camera_frame(index) for index in range(3))
    path.write_text(
        f'{{"camera_model": "PINHOLE", "frames": [{frames}], "fewview": {{"estimated": '
        f'{"true" if estimated else "false"}, "reprojection_error_px": null, "unplaced": [],'
        f'"region": {{"centre_world": [0, 0, 0], "radius_world": 2.0}}}}}}'
    )


JobMaker = Callable[..., Path]


@pytest.fixture
def make_job(tmp_path: Path, addon: ModuleType) -> JobMaker:
    """Writes the folder of a job that has ended."""
    protocol = importlib.import_module(f"{addon.__name__.rsplit('.', 1)[0]}.backend.wire.protocol")
    job_folder = importlib.import_module(f"{addon.__name__}.job_folder")

    def make(name: str = "reconstruct-001", *, estimated: bool | None = None, subdivisions: int = 4) -> Path:
        folder = tmp_path / "jobs" / name
        (folder / "result").mkdir(parents=True)
        job = protocol.Job(protocol=protocol.PROTOCOL_VERSION, images=("images",), output="result")
        job_folder.write_job(folder, job)
        write_ply(folder / "result/mesh.ply", *sphere(subdivisions))
        (folder / "result/report.html").write_text("<p>A report</p>")
        if estimated is not None:
            write_cameras(folder / "result/cameras.json", estimated=estimated)
        return folder

    return make


def positions(made: object) -> np.ndarray:
    """World positions of a mesh object's vertices."""
    flat = np.empty(3 * len(made.data.vertices), np.float32)
    made.data.vertices.foreach_get("co", flat)
    world = np.array(made.matrix_world)
    return flat.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3]


def byte_colours(mesh: object, name: str) -> np.ndarray:
    attribute = mesh.color_attributes[name]
    flat = np.empty(4 * len(attribute.data), np.float32)
    attribute.data.foreach_get("color_srgb", flat)
    return np.round(flat.reshape(-1, 4) * 255).astype(np.uint8)


# The import


def test_the_result_arrives(make_job: JobMaker) -> None:
    folder = make_job()
    assert bpy.ops.fewview.import_result(folder=str(folder)) == {"FINISHED"}
    result = bpy.context.scene.fewview.result
    vertices, faces = sphere()
    np.testing.assert_allclose(positions(result), vertices, atol=1e-6)
    np.testing.assert_array_equal([p.vertices[:] for p in result.data.polygons], faces)
    np.testing.assert_allclose(np.array(result.matrix_world), np.eye(4))
    assert result["fewview_job"] == str(folder)
    assert bpy.context.view_layer.objects.active == result
    assert bpy.context.selected_objects == [result]
    assert all(p.use_smooth for p in result.data.polygons)
    assert len(result.data.edges) == len(faces) * 3 // 2
    support = [v.value for v in result.data.attributes["support"].data]
    np.testing.assert_allclose(support, (vertices[:, 2] + 1) / 2, atol=1e-6)
    assert result.data.validate(verbose=True) is False


def test_colours_keep_their_eight_bits(make_job: JobMaker) -> None:
    folder = make_job()
    vertices, faces = sphere()
    reds = np.arange(len(vertices)) % 256
    write_ply(folder / "result/mesh.ply", vertices, faces, red=reds)
    bpy.ops.fewview.import_result(folder=str(folder))
    found = byte_colours(bpy.context.scene.fewview.result.data, "Color")
    np.testing.assert_array_equal(found[:, 0], reds)
    assert (found[:, 3] == 255).all()


def test_the_newest_job_is_the_default(make_job: JobMaker, tmp_path: Path) -> None:
    import os

    old, new = make_job("reconstruct-002"), make_job("reconstruct-001")
    os.utime(old / "result/mesh.ply", (1, 1))
    bpy.context.scene.fewview.output = str(tmp_path / "jobs")
    bpy.ops.fewview.import_result()
    assert bpy.context.scene.fewview.result["fewview_job"] == str(new)


def test_one_undo_step(make_job: JobMaker) -> None:
    folder = make_job(estimated=False)
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.fewview.import_result(folder=str(folder))
    bpy.ops.ed.undo_push(message="import")  # as the window does after an operator with UNDO
    assert len(bpy.data.meshes) == 1
    bpy.ops.ed.undo()
    assert not bpy.data.objects
    bpy.ops.ed.redo()
    assert bpy.context.scene.fewview.result is not None
    assert len(bpy.data.cameras) == 3


def test_estimated_results_stand_upright_and_follow_their_root(make_job: JobMaker) -> None:
    bpy.ops.fewview.import_result(folder=str(make_job(estimated=True)))
    bpy.context.view_layer.update()
    result, root = bpy.context.scene.fewview.result, bpy.context.scene.fewview.root
    np.testing.assert_allclose(np.array(result.matrix_world), np.eye(4), atol=1e-6)
    found = positions(result)
    # Solved: y up, seen from +z, a region of radius 2. In Blender: z up, seen from -y, of radius 1.
    vertices, _ = sphere()
    expected = np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], axis=1) / 2 + [0, 0, 1]
    np.testing.assert_allclose(found, expected, atol=1e-5)
    root.location.x += 3
    bpy.context.view_layer.update()
    np.testing.assert_allclose(positions(result), expected + np.array([3, 0, 0]), atol=1e-5)


def test_without_cameras_it_stands_at_the_same_place(make_job: JobMaker) -> None:
    bpy.ops.fewview.import_result(folder=str(make_job(estimated=True)), cameras=False)
    assert not bpy.data.cameras
    assert positions(bpy.context.scene.fewview.result)[:, 2].min() == pytest.approx(0.5, abs=1e-5)


def test_it_stands_where_the_root_was_moved_to(make_job: JobMaker) -> None:
    folder = make_job(estimated=True)
    bpy.ops.fewview.import_result(folder=str(folder))
    bpy.context.scene.fewview.root.location.z += 5
    bpy.context.view_layer.update()
    bpy.ops.fewview.import_result(folder=str(folder))
    assert positions(bpy.context.scene.fewview.result)[:, 2].min() == pytest.approx(5.5, abs=1e-5)


DAMAGES = {
    "nothing": b"",
    "text": b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n",
    "no faces": b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\n"
    b"property float y\nproperty float z\nend_header\n" + struct.pack("<3f", 0, 0, 0),
    "far away": b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty double x\n"
    b"property double y\nproperty double z\nelement face 1\nproperty list uchar int vertex_indices\n"
    b"end_header\n" + struct.pack("<9d", *[1e300] * 9) + b"\3" + struct.pack("<3i", 0, 1, 2),
}


@pytest.mark.parametrize("content", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_mesh_changes_nothing(make_job: JobMaker, content: bytes) -> None:
    folder = make_job()
    (folder / "result/mesh.ply").write_bytes(content)
    with pytest.raises(RuntimeError, match="Error"):
        bpy.ops.fewview.import_result(folder=str(folder))
    assert not bpy.data.objects
    assert not bpy.data.meshes


def test_folders_that_are_no_jobs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match=r"it has no job\.json$"):
        bpy.ops.fewview.import_result(folder=str(tmp_path))
    (tmp_path / "mesh.ply").write_bytes(b"")
    with pytest.raises(RuntimeError, match=r"it has no job\.json$"):  # any mesh may be called so
        bpy.ops.fewview.import_result(folder=str(tmp_path))
    bpy.context.scene.fewview.output = str(tmp_path)
    with pytest.raises(RuntimeError, match="no finished job"):
        bpy.ops.fewview.import_result()


def test_a_result_from_anywhere_is_chosen_in_the_file_browser(
    make_job: JobMaker, parts: SimpleNamespace, tmp_path: Path
) -> None:
    job, other = make_job("reconstruct-001"), make_job("reconstruct-002")
    module = importlib.import_module(f"{parts.jobs.__package__}.operators.result")
    operator = module.FEWVIEW_OT_import_result
    bpy.context.scene.fewview.output = str(tmp_path / "jobs")
    opened: list[object] = []
    context = SimpleNamespace(
        scene=bpy.context.scene,
        preferences=bpy.context.preferences,
        window_manager=SimpleNamespace(fileselect_add=opened.append),
    )
    executed = {"FINISHED"}
    pressed = SimpleNamespace(folder=str(job), directory="", execute=lambda _: executed)
    assert operator.invoke(pressed, context, None) == executed  # a past job's button
    assert not opened
    pressed.folder = ""
    assert operator.invoke(pressed, context, None) == {"RUNNING_MODAL"}
    assert opened == [pressed]
    assert Path(pressed.directory) == tmp_path / "jobs"

    assert bpy.ops.fewview.import_result(directory=f"{job}/") == {"FINISHED"}  # as the browser has it
    assert bpy.context.scene.fewview.result["fewview_job"] == str(job)
    assert bpy.ops.fewview.import_result(folder=str(other), directory=f"{job}/") == {"FINISHED"}
    assert bpy.context.scene.fewview.result["fewview_job"] == str(other)
    rna = bpy.ops.fewview.import_result.get_rna_type().properties
    assert rna["directory"].is_hidden
    assert rna["folder"].is_hidden  # in the browser the two would contradict each other


def test_faces_that_blender_cannot_bear_are_left_out(make_job: JobMaker) -> None:
    folder = make_job()
    vertices, faces = sphere()
    bad = np.array([[0, 0, 1], [5, 5, 5], faces[3], faces[3][[1, 2, 0]], faces[4][::-1]], np.int32)
    write_ply(folder / "result/mesh.ply", vertices, np.concatenate([bad[:2], faces, bad[2:]]))
    bpy.ops.fewview.import_result(folder=str(folder))
    mesh = bpy.context.scene.fewview.result.data
    assert len(mesh.polygons) == len(faces)
    assert mesh.validate(verbose=True) is False


def test_our_edges_are_those_that_blender_finds(parts: SimpleNamespace) -> None:
    _, faces = sphere(2)
    edges, corner_edges = parts.mesh_arrays.edges_of(faces, faces.max() + 1)
    mesh = bpy.data.meshes.new("plain")
    mesh.from_pydata(np.zeros((faces.max() + 1, 3)).tolist(), [], faces.tolist())
    assert {tuple(e) for e in edges.tolist()} == {tuple(sorted(e.vertices)) for e in mesh.edges}
    ends = np.stack([faces.ravel(), np.roll(faces, -1, axis=1).ravel()], axis=1)
    np.testing.assert_array_equal(np.sort(edges[corner_edges], axis=1), np.sort(ends, axis=1))


@pytest.mark.parametrize("at", range(6))
def test_undo_between_two_steps_begins_again(make_job: JobMaker, parts: SimpleNamespace, at: int) -> None:
    folder = make_job()
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.ed.undo_push(message="something of the user's")
    num_steps_with_mesh = num_undone = 0
    for _ in parts.result_import.import_result_steps(folder, scene_name=bpy.context.scene.name):
        if bpy.data.meshes:
            num_steps_with_mesh += 1
        if bpy.data.meshes and num_steps_with_mesh > at and not num_undone:
            bpy.ops.ed.undo()
            num_undone += 1
            assert not bpy.data.meshes
    assert num_undone == (at < 4)  # while the mesh is made there are so many steps
    result = bpy.context.scene.fewview.result
    np.testing.assert_allclose(positions(result), sphere()[0], atol=1e-6)
    assert result.data.validate(verbose=True) is False


def test_a_mode_that_the_user_is_in_is_left_alone(make_job: JobMaker, parts: SimpleNamespace) -> None:
    bpy.ops.mesh.primitive_cube_add()
    cube = bpy.context.object
    bpy.ops.object.mode_set(mode="EDIT")
    for _ in parts.result_import.import_result_steps(make_job(), scene_name=bpy.context.scene.name):
        pass
    assert bpy.context.mode == "EDIT_MESH"
    assert bpy.context.object == cube
    bpy.ops.object.mode_set(mode="OBJECT")
    assert len(cube.data.vertices) == 8
    assert len(bpy.context.scene.fewview.result.data.polygons) > 1000


def test_no_step_is_long(make_job: JobMaker, parts: SimpleNamespace) -> None:
    """The limit is generous for busy machines; measured here are 10 ms for 300,000 triangles.

    Of three imports the best counts: now and then another program has the core for a tenth of a second.
    """
    folder = make_job(subdivisions=8)

    def longest() -> float:
        slowest, started = 0.0, time.perf_counter()
        for _ in parts.result_import.import_result_steps(folder, scene_name=bpy.context.scene.name):
            slowest = max(slowest, time.perf_counter() - started)
            started = time.perf_counter()
        return slowest

    assert min(longest() for _ in range(3)) < 0.1
    assert len(bpy.context.scene.fewview.result.data.polygons) == 327_680


# The preview


def test_previews_replace_each_other_in_place(tmp_path: Path, parts: SimpleNamespace) -> None:
    scene = bpy.context.scene
    vertices, faces = sphere(2)
    write_ply(tmp_path / "points.ply", vertices, None)
    write_ply(tmp_path / "mesh.ply", vertices, faces)
    wanted = parts.mesh_import.MeshImport(
        job="job", scene_name=scene.name, world_from_solved=np.diag([2.0, 2.0, 2.0, 1.0])
    )
    for name, num_faces in (("points", 0), ("mesh", len(faces)), ("points", 0)):
        for _ in parts.mesh_import.show_preview(tmp_path / f"{name}.ply", wanted):
            pass
        (preview,) = scene.objects
        assert len(bpy.data.meshes) == 1
        assert len(preview.data.polygons) == num_faces
        np.testing.assert_allclose(positions(preview), 2 * vertices, atol=1e-6)
    assert not preview.select_get()
    parts.mesh_import.remove_preview()
    assert not bpy.data.objects
    assert not bpy.data.meshes


def test_the_result_takes_the_preview_away(
    tmp_path: Path, make_job: JobMaker, parts: SimpleNamespace
) -> None:
    scene = bpy.context.scene
    write_ply(tmp_path / "points.ply", sphere(1)[0], None)
    wanted = parts.mesh_import.MeshImport(job="job", scene_name=scene.name, world_from_solved=np.eye(4))
    for _ in parts.mesh_import.show_preview(tmp_path / "points.ply", wanted):
        pass
    bpy.ops.fewview.import_result(folder=str(make_job()))
    assert scene.objects.values() == [scene.fewview.result]


# Colours


@pytest.fixture
def result(make_job: JobMaker) -> object:
    bpy.ops.fewview.import_result(folder=str(make_job()))
    return bpy.context.scene.fewview.result


def render(tmp_path: Path, engine: str, color_type: str = "VERTEX") -> np.ndarray:
    """(64, 64, 4) float, sRGB: the object from the front, lit by a white world where it takes light."""
    scene = bpy.context.scene
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.type, camera.data.ortho_scale = "ORTHO", 2.5
    camera.location, camera.rotation_euler = (0, -5, 0), (np.pi / 2, 0, 0)
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.engine = engine
    scene.render.resolution_x = scene.render.resolution_y = 64
    scene.render.resolution_percentage = 100
    scene.render.filepath = str(tmp_path / "picture.png")
    scene.view_settings.view_transform = "Standard"
    if engine == "CYCLES":
        scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.max_bounces = 16, False, 0
        world = bpy.data.worlds.new("white")
        if world.node_tree is None:  # before Blender 5.0 a new world has no nodes
            world.use_nodes = True
        background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
        background.inputs[0].default_value = (1, 1, 1, 1)
        scene.world = world
    else:
        scene.display.shading.light, scene.display.shading.color_type = "FLAT", color_type
        scene.display.render_aa = "OFF"
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    pixels = np.array(image.pixels[:], np.float32).reshape(64, 64, 4)[::-1]
    bpy.data.images.remove(image)
    bpy.data.objects.remove(camera)
    return pixels


PLACES = ((32, 32), (32, 45), (20, 28), (44, 36))


def expected_colours(
    heat: np.ndarray, vertices: np.ndarray, places: tuple[tuple[int, int], ...]
) -> np.ndarray:
    """Colour of the vertex that is seen nearest to each pixel (row, column) of `render`."""
    seen = vertices[:, 1] < 0
    found = []
    for row, column in places:
        x, z = ((column + 0.5) / 64 - 0.5) * 2.5, (0.5 - (row + 0.5) / 64) * 2.5
        off = np.hypot(vertices[seen, 0] - x, vertices[seen, 2] - z)
        found.append(heat[seen][np.argmin(off), :3] / 255)
    return np.array(found)


WORKBENCH = pytest.param(
    "BLENDER_WORKBENCH",
    marks=pytest.mark.skipif(
        bool(bpy.app.binary_path) and sys.platform.startswith("linux") and "DISPLAY" not in os.environ,
        reason="Blender as a program draws Workbench on a display, and dies where there is none",
    ),
)


@pytest.mark.parametrize("engine", ["CYCLES", WORKBENCH])
@pytest.mark.parametrize("kind", ["COLOUR", "SUPPORT"])
def test_what_is_shown_is_rendered(
    result: object, tmp_path: Path, parts: SimpleNamespace, engine: str, kind: str
) -> None:
    """A white world without bounces gives a rough surface exactly its own colour."""
    parts.colours.show(result.data, kind)
    name = "Color" if kind == "COLOUR" else "Support Map"
    picture = render(tmp_path, engine)
    expected = expected_colours(byte_colours(result.data, name), positions(result), PLACES)
    found = np.array([picture[place][:3] for place in PLACES])
    np.testing.assert_allclose(found, expected, atol=0.06)


def test_each_button_shows_its_own(result: object, parts: SimpleNamespace) -> None:
    assert parts.colours.shown(result.data) == "COLOUR"
    assert parts.colours.legend(result.data) == ""
    bpy.ops.fewview.show_support()
    assert parts.colours.shown(result.data) == "SUPPORT"
    assert "guessed" in parts.colours.legend(result.data)
    names = [attribute.name for attribute in result.data.color_attributes]
    bpy.ops.fewview.show_support()
    assert [attribute.name for attribute in result.data.color_attributes] == names
    bpy.ops.fewview.show_colour()
    assert parts.colours.shown(result.data) == "COLOUR"
    with pytest.raises(RuntimeError, match="Measure the error first"):
        bpy.ops.fewview.show_error()


def test_the_heat_map_follows_the_numbers(result: object, parts: SimpleNamespace) -> None:
    bpy.ops.fewview.show_support()
    found = byte_colours(result.data, "Support Map").astype(int)
    stops = np.array(parts.heat_map.SUPPORT.stops_srgb)
    heights = positions(result)[:, 2]
    assert np.abs(found[heights.argmin(), :3] - stops[0]).max() <= 1
    assert np.abs(found[heights.argmax(), :3] - stops[-1]).max() <= 1


def test_the_material_is_found_in_any_language(result: object) -> None:
    (material,) = result.data.materials
    types = {node.bl_idname for node in material.node_tree.nodes}
    assert types == {"ShaderNodeOutputMaterial", "ShaderNodeBsdfPrincipled", "ShaderNodeVertexColor"}
    assert len(material.node_tree.links) == 2
    assert 0.2 < material.diffuse_color[0] < 0.6


# The texture

QUARTERS = {
    (20, 24): (230, 30, 30),
    (20, 40): (30, 230, 30),
    (44, 24): (30, 30, 230),
    (44, 40): (230, 230, 30),
}
"""sRGB of the texture's quarters, at pixels (row, column) of `render` that show them."""


def write_textured(folder: Path) -> None:
    """A sphere as seen from the front, laid over a texture of four quarters; its vertices are grey."""
    vertices, faces = sphere()
    write_ply(folder / "mesh.ply", vertices, faces, red=90, green=90, blue=90)
    header, _, body = (folder / "mesh.ply").read_bytes().partition(b"end_header\n")
    start = len(vertices) * VERTEX.itemsize
    records = np.zeros(len(faces), [*FACE.descr, ("num_uv", "u1"), ("uv", "<f4", (3, 2))])
    records["num"], records["corners"], records["num_uv"] = 3, faces, 6
    records["uv"] = vertices[faces][..., [0, 2]] / 2 + 0.5
    header += b"property list uchar float texcoord\nend_header\n"
    (folder / "mesh.ply").write_bytes(header + body[:start] + records.tobytes())
    top, bottom = np.array(list(QUARTERS.values())).reshape(2, 2, 3)
    rows = [np.repeat(row, 8, axis=0).astype(np.uint8).tobytes() for row in (top, bottom) for _ in range(8)]
    data = zlib.compress(b"".join(b"\0" + row for row in rows))
    chunks = ((b"IHDR", struct.pack(">2I5B", 16, 16, 8, 2, 0, 0, 0)), (b"IDAT", data), (b"IEND", b""))
    (folder / "texture.png").write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + b"".join(
            struct.pack(">I", len(what)) + name + what + struct.pack(">I", zlib.crc32(name + what))
            for name, what in chunks
        )
    )


@pytest.fixture
def textured(make_job: JobMaker) -> object:
    folder = make_job()
    write_textured(folder / "result")
    bpy.ops.fewview.import_result(folder=str(folder))
    shutil.rmtree(folder)  # the picture is a part of the scene
    return bpy.context.scene.fewview.result


def colours_at(picture: np.ndarray) -> np.ndarray:
    return 255 * np.array([picture[place][:3] for place in QUARTERS])


@pytest.mark.parametrize("engine", ["CYCLES", WORKBENCH])
def test_a_texture_is_rendered_in_place_of_the_vertices_colours(
    textured: object, tmp_path: Path, parts: SimpleNamespace, engine: str
) -> None:
    assert parts.colours.shows_texture(textured.data)
    picture = render(tmp_path, engine, color_type="TEXTURE")
    np.testing.assert_allclose(colours_at(picture), list(QUARTERS.values()), atol=12)


def test_support_takes_the_place_of_a_texture_and_gives_it_back(
    textured: object, tmp_path: Path, parts: SimpleNamespace
) -> None:
    bpy.ops.fewview.show_support()
    assert not parts.colours.shows_texture(textured.data)
    picture = render(tmp_path, "CYCLES")
    found = np.array([picture[place][:3] for place in PLACES])
    expected = expected_colours(byte_colours(textured.data, "Support Map"), positions(textured), PLACES)
    np.testing.assert_allclose(found, expected, atol=0.06)
    bpy.ops.fewview.show_colour()
    np.testing.assert_allclose(colours_at(render(tmp_path, "CYCLES")), list(QUARTERS.values()), atol=12)


def test_a_material_that_the_user_changed_is_left_alone(textured: object, parts: SimpleNamespace) -> None:
    (material,) = textured.data.materials
    tree = material.node_tree
    surface = next(node for node in tree.nodes if node.type == "BSDF_PRINCIPLED")
    own = tree.nodes.new("ShaderNodeRGB")
    tree.links.new(own.outputs[0], surface.inputs["Base Color"])
    parts.colours.show(textured.data, "SUPPORT")
    (link,) = surface.inputs["Base Color"].links
    assert link.from_node == own


def test_the_picture_of_a_texture_is_packed(textured: object) -> None:
    (image,) = bpy.data.images
    assert image.packed_file is not None
    assert tuple(image.size) == (16, 16)


def test_without_its_picture_a_mesh_shows_its_vertices_colours(
    make_job: JobMaker, tmp_path: Path, parts: SimpleNamespace
) -> None:
    folder = make_job()
    write_textured(folder / "result")
    (folder / "result/texture.png").unlink()
    bpy.ops.fewview.import_result(folder=str(folder))
    assert not parts.colours.shows_texture(bpy.context.scene.fewview.result.data)
    np.testing.assert_allclose(colours_at(render(tmp_path, "CYCLES")), np.full((4, 3), 90), atol=4)


def test_a_picture_that_leads_out_of_the_job_is_not_taken(make_job: JobMaker, tmp_path: Path) -> None:
    folder = make_job()
    write_textured(folder / "result")
    (folder / "result/texture.png").rename(tmp_path / "mine.png")
    (folder / "result/texture.png").symlink_to(tmp_path / "mine.png")
    with pytest.raises(RuntimeError, match="outside"):
        bpy.ops.fewview.import_result(folder=str(folder))


def test_a_remeshed_result_has_no_texture_and_shows_its_vertices_colours(
    textured: object, tmp_path: Path, parts: SimpleNamespace
) -> None:
    bpy.ops.fewview.remesh()
    assert parts.colours.shown(textured.data) == "COLOUR"
    assert not parts.colours.shows_texture(textured.data)
    np.testing.assert_allclose(colours_at(render(tmp_path, "CYCLES")), np.full((4, 3), 90), atol=4)


@pytest.mark.parametrize("ending", [".glb", ".obj"])
def test_an_exported_texture_comes_back_alone(textured: object, tmp_path: Path, ending: str) -> None:
    """Viewers multiply it by the vertices' colours where a file has both."""
    path = tmp_path / f"mesh{ending}"
    bpy.ops.fewview.export(filepath=str(path))
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    if ending == ".glb":
        bpy.ops.import_scene.gltf(filepath=str(path))
    else:
        bpy.ops.wm.obj_import(filepath=str(path))
    (back,) = [made for made in bpy.data.objects if made.type == "MESH"]
    assert len(back.data.uv_layers) == 1
    assert not back.data.color_attributes
    (image,) = [image for image in bpy.data.images if image.size[0] == 16]
    if ending == ".obj":
        assert Path(bpy.path.abspath(image.filepath)) == tmp_path / "mesh_texture.png"
    corner = 255 * np.array(image.pixels[:], np.float32).reshape(16, 16, 4)[-1, 0, :3]
    np.testing.assert_allclose(corner, QUARTERS[20, 24], atol=1)


def test_the_picture_beside_an_obj_replaces_no_other(textured: object, tmp_path: Path) -> None:
    (tmp_path / "mesh_texture.png").write_text("mine")
    for _ in range(2):
        bpy.ops.fewview.export(filepath=str(tmp_path / "mesh.obj"), overwrite=True)
    assert (tmp_path / "mesh_texture.png").read_text() == "mine"
    assert {path.name for path in tmp_path.glob("mesh_texture?*.png")} == {
        "mesh_texture2.png",
        "mesh_texture3.png",
    }
    (image,) = bpy.data.images
    assert image.packed_file is not None
    assert "mesh_texture" not in image.filepath


# The error


def add_truth(radius: float, **settings: object) -> object:
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=6, radius=radius)
    truth = bpy.context.object
    for name, value in settings.items():
        setattr(truth, name, value)
    bpy.context.view_layer.update()
    return truth


def test_the_error_of_a_sphere_in_a_sphere(result: object, parts: SimpleNamespace) -> None:
    bpy.context.scene.fewview.target = add_truth(1.1)
    bpy.context.view_layer.objects.active = result
    bpy.ops.fewview.measure_error()
    numbers = parts.error_map.numbers_of(result)
    expected = 100 * 0.1 / (2.2 * np.sqrt(3))
    for value in (numbers.median_percent, numbers.mean_percent, numbers.p90_percent):
        assert value == pytest.approx(expected, rel=0.02)
    found = [v.value for v in result.data.attributes["error"].data]
    assert np.mean(found) == pytest.approx(numbers.mean_percent, rel=1e-4)
    assert parts.colours.shown(result.data) == "ERROR"
    bpy.ops.fewview.show_colour()
    bpy.ops.fewview.show_error()


def test_the_error_is_that_of_the_world(result: object, parts: SimpleNamespace) -> None:
    """Also where the truth is a stretched object with a modifier and a child, and the result is moved."""
    truth = add_truth(0.5, scale=(2.0, 2.0, 2.0), rotation_euler=(1.0, 2.0, 3.0), location=(1.0, 0.0, 0.0))
    truth.modifiers.new("displace", "DISPLACE").strength = 0.05
    result.location = (1.0, 0.0, 0.0)
    bpy.context.view_layer.update()
    bpy.ops.fewview.measure_error(truth=truth.name, object_name=result.name)
    diagonal = 2 * np.sqrt(3) * 2 * 0.525
    numbers = parts.error_map.numbers_of(result)
    # Displaced by strength * (1 - midlevel) of the white default along the normal, then scaled.
    assert numbers.median_percent == pytest.approx(100 * 0.05 / diagonal, rel=0.05)


def test_the_error_is_to_what_renders_show(result: object, parts: SimpleNamespace) -> None:
    """An exact copy of the rendered surface has none, whatever of it the viewport shows."""
    bpy.ops.mesh.primitive_cube_add()
    truth = bpy.context.object
    subdivision = truth.modifiers.new("Subdivision", "SUBSURF")
    subdivision.levels, subdivision.render_levels = 3, 3
    bpy.context.view_layer.update()
    exact = truth.evaluated_get(bpy.context.evaluated_depsgraph_get())
    result.data = bpy.data.meshes.new_from_object(exact)
    subdivision.levels, truth.hide_viewport = 1, True
    bpy.ops.fewview.measure_error(truth=truth.name, object_name=result.name)
    assert parts.error_map.numbers_of(result).p90_percent < 1e-4
    assert (subdivision.levels, truth.hide_viewport) == (1, True)


def test_distances_agree_with_a_plain_search(parts: SimpleNamespace, result: object) -> None:
    """Many trees find what one tree finds, for points far and near."""
    from mathutils.bvhtree import BVHTree

    truth_mesh = importlib.import_module(f"{parts.error_map.__package__}.true_mesh")
    vertices, faces = sphere(6)  # 20,480 faces: several trees
    truth = truth_mesh.TrueMesh(vertices=vertices * [3, 1, 1], normals=vertices, faces=faces)
    trees = list(parts.error_map._trees(truth))
    assert len(trees) > 1
    points = np.random.default_rng(0).normal(size=(500, 3)) * 2
    found = np.empty(len(points))
    for _ in parts.error_map._query(trees, points, found):
        pass
    one = BVHTree.FromPolygons(truth.vertices.tolist(), faces.tolist(), all_triangles=True)
    np.testing.assert_allclose(found, [one.find_nearest(p)[3] for p in points], atol=1e-6)


def test_nothing_to_measure_against_is_said(result: object) -> None:
    with pytest.raises(RuntimeError, match="Choose the original"):
        bpy.ops.fewview.measure_error()
    with pytest.raises(RuntimeError, match="no object Nobody"):
        bpy.ops.fewview.measure_error(truth="Nobody")
    with pytest.raises(RuntimeError, match="Choose the original"):
        bpy.ops.fewview.measure_error(truth=result.name)
    empty = bpy.data.objects.new("Hollow", None)
    bpy.context.collection.objects.link(empty)
    with pytest.raises(RuntimeError, match="no visible surface"):
        bpy.ops.fewview.measure_error(truth="Hollow")


# What is done with it


def test_decimating_can_be_taken_back(result: object) -> None:
    before = len(result.data.polygons)
    for ratio in (0.5, 0.1):
        bpy.ops.fewview.decimate(ratio=ratio)
        (modifier,) = result.modifiers
        depsgraph = bpy.context.evaluated_depsgraph_get()
        shown = result.evaluated_get(depsgraph).data
        assert len(shown.polygons) == pytest.approx(ratio * before, rel=0.1)
        assert {"Color", "support"} <= set(shown.attributes.keys())
    assert len(result.data.polygons) == before
    bpy.context.scene.fewview.decimate_ratio = 0.3
    bpy.ops.fewview.decimate()
    assert modifier.ratio == pytest.approx(0.3)


def test_remeshing_keeps_the_colours(result: object, parts: SimpleNamespace) -> None:
    vertices, colours = positions(result), byte_colours(result.data, "Color").astype(int)
    bpy.ops.fewview.show_support()
    bpy.ops.fewview.remesh()
    assert len(result.data.vertices) != len(vertices)
    assert parts.colours.shown(result.data) == "SUPPORT"
    found, again = positions(result), byte_colours(result.data, "Color").astype(int)
    nearest = np.argmin(((found[:, None] - vertices[None]) ** 2).sum(axis=-1), axis=1)
    assert np.quantile(np.abs(again - colours[nearest]), 0.95) < 20
    heights = [v.value for v in result.data.attributes["support"].data]
    assert np.corrcoef(heights, found[:, 2])[0, 1] > 0.99
    assert all(p.use_smooth for p in result.data.polygons)
    with pytest.raises(RuntimeError, match="too small"):
        bpy.ops.fewview.remesh(voxel_size=1e-5)


@pytest.mark.parametrize("ending", [".glb", ".ply", ".obj", ".stl"])
def test_export_writes_the_result_alone(
    result: object, tmp_path: Path, parts: SimpleNamespace, ending: str
) -> None:
    bpy.ops.mesh.primitive_cube_add(location=(50, 0, 0))
    cube = bpy.context.object
    path = tmp_path / f"mesh{ending}"
    assert bpy.ops.fewview.export(filepath=str(path), object_name=result.name) == {"FINISHED"}
    assert bpy.context.selected_objects == [cube]
    assert bpy.context.view_layer.objects.active == cube
    colours = byte_colours(result.data, "Color").astype(int)
    vertices = positions(result)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    {
        ".glb": lambda: bpy.ops.import_scene.gltf(filepath=str(path)),
        ".ply": lambda: bpy.ops.wm.ply_import(filepath=str(path)),
        ".obj": lambda: bpy.ops.wm.obj_import(filepath=str(path)),
        ".stl": lambda: bpy.ops.wm.stl_import(filepath=str(path)),
    }[ending]()
    (back,) = [made for made in bpy.data.objects if made.type == "MESH"]
    bpy.context.view_layer.update()
    found = positions(back)
    np.testing.assert_allclose(found.min(axis=0), vertices.min(axis=0), atol=1e-4)
    if ending == ".stl":
        return
    (attribute,) = back.data.color_attributes
    flat = np.empty(4 * len(attribute.data), np.float32)
    attribute.data.foreach_get("color_srgb", flat)
    if attribute.domain == "CORNER":
        found = found[[loop.vertex_index for loop in back.data.loops]]
    nearest = np.argmin(((found[:, None] - vertices[None]) ** 2).sum(axis=-1), axis=1)
    np.testing.assert_allclose(flat.reshape(-1, 4) * 255, colours[nearest], atol=2)


def test_export_overwrites_only_when_asked(result: object, tmp_path: Path) -> None:
    path = tmp_path / "mine.ply"
    path.write_text("mine")
    with pytest.raises(RuntimeError, match="exists"):
        bpy.ops.fewview.export(filepath=str(path))
    assert path.read_text() == "mine"
    bpy.ops.fewview.export(filepath=str(path), overwrite=True)
    assert path.read_bytes().startswith(b"ply")
    with pytest.raises(RuntimeError, match="no format"):
        bpy.ops.fewview.export(filepath=str(tmp_path / "mesh.docx"))
    bpy.ops.fewview.export(filepath=str(tmp_path / "bare"))
    assert (tmp_path / "bare.glb").is_file()
    result.hide_set(True)
    with pytest.raises(RuntimeError, match="hidden"):
        bpy.ops.fewview.export(filepath=str(tmp_path / "other.ply"))


def test_the_file_browser_knows_the_whole_name(parts: SimpleNamespace) -> None:
    """Else it has nothing to warn of, and the file that is there is replaced."""
    check = parts.result_files.FEWVIEW_OT_export.check
    for typed, whole in (("/a.b/mine", "/a.b/mine.ply"), ("/a/mine.obj", "/a/mine.obj"), ("/a.b/", "/a.b/")):
        asked = SimpleNamespace(filepath=typed, format=".ply")
        assert check(asked, bpy.context) is (typed != whole)
        assert asked.filepath == whole


def test_what_cannot_be_selected_is_not_exported_as_nothing(result: object, tmp_path: Path) -> None:
    result.hide_select = True
    bpy.ops.mesh.primitive_cube_add()
    other = bpy.context.object
    for ending in ("glb", "ply", "obj", "stl"):
        with pytest.raises(RuntimeError, match="cannot be selected: make it selectable first"):
            bpy.ops.fewview.export(filepath=str(tmp_path / f"mesh.{ending}"), object_name=result.name)
    assert not list(tmp_path.glob("mesh.*"))
    assert bpy.context.selected_objects == [other]
    assert bpy.context.view_layer.objects.active == other


def test_export_replaces_no_materials_of_another_thing(result: object, tmp_path: Path) -> None:
    materials = tmp_path / "vase.mtl"
    materials.write_text("mine")
    with pytest.raises(RuntimeError, match=r"vase\.mtl exists"):
        bpy.ops.fewview.export(filepath=str(tmp_path / "vase.obj"), overwrite=True)
    assert materials.read_text() == "mine"
    assert not (tmp_path / "vase.obj").exists()
    for _ in range(2):  # its own
        bpy.ops.fewview.export(filepath=str(tmp_path / "other.obj"), overwrite=True)


def test_a_mirrored_camera_of_the_users_does_no_harm(make_job: JobMaker) -> None:
    camera = bpy.data.objects.new("Mirror", bpy.data.cameras.new("Mirror"))
    bpy.context.scene.collection.objects.link(camera)
    camera.scale.x = -1
    bpy.context.view_layer.update()
    assert bpy.ops.fewview.import_result(folder=str(make_job(estimated=False))) == {"FINISHED"}
    assert len(bpy.data.cameras) == 4


def test_the_report_is_opened(make_job: JobMaker, monkeypatch: pytest.MonkeyPatch) -> None:
    import webbrowser

    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda url, *_: opened.append(url))
    folder = make_job()
    bpy.ops.fewview.import_result(folder=str(folder))
    bpy.ops.fewview.open_report()
    assert opened == [(folder / "result/report.html").as_uri()]
    (folder / "result/report.html").unlink()
    (folder / "result/report.html").symlink_to("/etc/hostname")
    with pytest.raises(RuntimeError, match="outside"):
        bpy.ops.fewview.open_report()
    (folder / "result/report.html").unlink()
    with pytest.raises(RuntimeError, match=r"has no report\.html: .* press Open Folder$"):
        bpy.ops.fewview.open_report()


def test_the_report_of_the_cameras_is_opened(make_job: JobMaker, monkeypatch: pytest.MonkeyPatch) -> None:
    import webbrowser

    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda url, *_: opened.append(url))
    page = make_job() / "result/cameras.html"
    with pytest.raises(RuntimeError, match="Estimate the cameras"):
        bpy.ops.fewview.open_camera_report()
    bpy.context.scene.fewview.cameras_job = str(page.parent.parent)
    with pytest.raises(RuntimeError, match="Estimate the cameras"):
        bpy.ops.fewview.open_camera_report()
    page.write_text("<p>A report</p>")
    bpy.ops.fewview.open_camera_report()
    assert opened == [page.as_uri()]
    page.unlink()
    page.symlink_to("/etc/hostname")
    assert not bpy.ops.fewview.open_camera_report.poll()


def test_without_a_result_buttons_say_what_to_do() -> None:
    for name in (
        "show_colour",
        "show_support",
        "show_error",
        "measure_error",
        "decimate",
        "remesh",
        "export",
        "render_novel_views",
    ):
        with pytest.raises(RuntimeError, match="Reconstruct first"):
            getattr(bpy.ops.fewview, name)()


def test_in_edit_mode_buttons_say_what_to_do(result: object) -> None:
    bpy.ops.object.mode_set(mode="EDIT")
    try:
        for name in ("show_support", "measure_error", "decimate", "remesh", "import_result"):
            with pytest.raises(RuntimeError, match="Object Mode"):
                getattr(bpy.ops.fewview, name)()
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")


def test_a_result_that_was_deleted_is_none(result: object) -> None:
    bpy.context.scene.collection.objects.unlink(result)  # as Delete does; the pointer keeps it
    assert bpy.context.scene.fewview.result == result
    with pytest.raises(RuntimeError, match="Reconstruct first"):
        bpy.ops.fewview.show_colour()
