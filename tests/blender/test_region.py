"""The region: an empty that can be added, fitted and removed, and what the backend gets of it."""

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="needs Blender's Python, where `import bpy` works")

from mathutils import Matrix  # noqa: E402  it comes with bpy

pytestmark = pytest.mark.blender


@pytest.fixture
def region(addon: ModuleType) -> ModuleType:
    return importlib.import_module(f"{addon.__name__}.region")


def sphere_of(empty: object) -> tuple[np.ndarray, float]:
    bpy.context.view_layer.update()
    world = np.array(empty.matrix_world)
    return world[:3, 3], float(np.linalg.norm(world[:3, 0]) * empty.empty_display_size)


def add_points(positions: np.ndarray, job: str = "", **settings: object) -> object:
    mesh = bpy.data.meshes.new("points")
    mesh.from_pydata(positions.tolist(), [], [])
    points = bpy.data.objects.new("points", mesh)
    points["fewview_role"], points["fewview_job"] = "points", job
    bpy.context.collection.objects.link(points)
    for name, value in settings.items():
        setattr(points, name, value)
    bpy.context.view_layer.update()
    return points


def add_root(matrix: Matrix, job: str = "") -> object:
    root = bpy.data.objects.new("root", None)
    root["fewview_job"] = job
    bpy.context.collection.objects.link(root)
    root.matrix_world = matrix
    bpy.context.scene.fewview.root = root
    bpy.context.view_layer.update()
    return root


def write_cameras(folder: Path, *, estimated: bool) -> None:
    (folder / "result").mkdir()
    (folder / "result/cameras.json").write_text(
        '{"camera_model": "PINHOLE", "frames": [{"file_path": "a.png", "w": 4, "h": 4, "fl_x": 4, "fl_y": 4,'
        '"cx": 2, "cy": 2, "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,5],[0,0,0,1]]}], "fewview":'
        f'{{"estimated": {str(estimated).lower()}, "reprojection_error_px": null, "unplaced": [],'
        '"region": {"centre_world": [1, 2, 3], "radius_world": 0.5}}}'
    )


