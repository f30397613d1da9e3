"""The region: an empty that can be added, fitted and removed, and what the backend gets of it."""

import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="needs Blender's Python, where `import bpy` works")

from mathutils import Matrix  # noqa: E402  it comes with bpy

pytestmark = pytest.mark.blender

Part = Callable[[str], ModuleType]
PLACEMENT = Matrix.Translation((0, 0, 7)) @ Matrix.Scale(2, 4)


@pytest.fixture
def region(part: Part) -> ModuleType:
    return part("region")


@pytest.fixture
def reconstruct(part: Part, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[], Any]:
    """Press Reconstruct, with three photographs on the list: the job that the backend is asked for."""
    asked: list[Any] = []
    monkeypatch.setenv("FEWVIEW_PYTHON", sys.executable)
    monkeypatch.setattr(
        part("operators.reconstruct"), "start", lambda _python, _folder, job, scene_name: asked.append(job)
    )
    monkeypatch.setattr(part("jobs"), "follow", lambda _operator: {"FINISHED"})
    bpy.context.scene.fewview.output = str(tmp_path / "jobs")
    for path in photographs(tmp_path):
        bpy.context.scene.fewview.images.add().path = str(path)

    def press() -> Any:
        bpy.context.view_layer.update()
        assert bpy.ops.fewview.reconstruct() == {"FINISHED"}
        return asked.pop()

    return press


def photographs(folder: Path) -> tuple[Path, ...]:
    return tuple(folder / name for name in ("a.png", "b.png", "c.png"))


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


def add_root(matrix: Matrix, job: str) -> object:
    root = bpy.data.objects.new("root", None)
    root["fewview_role"], root["fewview_job"] = "root", job
    bpy.context.collection.objects.link(root)
    root.matrix_world = matrix
    bpy.context.view_layer.update()
    return root


def make_job(part: Part, folder: Path, *, given: Path | None = None, estimated: bool | None = None) -> Path:
    """Folder of a job that found cameras and a region, or loaded the given cameras."""
    folders = part("job_folder")
    estimated = given is None if estimated is None else estimated
    (folder / "result").mkdir(parents=True)
    (folder / "result/cameras.json").write_text(
        '{"camera_model": "PINHOLE", "frames": [{"file_path": "a.png", "w": 4, "h": 4, "fl_x": 4, "fl_y": 4,'
        '"cx": 2, "cy": 2, "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,5],[0,0,0,1]]}], "fewview":'
        f'{{"estimated": {str(estimated).lower()}, "reprojection_error_px": null, "unplaced": [],'
        '"region": {"centre_world": [1, 2, 3], "radius_world": 0.5}}}'
    )
    asked = folders.Job(
        protocol=1,
        images=tuple(map(str, photographs(folder.parent))),
        output="result",
        cameras=None if given is None else str(given),
        until="cameras",
    )
    folders.write_job(folder, asked)
    return folder


def show(folder: Path, matrix: Matrix) -> object:
    """Import a job's cameras, and move their root, if they have one."""
    assert bpy.ops.fewview.import_cameras(folder=str(folder)) == {"FINISHED"}
    root = bpy.context.scene.fewview.root
    if root is not None:
        root.matrix_world = matrix
    bpy.context.view_layer.update()
    return root


def add_cube(x: float) -> None:
    """The scene's target."""
    bpy.ops.mesh.primitive_cube_add(size=2, location=(x, 0, 0))
    bpy.context.scene.fewview.target = bpy.context.object


def assert_region(job: Any, centre: Any, radius: float) -> None:
    np.testing.assert_allclose(job.region_centre, centre, atol=1e-5)
    assert job.region_radius == pytest.approx(radius, abs=1e-5)


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
    centre, radius = region.region_of(bpy.context.scene, "known.json")
    np.testing.assert_allclose(centre, [1, 0, 0])
    assert radius == pytest.approx(0.25)


