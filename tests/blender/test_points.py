"""Points alone: what is written of an object, and the surface that comes back, beside it in the world."""

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="needs Blender's Python, where `import bpy` works")

pytestmark = [pytest.mark.blender, pytest.mark.usefixtures("addon")]

Part = Callable[[str], ModuleType]
MATRIX = np.array([[0, -2, 0, 5], [1, 0, 0, -3], [0, 0, 3, 1], [0, 0, 0, 1]], np.float64)
"""Of an object: turned, of unequal scale, moved."""
MIRROR = np.diag([-1.0, 2.0, 1.0, 1.0])


@pytest.fixture
def rehearsed(part: Part, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """A rehearsal in place of the backend; the words that the backend would have got, how it ends."""
    given: dict[str, Any] = {"end": "finished", "seconds": "0"}
    backend_command = part("operators.points").backend_command

    def rehearse(python: Path, *words: str) -> tuple[str, ...]:
        given["words"] = words
        how = ("--seconds", given["seconds"], "--end", given["end"])
        output = words[words.index("--output") + 1]
        return tuple(backend_command(python, "rehearse", *how, "--output", output))

    monkeypatch.setattr(part("operators.points"), "backend_command", rehearse)
    monkeypatch.setenv("FEWVIEW_PYTHON", sys.executable)
    monkeypatch.setattr(part("environment"), "_known", {})
    return given


def directions(count: int) -> np.ndarray:
    """Unit vectors all around."""
    vectors = np.random.default_rng(0).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def cloud(positions: np.ndarray, *, normals: np.ndarray | None = None, kind: str = "MESH") -> Any:
    """The active object: a mesh of vertices alone, or a point cloud."""
    mesh = bpy.data.meshes.new("Cloud")
    mesh.from_pydata(positions.tolist(), [], [])
    if normals is not None:
        mesh.attributes.new("normal", "FLOAT_VECTOR", "POINT")
        mesh.attributes["normal"].data.foreach_set("vector", normals.astype(np.float32).ravel())
    made = bpy.data.objects.new("Cloud", mesh)
    bpy.context.scene.collection.objects.link(made)
    bpy.context.view_layer.objects.active = made
    made.select_set(True)
    if kind == "POINTCLOUD":
        if kind not in bpy.ops.object.convert.get_rna_type().properties["target"].enum_items:
            pytest.skip("this Blender makes point clouds in Geometry Nodes alone")
        bpy.ops.object.convert(target="POINTCLOUD")
    assert bpy.context.object.type == kind
    return bpy.context.object


def place(made: Any, matrix: np.ndarray) -> None:
    made.matrix_world = matrix.T.tolist()


def fit(folder: Path, **words: Any) -> Any:
    """The surface."""
    assert bpy.ops.fewview.fit_points(output=str(folder), **words) == {"FINISHED"}
    return bpy.context.scene.fewview.result


# What is written.


@pytest.mark.parametrize("kind", ["MESH", "POINTCLOUD"])
@pytest.mark.parametrize("matrix", [MATRIX, MIRROR], ids=["turned", "mirrored"])
def test_points_are_written_in_the_world_frame(
    part: Part, rehearsed: dict[str, Any], tmp_path: Path, kind: str, matrix: np.ndarray
) -> None:
    """And normals stay at right angles to the surface, and outside."""
    vectors = directions(40)
    made = cloud(vectors, normals=3 * vectors, kind=kind)
    place(made, matrix)
    fit(tmp_path, normals_known=True)
    found = part("ply").read_ply(tmp_path / "points-001" / "cloud.ply")
    linear = matrix[:3, :3]
    np.testing.assert_allclose(found.positions, vectors @ linear.T + matrix[:3, 3], atol=1e-5)
    normals = vectors @ np.linalg.inv(linear)  # rows: the inverse transposed, of an ellipsoid's gradient
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(found.normals, normals, atol=1e-5)
    assert "--normals-known" in rehearsed["words"]


def test_vertices_alone_have_no_normals(part: Part, rehearsed: dict[str, Any], tmp_path: Path) -> None:
    bpy.ops.mesh.primitive_uv_sphere_add(radius=2.0)
    fit(tmp_path)
    found = part("ply").read_ply(tmp_path / "points-001" / "cloud.ply")
    assert found.normals is None
    np.testing.assert_allclose(np.linalg.norm(found.positions, axis=1), 2.0, rtol=1e-5)
    assert "--normals-known" not in rehearsed["words"]


def test_normals_are_sent_only_where_they_are_known(
    part: Part, rehearsed: dict[str, Any], tmp_path: Path
) -> None:
    cloud(directions(40), normals=directions(40))
    fit(tmp_path)
    assert part("ply").read_ply(tmp_path / "points-001" / "cloud.ply").normals is None
    assert "--normals-known" not in rehearsed["words"]


def test_faces_are_trusted_where_the_user_says_so(
    part: Part, rehearsed: dict[str, Any], tmp_path: Path
) -> None:
    bpy.ops.mesh.primitive_uv_sphere_add(radius=2.0)
    fit(tmp_path, normals_known=True)
    found = part("ply").read_ply(tmp_path / "points-001" / "cloud.ply")
    assert (np.einsum("pi,pi->p", found.normals, found.positions) > 1.9).all()
    assert "--normals-known" in rehearsed["words"]
    cloud(directions(40))
    with pytest.raises(RuntimeError, match="switch Normals Are Known off"):
        fit(tmp_path, normals_known=True)
    assert not (tmp_path / "points-002").exists()


def test_modifiers_count(part: Part, rehearsed: dict[str, Any], tmp_path: Path) -> None:
    """Eight vertices are too few, and subdivided they are enough."""
    bpy.ops.mesh.primitive_cube_add()
    with pytest.raises(RuntimeError, match="Only 8 points are in Cube"):
        bpy.ops.fewview.fit_points(output=str(tmp_path))
    bpy.context.object.modifiers.new("Subdivision", "SUBSURF").levels = 2
    fit(tmp_path)
    assert len(part("ply").read_ply(tmp_path / "points-001" / "cloud.ply").positions) == 98


def test_a_cloud_that_nodes_make(part: Part, rehearsed: dict[str, Any], tmp_path: Path) -> None:
    """Mesh to Points leaves the object's mesh empty; the points are there all the same."""
    bpy.ops.mesh.primitive_uv_sphere_add(radius=2.0)
    tree = bpy.data.node_groups.new("To Points", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    names = ("NodeGroupInput", "GeometryNodeMeshToPoints", "NodeGroupOutput")
    before, between, after = (tree.nodes.new(name) for name in names)
    tree.links.new(before.outputs[0], between.inputs[0])
    tree.links.new(between.outputs[0], after.inputs[0])
    bpy.context.object.modifiers.new("Nodes", "NODES").node_group = tree
    fit(tmp_path)
    found = part("ply").read_ply(tmp_path / "points-001" / "cloud.ply")
    assert len(found.positions) == len(bpy.context.scene.objects["Sphere"].data.vertices)
    np.testing.assert_allclose(np.linalg.norm(found.positions, axis=1), 2.0, rtol=1e-5)


def test_what_is_hidden_has_no_points(rehearsed: dict[str, Any], tmp_path: Path) -> None:
    cloud(directions(40)).hide_viewport = True
    with pytest.raises(RuntimeError, match="Cloud has no visible points"):
        bpy.ops.fewview.fit_points(output=str(tmp_path))
    assert list(tmp_path.iterdir()) == []


def test_the_words_are_the_settings_unless_given(rehearsed: dict[str, Any], tmp_path: Path) -> None:
    cloud(directions(40))
    settings = bpy.context.scene.fewview
    settings.point_method, settings.seed, settings.device = "nap", 5, "cpu"
    fit(tmp_path)
    words = rehearsed["words"]
    assert words[0] == "fit-points"
    assert words[-7:] == ("--method", "nap", "--device", "cpu", "--seed", "5", "--wire")
    bpy.context.view_layer.objects.active = bpy.data.objects["Cloud"]
    fit(tmp_path, method="linear", seed=1)
    words = rehearsed["words"]
    assert words[-7:] == ("--method", "linear", "--device", "cpu", "--seed", "1", "--wire")


def test_all_methods_of_the_backend_are_offered(part: Part) -> None:
    items = bpy.context.scene.fewview.bl_rna.properties["point_method"].enum_items
    assert items.keys() == list(part("properties").PointMethod)


# What comes back.


def test_the_surface_arrives_beside_the_points(part: Part, rehearsed: dict[str, Any], tmp_path: Path) -> None:
    made = cloud(directions(40))
    place(made, MATRIX)
    result = fit(tmp_path)
    came = part("ply").read_ply(tmp_path / "points-001" / "result" / "mesh.ply").positions
    np.testing.assert_allclose([vertex.co for vertex in result.data.vertices], came, atol=1e-6)
    assert result.name == "Cloud surface"
    np.testing.assert_array_equal(np.array(result.matrix_world), np.eye(4))
    assert result.parent is None
    assert bpy.context.view_layer.objects.active == result
    assert bpy.context.selected_objects == [result]
    assert made.name in bpy.context.scene.objects
    assert [o.name for o in bpy.context.scene.objects if o.type == "CAMERA"] == []  # though there are some
    assert result["fewview_job"] == str(tmp_path / "points-001")


def test_it_is_one_undo_step(part: Part, rehearsed: dict[str, Any], tmp_path: Path) -> None:
    """As in a window, where the timer follows the job."""
    cloud(directions(40))
    bpy.data.meshes.remove(fit(tmp_path).data)
    bpy.ops.ed.undo_push(message="before")
    steps = part("result_import").import_fit_steps
    for _ in steps(tmp_path / "points-001", scene_name=bpy.context.scene.name, name="Cloud surface"):
        pass
    assert "Cloud surface" in bpy.data.objects
    bpy.ops.ed.undo()
    assert "Cloud surface" not in bpy.data.objects
    assert "Cloud" in bpy.data.objects
    bpy.ops.ed.redo()
    assert "Cloud surface" in bpy.data.objects


def test_it_is_a_past_job_that_can_be_imported_again(
    part: Part, rehearsed: dict[str, Any], tmp_path: Path
) -> None:
    cloud(directions(40))
    fit(tmp_path)
    folder = tmp_path / "points-001"
    assert [job.folder for job in part("job_folder").past_jobs(tmp_path)] == [folder]
    assert bpy.ops.fewview.import_result(folder=str(folder)) == {"FINISHED"}
    assert bpy.context.scene.fewview.result.name == "points-001"
    opener = part("operators.result_files")._OnFolder()
    opener.folder = ""
    assert opener._job_folder(bpy.context) == folder


def test_a_failure_is_said_and_leaves_the_scene(rehearsed: dict[str, Any], tmp_path: Path) -> None:
    cloud(directions(40))
    rehearsed["end"] = "failed"
    with pytest.raises(RuntimeError, match="ran out of memory"):
        bpy.ops.fewview.fit_points(output=str(tmp_path))
    assert [made.name for made in bpy.context.scene.objects] == ["Cloud"]


def test_it_does_not_wait_in_a_window_and_can_be_cancelled(
    part: Part, rehearsed: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    jobs = part("jobs")
    monkeypatch.setattr(jobs, "follow", lambda _: {"FINISHED"})
    cloud(directions(40))
    rehearsed["seconds"] = "60"
    assert bpy.ops.fewview.fit_points(output=str(tmp_path)) == {"FINISHED"}
    assert jobs.running().title == "Fitting points"
    assert not bpy.ops.fewview.fit_points.poll()
    assert bpy.ops.fewview.cancel() == {"FINISHED"}
    deadline = time.monotonic() + 20.0
    while jobs.running() is not None:
        assert time.monotonic() < deadline
        jobs._tick()
        time.sleep(0.02)
    assert jobs.ended().cancelled
    assert [made.name for made in bpy.context.scene.objects] == ["Cloud"]


@pytest.mark.slow
@pytest.mark.skipif("FEWVIEW_PYTHON" not in os.environ, reason="FEWVIEW_PYTHON names no Python with it")
def test_the_backend_makes_a_closed_surface_near_a_sphere(part: Part, tmp_path: Path) -> None:
    """400 points with noise of 1 % of the radius, in an object that is moved and scaled."""
    import bmesh

    vectors = directions(400)
    noisy = vectors * (1 + 0.01 * np.random.default_rng(1).normal(size=(400, 1)))
    made = cloud(noisy)
    place(made, np.array([[2, 0, 0, 10], [0, 2, 0, 0], [0, 0, 2, -4], [0, 0, 0, 1]]))
    result = fit(tmp_path)
    shape = bmesh.new()
    shape.from_mesh(result.data)
    assert all(edge.is_manifold for edge in shape.edges)
    volume = shape.calc_volume(signed=True)
    shape.free()
    # The mean radius is off by less than the noise of one point, and so is the surface anywhere, threefold.
    assert volume == pytest.approx(4 / 3 * np.pi * 2.0**3, rel=0.03)
    positions = np.array([vertex.co for vertex in result.data.vertices])
    radii = np.linalg.norm(positions - [10, 0, -4], axis=1)
    np.testing.assert_allclose(radii, 2.0, rtol=0.03)
    lines = part("result_numbers").result_lines(Path(result["fewview_job"]))
    assert lines[0] == f"{len(result.data.polygons):,} triangles, closed"
    assert [line.split()[0] for line in lines[1:]] == ["Computed"]