def shell(rng: np.random.Generator, num: int = 500) -> np.ndarray:
    points = rng.normal(size=(num, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def test_with_nothing_known_it_is_at_the_cursor(region: ModuleType) -> None:
    bpy.context.scene.cursor.location = (1, 2, 3)
    assert bpy.ops.fewview.add_region() == {"FINISHED"}
    empty = bpy.context.scene.fewview.region
    centre, radius = sphere_of(empty)
    np.testing.assert_allclose(centre, [1, 2, 3])
    assert radius == pytest.approx(1.0)
    assert empty.empty_display_type == "SPHERE"
    assert bpy.context.view_layer.objects.active == empty
    with pytest.raises(RuntimeError, match="There is a region already"):
        bpy.ops.fewview.add_region()


def test_it_can_be_given_in_numbers(region: ModuleType) -> None:
    bpy.ops.fewview.add_region(centre=(1, 0, 0), radius=0.25)
    bpy.context.view_layer.update()
    centre, radius = region.region_of(bpy.context.scene)
    np.testing.assert_allclose(centre, [1, 0, 0])
    assert radius == pytest.approx(0.25)


def test_it_holds_the_target(region: ModuleType) -> None:
    bpy.ops.mesh.primitive_cube_add(size=2, location=(5, 0, 0))
    bpy.context.scene.fewview.target = bpy.context.object
    bpy.ops.fewview.add_region()
    centre, radius = sphere_of(bpy.context.scene.fewview.region)
    np.testing.assert_allclose(centre, [5, 0, 0], atol=1e-6)
    assert np.sqrt(3) < radius < 1.1 * np.sqrt(3)


@pytest.mark.parametrize("estimated", [True, False])
def test_it_is_where_the_backend_found_it(region: ModuleType, tmp_path: Path, estimated: bool) -> None:
    write_cameras(tmp_path, estimated=estimated)
    bpy.context.scene.fewview.cameras_job = str(tmp_path)
    world_from_solved = np.eye(4)
    if estimated:
        root = add_root(Matrix.Translation((0, 0, 7)) @ Matrix.Scale(2, 4), str(tmp_path))
        world_from_solved = np.array(root.matrix_world)
    bpy.ops.fewview.add_region()
    bpy.context.view_layer.update()
    placed, size = sphere_of(bpy.context.scene.fewview.region)
    np.testing.assert_allclose(placed, world_from_solved[:3, :3] @ [1, 2, 3] + world_from_solved[:3, 3])
    assert size == pytest.approx(1.0 if estimated else 0.5)
    centre, radius = region.region_of(bpy.context.scene)  # and back
    np.testing.assert_allclose(centre, [1, 2, 3], atol=1e-6)
    assert radius == pytest.approx(0.5)


def test_scaling_the_empty_scales_the_region(region: ModuleType) -> None:
    assert region.region_of(bpy.context.scene) is None
    add_root(Matrix.Rotation(0.5, 4, "X") @ Matrix.Scale(4, 4))
    bpy.ops.fewview.add_region(centre=(0, 0, 0), radius=1.0)
    empty = bpy.context.scene.fewview.region
    empty.scale = (1, 3, 2)
    empty.location = (0, 0, 8)
    empty.empty_display_size = 2
    bpy.context.view_layer.update()
    centre, radius = region.region_of(bpy.context.scene)
    assert radius == pytest.approx(2 * 3 / 4)
    assert np.linalg.norm(centre) == pytest.approx(2.0)
    empty.scale = (0, 0, 0)
    bpy.context.view_layer.update()
    with pytest.raises(ValueError, match="no size"):
        region.region_of(bpy.context.scene)


def test_it_is_fitted_to_the_points_of_the_job(region: ModuleType) -> None:
    rng = np.random.default_rng(0)
    add_root(Matrix.Identity(4), "mine")
    background = rng.normal(size=(100, 3)) * 80 + [0, 200, 0]
    add_points(shell(rng) + 50, "another's")
    add_points(np.concatenate([shell(rng), background]), "mine", location=(3, 0, 0), scale=(2, 2, 2))
    add_points(shell(rng) - 50, "another's")
    bpy.ops.fewview.add_region(centre=(0, 0, 0), radius=9)
    before = bpy.context.scene.fewview.region
    bpy.ops.fewview.fit_region()
    assert bpy.context.scene.fewview.region == before
    centre, radius = sphere_of(before)
    np.testing.assert_allclose(centre, [3, 0, 0], atol=0.2)
    assert 1.95 < radius < 2.3


def test_fitting_falls_back_and_says_where_it_cannot(region: ModuleType) -> None:
    with pytest.raises(RuntimeError, match="nothing to fit"):
        bpy.ops.fewview.fit_region()
    add_points(np.zeros((3, 3)))
    bpy.ops.mesh.primitive_cube_add(size=2, location=(0, 5, 0))
    bpy.context.scene.fewview.target = bpy.context.object
    bpy.ops.fewview.fit_region()
    np.testing.assert_allclose(sphere_of(bpy.context.scene.fewview.region)[0], [0, 5, 0], atol=1e-6)


def test_only_our_own_empty_is_removed(region: ModuleType) -> None:
    scene = bpy.context.scene
    bpy.ops.fewview.add_region()
    bpy.ops.fewview.remove_region()
    assert not scene.objects
    own = bpy.data.objects.new("mine", None)
    scene.collection.objects.link(own)
    scene.fewview.region = own
    bpy.ops.fewview.remove_region()
    assert scene.fewview.region is None
    assert scene.objects.values() == [own]
    with pytest.raises(RuntimeError, match="There is no region"):
        bpy.ops.fewview.remove_region()


def test_a_region_that_was_deleted_is_none(region: ModuleType) -> None:
    bpy.ops.fewview.add_region()
    empty = bpy.context.scene.fewview.region
    bpy.context.scene.collection.objects.unlink(empty)  # as Delete does; the pointer keeps it
    assert region.region_of(bpy.context.scene) is None
    bpy.ops.fewview.add_region()
    assert bpy.context.scene.fewview.region != empty