def test_it_holds_the_target(region: ModuleType) -> None:
    add_cube(5)
    bpy.ops.fewview.add_region()
    centre, radius = sphere_of(bpy.context.scene.fewview.region)
    np.testing.assert_allclose(centre, [5, 0, 0], atol=1e-6)
    assert np.sqrt(3) < radius < 1.1 * np.sqrt(3)


@pytest.mark.parametrize("estimated", [True, False])
def test_it_is_where_the_backend_found_it(
    region: ModuleType, part: Part, tmp_path: Path, estimated: bool
) -> None:
    known = tmp_path / "known.json"
    folder = make_job(part, tmp_path / "job", given=None if estimated else known)
    settings = bpy.context.scene.fewview
    settings.cameras_job = str(folder)
    world_from_solved = np.eye(4)
    if estimated:
        world_from_solved = np.array(add_root(PLACEMENT, str(folder)).matrix_world)
    else:
        settings.camera_source, settings.cameras_path = "KNOWN", str(known)
    bpy.ops.fewview.add_region()
    bpy.context.view_layer.update()
    placed, size = sphere_of(bpy.context.scene.fewview.region)
    np.testing.assert_allclose(placed, world_from_solved[:3, :3] @ [1, 2, 3] + world_from_solved[:3, 3])
    assert size == pytest.approx(1.0 if estimated else 0.5)
    cameras = str(folder / "result/cameras.json") if estimated else str(known)
    centre, radius = region.region_of(bpy.context.scene, cameras)  # and back
    np.testing.assert_allclose(centre, [1, 2, 3], atol=1e-6)
    assert radius == pytest.approx(0.5)


def test_scaling_the_empty_scales_the_region(region: ModuleType, part: Part, tmp_path: Path) -> None:
    cameras = str(make_job(part, tmp_path / "job") / "result/cameras.json")
    assert region.region_of(bpy.context.scene, cameras) is None
    add_root(Matrix.Rotation(0.5, 4, "X") @ Matrix.Scale(4, 4), str(tmp_path / "job"))
    bpy.ops.fewview.add_region(centre=(0, 0, 0), radius=1.0)
    empty = bpy.context.scene.fewview.region
    empty.scale = (1, 3, 2)
    empty.location = (0, 0, 8)
    empty.empty_display_size = 2
    bpy.context.view_layer.update()
    centre, radius = region.region_of(bpy.context.scene, cameras)
    assert radius == pytest.approx(2 * 3 / 4)
    assert np.linalg.norm(centre) == pytest.approx(2.0)
    empty.scale = (0, 0, 0)
    bpy.context.view_layer.update()
    with pytest.raises(ValueError, match="no size"):
        region.region_of(bpy.context.scene, cameras)


def test_it_is_fitted_to_the_points_of_the_job(part: Part, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    mine = str(make_job(part, tmp_path / "mine"))
    bpy.context.scene.fewview.cameras_job = mine
    background = rng.normal(size=(100, 3)) * 80 + [0, 200, 0]
    add_points(shell(rng) + 50, "another's")
    add_points(np.concatenate([shell(rng), background]), mine, location=(3, 0, 0), scale=(2, 2, 2))
    add_points(shell(rng) - 50, "another's")
    bpy.ops.fewview.add_region(centre=(0, 0, 0), radius=9)
    before = bpy.context.scene.fewview.region
    bpy.ops.fewview.fit_region()
    assert bpy.context.scene.fewview.region == before
    centre, radius = sphere_of(before)
    np.testing.assert_allclose(centre, [3, 0, 0], atol=0.2)
    assert 1.95 < radius < 2.3


def test_fitting_falls_back_and_says_where_it_cannot(part: Part, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="nothing to fit"):
        bpy.ops.fewview.fit_region()
    folder = str(make_job(part, tmp_path / "job"))  # its cameras have no place in the scene
    bpy.context.scene.fewview.cameras_job = folder
    add_points(np.zeros((3, 3)), folder)
    add_cube(5)
    bpy.ops.fewview.fit_region()
    np.testing.assert_allclose(sphere_of(bpy.context.scene.fewview.region)[0], [5, 0, 0], atol=1e-6)


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
    assert region.region_of(bpy.context.scene, None) is None
    bpy.ops.fewview.add_region()
    assert bpy.context.scene.fewview.region != empty


# In the frame of the cameras that the job gets.


def test_it_keeps_its_place_when_the_cameras_are_removed(
    reconstruct: Callable[[], Any], part: Part, tmp_path: Path
) -> None:
    folder = make_job(part, tmp_path / "reconstruct-001")
    root = show(folder, PLACEMENT)
    bpy.ops.fewview.add_region()
    assert bpy.ops.fewview.remove_cameras() == {"FINISHED"}
    assert set(bpy.context.scene.objects) == {root, bpy.context.scene.fewview.region}
    job = reconstruct()
    assert job.cameras == str(folder / "result/cameras.json")
    assert_region(job, [1, 2, 3], 0.5)
    bpy.ops.fewview.remove_region()
    bpy.ops.fewview.remove_cameras()
    assert not bpy.context.scene.objects


@pytest.mark.parametrize("why", ["none yet", "job moved", "new photograph", "root deleted", "known before"])
def test_a_job_is_refused_where_its_cameras_have_no_place(
    reconstruct: Callable[[], Any], part: Part, tmp_path: Path, why: str
) -> None:
    settings, folder = bpy.context.scene.fewview, tmp_path / "reconstruct-001"
    if why != "none yet":
        known = tmp_path / "known.json" if why == "known before" else None
        show(make_job(part, folder, given=known), PLACEMENT)
    assert bpy.ops.fewview.add_region() == {"FINISHED"}
    if why == "job moved":
        shutil.move(folder, tmp_path / "elsewhere")
    elif why == "new photograph":
        settings.images.add().path = str(tmp_path / "d.png")
    elif why == "root deleted":
        bpy.data.objects.remove(settings.root)
    with pytest.raises(
        RuntimeError, match="cameras of these photographs in the scene: estimate or load them"
    ):
        reconstruct()
    bpy.ops.fewview.remove_region()
    job = reconstruct()
    assert job.region_centre is None
    assert job.cameras == (str(folder / "result/cameras.json") if why == "root deleted" else None)


@pytest.mark.parametrize("source", ["found", "found and given", "loaded"])
def test_of_several_roots_that_of_the_cameras_places_it(
    reconstruct: Callable[[], Any], part: Part, tmp_path: Path, source: str
) -> None:
    """The scene's root may be that of another job, as of one that was cancelled."""
    settings = bpy.context.scene.fewview
    file = tmp_path / "RESULT/cameras.json"  # which the command line estimated
    given = file if source == "loaded" else None
    folder = make_job(part, tmp_path / "reconstruct-001", given=given, estimated=True)
    show(folder, PLACEMENT)
    show(make_job(part, tmp_path / "reconstruct-002"), Matrix.Translation((9, 9, 9)))
    settings.cameras_job = str(folder)
    if source != "found":
        settings.camera_source = "KNOWN"
        settings.cameras_path = str(given or folder / "result/cameras.json")
    ours = part("camera_objects")
    world = ours.world_from_solved(ours.root_or_none(bpy.context.scene, str(folder)))
    place = world[:3, :3] @ [1, 2, 3] + world[:3, 3]
    bpy.ops.fewview.add_region(centre=place, radius=0.5 * np.cbrt(np.linalg.det(world[:3, :3])))
    job = reconstruct()
    assert job.cameras == str(given or folder / "result/cameras.json")
    assert_region(job, [1, 2, 3], 0.5)


def test_cameras_that_were_loaded_again_place_it(
    reconstruct: Callable[[], Any], part: Part, tmp_path: Path
) -> None:
    settings, file = bpy.context.scene.fewview, tmp_path / "RESULT/cameras.json"
    settings.camera_source, settings.cameras_path = "KNOWN", str(file)
    for number, x in enumerate((9, 0)):
        folder = make_job(part, tmp_path / f"reconstruct-00{number}", given=file, estimated=True)
        show(folder, Matrix.Translation((x, 0, 0)))
    bpy.ops.fewview.add_region()
    assert_region(reconstruct(), [1, 2, 3], 0.5)


def test_known_cameras_stand_in_the_world(reconstruct: Callable[[], Any], part: Part, tmp_path: Path) -> None:
    """Whatever cameras were estimated before, and are still in the scene."""
    show(make_job(part, tmp_path / "reconstruct-001"), PLACEMENT)
    settings = bpy.context.scene.fewview
    settings.camera_source, settings.cameras_path = "KNOWN", str(tmp_path / "known.json")
    add_cube(10)
    bpy.ops.fewview.add_region()
    np.testing.assert_allclose(sphere_of(settings.region)[0], [10, 0, 0], atol=1e-6)
    settings.region.location.y = 4
    job = reconstruct()
    assert job.cameras == str(tmp_path / "known.json")
    assert_region(job, [10, 4, 0], sphere_of(settings.region)[1])


@pytest.mark.parametrize("chosen", ["result/cameras.json", "result"])
def test_estimated_cameras_of_a_file_have_to_be_loaded(
    reconstruct: Callable[[], Any], part: Part, tmp_path: Path, chosen: str
) -> None:
    given = make_job(part, tmp_path / "elsewhere") / chosen
    settings = bpy.context.scene.fewview
    settings.camera_source, settings.cameras_path = "KNOWN", str(given)
    bpy.ops.fewview.add_region()
    with pytest.raises(RuntimeError, match="estimate or load them"):
        reconstruct()


def test_it_is_around_the_subject_of_new_views(
    reconstruct: Callable[[], Any], part: Part, tmp_path: Path
) -> None:
    """Not around the one that cameras and points of an earlier job are of."""
    solved, settings = part("solved"), bpy.context.scene.fewview
    folder = make_job(part, tmp_path / "reconstruct-001")
    show(folder, PLACEMENT)
    add_points(shell(np.random.default_rng(0)), str(folder))
    add_cube(10)
    (tmp_path / "views-001").mkdir()
    transforms = tmp_path / "views-001/transforms.json"
    (camera,) = solved.read_solved(folder / "result/cameras.json").cameras
    solved.write_cameras(transforms, [replace(camera, name=name) for name in ("0.png", "1.png")])
    for _ in part("operators.views").take_views(bpy.context.scene.session_uid, transforms.parent):
        pass
    for place in (bpy.ops.fewview.add_region, bpy.ops.fewview.fit_region):
        place()
        job = reconstruct()
        assert job.cameras == str(transforms)
        assert_region(job, [10, 0, 0], sphere_of(settings.region)[1])
    assert settings.root is None


def test_it_is_around_what_renders_show_of_the_object(part: Part) -> None:
    scene = bpy.context.scene
    add_cube(0)
    radius = part("region").guess(scene)[0][1]
    array = scene.fewview.target.modifiers.new("Array", "ARRAY")
    array.count, array.show_viewport = 5, False
    (centre, larger), _ = part("region").guess(scene)
    assert larger > 2 * radius
    assert centre[0] == pytest.approx(4)
    assert not array.show_viewport


def test_a_deleted_region_asks_for_no_cameras(
    reconstruct: Callable[[], Any], part: Part, tmp_path: Path
) -> None:
    settings = bpy.context.scene.fewview
    show(make_job(part, tmp_path / "reconstruct-001"), PLACEMENT)
    bpy.ops.fewview.add_region()
    bpy.context.scene.collection.objects.unlink(settings.region)
    settings.images.add().path = str(tmp_path / "d.png")
    job = reconstruct()
    assert (job.cameras, job.region_centre) == (None, None)


def test_known_cameras_that_were_loaded_are_not_taken_for_estimated(
    reconstruct: Callable[[], Any], part: Part, tmp_path: Path
) -> None:
    settings, known = bpy.context.scene.fewview, tmp_path / "known.json"
    settings.camera_source, settings.cameras_path = "KNOWN", str(known)
    show(make_job(part, tmp_path / "reconstruct-001", given=known), PLACEMENT)
    assert reconstruct().cameras == str(known)
    settings.camera_source = "ESTIMATE"
    assert reconstruct().cameras is None
