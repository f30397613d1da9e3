"""A finished job rendered from Blender's cameras: what they see in the scene is what the pictures show."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="needs Blender's Python, where `import bpy` works")

from bpy_extras.object_utils import world_to_camera_view  # noqa: E402
from mathutils import Euler, Matrix, Vector  # noqa: E402

pytestmark = [pytest.mark.blender, pytest.mark.usefixtures("addon")]
needs_python = pytest.mark.skipif(
    "FEWVIEW_PYTHON" not in os.environ, reason="FEWVIEW_PYTHON names no Python with it"
)

Part = Callable[[str], ModuleType]
CORNERS = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)], np.float64)
FACES = ((0, 1, 2), (0, 3, 1), (0, 2, 3), (1, 3, 2))
SIDES = np.array([(230, 230, 230), (160, 160, 160), (110, 110, 110), (60, 60, 60)])
"""Of the rehearsal's mesh, a tetrahedron in the frame that was solved."""
MOVE = Matrix.LocRotScale(Vector((4, -2, 1)), Euler((0.5, -0.3, 2.0)), Vector((2.5, 2.5, 2.5)))


@pytest.fixture(autouse=True)
def some_python(part: Part, monkeypatch: pytest.MonkeyPatch) -> None:
    """This one is taken for the backend's unless one is named."""
    if "FEWVIEW_PYTHON" not in os.environ:
        monkeypatch.setenv("FEWVIEW_PYTHON", sys.executable)
    monkeypatch.setattr(part("environment"), "_known", {})


@pytest.fixture
def result(part: Part, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """The mesh of a rehearsed job, imported under the root of its estimated cameras."""
    backend_command = part("operators.reconstruct").backend_command

    def rehearse(python: Path, _: str, job: str) -> tuple[str, ...]:
        output = str(Path(job).parent / "result")
        return tuple(backend_command(python, "rehearse", "--seconds", "0", "--output", output))

    monkeypatch.setattr(part("operators.reconstruct"), "backend_command", rehearse)
    for name in ("a.png", "b.png", "c.png"):
        (tmp_path / name).write_bytes(b"")
    assert bpy.ops.fewview.reconstruct(images=str(tmp_path), output=str(tmp_path / "jobs")) == {"FINISHED"}
    made = bpy.context.scene.fewview.result
    assert made.parent is not None
    for camera in [other for other in bpy.data.objects if other.type == "CAMERA"]:
        bpy.data.objects.remove(camera)
    return made


@pytest.fixture
def started(part: Part, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, ...]]:
    """Commands of jobs, which are not run."""
    commands: list[tuple[str, ...]] = []
    monkeypatch.setattr(part("jobs"), "start", lambda _, command, **__: commands.append(command))
    monkeypatch.setattr(part("jobs"), "follow", lambda _: {"FINISHED"})
    return commands


def job_of(result: Any) -> Path:
    return Path(result["fewview_job"])


def world_points(result: Any) -> list[Any]:
    bpy.context.view_layer.update()
    return [result.matrix_world @ vertex.co for vertex in result.data.vertices]


def camera(name: str, points: list[Any], towards: tuple[float, float, float], **lens: Any) -> Any:
    """A selected camera that looks at the points from this direction, a little askew."""
    made = bpy.data.objects.new(name, bpy.data.cameras.new(name))
    bpy.context.scene.collection.objects.link(made)
    middle = sum(points, Vector()) / len(points)
    size = max((point - middle).length for point in points)
    turn = Vector(towards).to_track_quat("Z", "Y") @ Euler((0.02, -0.03, 0.4)).to_quaternion()
    place = middle + 5 * size * Vector(towards).normalized()
    made.matrix_world = Matrix.LocRotScale(place, turn, Vector((3, 3, 3)))  # its scale does not count
    for key, value in lens.items():
        setattr(made.data, key, value)
    made.select_set(True)
    bpy.context.view_layer.update()
    return made


def seen_by_blender(made: Any, points: list[Any]) -> np.ndarray:
    """(points, 2): column and row in the rendered picture."""
    render = bpy.context.scene.render
    share = np.array([world_to_camera_view(bpy.context.scene, made, point)[:2] for point in points])
    size = np.array([render.resolution_x, render.resolution_y]) * render.resolution_percentage / 100
    return np.stack([share[:, 0], 1 - share[:, 1]], axis=1) * size


def seen_by_the_job(frame: dict[str, Any]) -> np.ndarray:
    """(corners, 2): column and row, by the definition of a pinhole."""
    points = np.append(CORNERS, np.ones((len(CORNERS), 1)), axis=1)
    x, y, z = (points @ np.linalg.inv(frame["transform_matrix"]).T).T[:3]
    return np.stack([frame["cx"] + frame["fl_x"] * x / -z, frame["cy"] - frame["fl_y"] * y / -z], axis=1)


def frames(folder: Path) -> list[dict[str, Any]]:
    return json.loads((folder / "transforms.json").read_text(encoding="utf-8"))["frames"]


# Where the result may have gone.


def stay(_: Any) -> None:
    pass


def move_root(result: Any) -> None:
    result.parent.matrix_world = MOVE @ result.parent.matrix_world


def move_mesh(result: Any) -> None:
    result.matrix_world = MOVE


def move_both(result: Any) -> None:
    move_root(result)
    bpy.context.view_layer.update()
    result.matrix_world = MOVE @ result.matrix_world


def apply_transform(result: Any) -> None:
    """The mesh takes the transform over, and the object does not tell it any more."""
    result.matrix_world = MOVE
    result.select_set(True)
    bpy.ops.object.transform_apply()
    assert np.ptp([vertex.co for vertex in result.data.vertices], axis=0).min() > 2.5
    move_root(result)


def unparent(result: Any) -> None:
    """Without keeping the transform: it jumps, and what it jumps to is what counts."""
    move_root(result)
    result.parent = None


@pytest.mark.parametrize("place", [stay, move_root, move_mesh, move_both, apply_transform, unparent])
def test_cameras_are_written_as_the_job_has_them(
    result: Any, started: list[tuple[str, ...]], place: Callable[[Any], None]
) -> None:
    place(result)
    points = world_points(result)
    made = camera("Camera", points, (1, -2, 0.5))
    assert bpy.ops.fewview.render_novel_views() == {"FINISHED"}
    folder = job_of(result) / "novel-views-001"
    found = frames(folder)
    assert [frame["file_path"] for frame in found] == ["images/Camera.png"]
    np.testing.assert_allclose(seen_by_the_job(found[0]), seen_by_blender(made, points), atol=0.01)
    job, cameras, images = job_of(result) / "result", folder / "transforms.json", folder / "images"
    words = ("--cameras", str(cameras), "--output", str(images), "--device", "auto", "--wire")
    assert started[0][-8:] == (str(job), *words)


def test_a_remeshed_result_is_where_it_was(result: Any, started: list[tuple[str, ...]]) -> None:
    """Its vertices are others, so what the import has kept is asked."""
    move_both(result)
    points = world_points(result)
    assert bpy.ops.fewview.remesh(voxel_size=0.1) == {"FINISHED"}
    assert len(result.data.vertices) > 100
    made = camera("Camera", points, (1, -2, 0.5))
    assert bpy.ops.fewview.render_novel_views() == {"FINISHED"}
    found = frames(job_of(result) / "novel-views-001")
    np.testing.assert_allclose(seen_by_the_job(found[0]), seen_by_blender(made, points), atol=0.01)


SCENES = [
    pytest.param((640, 480, 100, 1, 1), {}, id="plain"),
    pytest.param((400, 600, 50, 1, 1), {"sensor_fit": "AUTO", "shift_y": 0.2}, id="portrait"),
    pytest.param((640, 480, 100, 1.5, 1), {"sensor_fit": "VERTICAL", "shift_x": -0.1}, id="wide pixels"),
    pytest.param((640, 480, 25, 1, 2), {"sensor_fit": "HORIZONTAL", "sensor_width": 20}, id="high pixels"),
]


@pytest.mark.parametrize(("raster", "lens"), SCENES)
def test_lens_and_resolution_are_the_scenes(
    result: Any, started: list[tuple[str, ...]], raster: tuple[Any, ...], lens: dict[str, Any]
) -> None:
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = raster[:3]
    render.pixel_aspect_x, render.pixel_aspect_y = raster[3:]
    points = world_points(result)
    made = camera("Camera", points, (-1, -1, 1), **lens)
    assert bpy.ops.fewview.render_novel_views() == {"FINISHED"}
    frame = frames(job_of(result) / "novel-views-001")[0]
    assert (frame["w"], frame["h"]) == tuple(side * raster[2] // 100 for side in raster[:2])
    np.testing.assert_allclose(seen_by_the_job(frame), seen_by_blender(made, points), atol=0.01)


# Which cameras, and what their pictures are called.


def test_the_selected_cameras_else_the_scenes(result: Any, started: list[tuple[str, ...]]) -> None:
    points = world_points(result)
    for name in ("a", "b", "c"):
        camera(name, points, (1, 0, 0)).select_set(name != "b")
    bpy.context.scene.camera = bpy.data.objects["b"]
    parent = job_of(result)

    def written(number: int, **words: str) -> list[str]:
        assert bpy.ops.fewview.render_novel_views(**words) == {"FINISHED"}
        return [frame["file_path"] for frame in frames(parent / f"novel-views-{number:03d}")]

    assert written(1) == ["images/a.png", "images/c.png"]
    assert written(2, cameras="c\n b ") == ["images/c.png", "images/b.png"]
    for made in bpy.context.selected_objects:
        made.select_set(False)
    assert written(3) == ["images/b.png"]


def test_a_linked_camera_of_the_same_name_is_another_one(
    result: Any, started: list[tuple[str, ...]], tmp_path: Path
) -> None:
    points = world_points(result)
    other = camera("Camera", points, (0, 0, 1))
    bpy.data.libraries.write(str(tmp_path / "other.blend"), {other}, fake_user=True)
    bpy.data.objects.remove(other)
    with bpy.data.libraries.load(str(tmp_path / "other.blend"), link=True) as (_, wanted):
        wanted.objects = ["Camera"]
    (linked,) = wanted.objects
    bpy.context.scene.collection.objects.link(linked)
    own = camera("Camera", points, (1, 0, 0))
    assert own.name == linked.name
    assert bpy.ops.fewview.render_novel_views(cameras=f"{linked.name_full}\nCamera") == {"FINISHED"}
    written = frames(job_of(result) / "novel-views-001")
    assert [frame["file_path"] for frame in written] == ["images/Camera.png", "images/Camera_2.png"]
    for made, frame in zip((linked, own), written, strict=True):
        np.testing.assert_allclose(seen_by_the_job(frame), seen_by_blender(made, points), atol=0.05)


def test_pictures_have_names_that_any_disk_can_keep(result: Any, started: list[tuple[str, ...]]) -> None:
    for name in ("Camera.001", "camera_001", "../up", "Büste"):
        camera(name, world_points(result), (1, 0, 0))
    bpy.ops.fewview.render_novel_views(cameras="Camera.001\ncamera_001\n../up\nBüste")
    names = [frame["file_path"] for frame in frames(job_of(result) / "novel-views-001")]
    assert names == [f"images/{name}.png" for name in ("Camera_001", "camera_001_2", "___up", "Büste")]


def test_the_longest_names_of_blender_are_cut(result: Any, started: list[tuple[str, ...]]) -> None:
    """With its ending a name of 255 bytes, as Blender has them from 5.0 on, is longer than a disk takes."""
    points = world_points(result)
    for _ in range(2):
        camera("日" * 85, points, (1, 0, 0))
    bpy.ops.fewview.render_novel_views()
    names = [Path(frame["file_path"]).name for frame in frames(job_of(result) / "novel-views-001")]
    assert len(set(names)) == 2
    assert max(len(name.encode()) for name in names) <= 255


def test_another_output_folder(result: Any, started: list[tuple[str, ...]], tmp_path: Path) -> None:
    camera("Camera", world_points(result), (1, 0, 0))
    bpy.ops.fewview.render_novel_views(output=str(tmp_path / "mine"), device="cpu")
    assert len(frames(tmp_path / "mine" / "novel-views-001")) == 1
    assert started[0][-3:] == ("--device", "cpu", "--wire")
    assert not (job_of(result) / "novel-views-001").exists()


# What cannot be rendered.


def stretch(result: Any) -> None:
    result.scale = (1, 1, 2)


def mirror(result: Any) -> None:
    result.scale = (-1, 1, 1)


def apply_stretch(result: Any) -> None:
    result.scale = (1, 1, 2)
    result.select_set(True)
    bpy.ops.object.transform_apply()


def make_parallel(_: Any) -> None:
    bpy.data.objects["Camera"].data.type = "ORTHO"


def deselect(_: Any) -> None:
    bpy.data.objects["Camera"].select_set(False)


def damage(result: Any) -> None:
    (job_of(result) / "result" / "mesh.ply").write_bytes(b"ply")


@pytest.mark.parametrize(
    ("harm", "words"),
    [
        (stretch, "one positive scale"),
        (mirror, "one positive scale"),
        (apply_stretch, "another shape than the job's mesh: import it again"),
        (make_parallel, "Camera is no perspective camera"),
        (deselect, "No camera is selected, and the scene has none"),
        (damage, "mesh.ply is not a PLY file"),
    ],
)
def test_what_cannot_be_rendered_is_told(
    result: Any, started: list[tuple[str, ...]], harm: Callable[[Any], None], words: str
) -> None:
    camera("Camera", world_points(result), (1, 0, 0))
    harm(result)
    with pytest.raises(RuntimeError, match=words):
        bpy.ops.fewview.render_novel_views()
    assert started == []
    assert not list(job_of(result).glob("novel-views*"))


def test_without_cameras_or_files_there_is_nothing_to_press(
    result: Any, started: list[tuple[str, ...]]
) -> None:
    with pytest.raises(RuntimeError, match="Add a camera first"):
        bpy.ops.fewview.render_novel_views()
    camera("Camera", world_points(result), (1, 0, 0))
    with pytest.raises(RuntimeError, match="There is no camera Kamera in the scene"):
        bpy.ops.fewview.render_novel_views(cameras="Kamera")
    (job_of(result) / "result" / "mesh.ply").unlink()
    with pytest.raises(RuntimeError, match="The files of the job are gone"):
        bpy.ops.fewview.render_novel_views()
    (job_of(result) / "result" / "radiance.npz").touch()  # a field can be rendered without the mesh
    assert bpy.ops.fewview.render_novel_views() == {"FINISHED"}
    bpy.context.scene.collection.objects.unlink(result)
    with pytest.raises(RuntimeError, match="Reconstruct first"):
        bpy.ops.fewview.render_novel_views()


def test_it_does_not_wait_in_a_window_and_can_be_cancelled(
    result: Any, part: Part, monkeypatch: pytest.MonkeyPatch
) -> None:
    jobs, command = part("jobs"), part("operators.novel_views").backend_command
    monkeypatch.setattr(
        part("operators.novel_views"),
        "backend_command",
        lambda python, *_: command(python, "rehearse", "--seconds", "60"),
    )
    monkeypatch.setattr(jobs, "follow", lambda _: {"FINISHED"})
    camera("Camera", world_points(result), (1, 0, 0))
    assert bpy.ops.fewview.render_novel_views() == {"FINISHED"}
    assert jobs.running().title == "Rendering novel views"
    assert not bpy.ops.fewview.render_novel_views.poll()
    bpy.ops.fewview.cancel()
    deadline = time.monotonic() + 20.0
    while jobs.running() is not None:
        assert time.monotonic() < deadline
        jobs._tick()
        time.sleep(0.02)
    assert jobs.ended().cancelled
    assert [image.name for image in bpy.data.images] == ["FewView Texture"]


# The pictures themselves.


@pytest.mark.slow
@needs_python
def test_pictures_show_the_result_where_blender_sees_it(result: Any, part: Part) -> None:
    """A tetrahedron's silhouette are its projected triangles, and each face has its colour in the texture."""
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = 320, 480, 50
    render.pixel_aspect_x, render.pixel_aspect_y = 1.25, 1.0
    move_both(result)
    points = world_points(result)
    cameras = [
        camera("Front", points, (1, -2, 0.5)),
        camera("Long.001", points, (-1, 1, 2), lens=45, shift_x=0.15, sensor_fit="VERTICAL"),
    ]
    bpy.ops.ed.undo_push(message="before")
    assert bpy.ops.fewview.render_novel_views(device="cpu") == {"FINISHED"}
    folder = job_of(result) / "novel-views-001" / "images"
    pictures = [image.filepath for image in bpy.data.images if image.name != "FewView Texture"]
    assert sorted(pictures) == [str(folder / "Front.png"), str(folder / "Long_001.png")]
    assert part("jobs").ended().notes == (f"2 pictures in the list of the Image Editor and in {folder}",)
    for made, name in zip(cameras, ("Front.png", "Long_001.png"), strict=True):
        check_picture(bpy.data.images[name], seen_by_blender(made, points), made, points)
    bpy.ops.ed.undo()
    assert [image.name for image in bpy.data.images] == ["FewView Texture"]


def check_picture(image: Any, corners: np.ndarray, made: Any, points: list[Any]) -> None:
    width, height = image.size
    assert (width, height) == (160, 240)
    stored = 255 * np.array(image.pixels, np.float32).reshape(height, width, 4)[::-1]
    rows, columns = np.mgrid[:height, :width] + 0.5
    inside, certain = np.zeros((height, width), bool), np.ones((height, width), bool)
    for face in FACES:
        sides = [side_of(columns, rows, corners[face[k]], corners[face[k - 1]]) for k in range(3)]
        inside |= (np.min(sides, axis=0) > 0) | (np.max(sides, axis=0) < 0)
        certain &= np.min(np.abs(sides), axis=0) > 0.05
    assert 0.1 < inside.mean() < 0.6
    assert certain.mean() > 0.9
    np.testing.assert_array_equal(stored[..., 3][certain], 255 * inside[certain])
    num_seen = 0
    for number, face in enumerate(FACES):
        a, b, c = (np.array(points[k]) for k in face)
        middle = (a + b + c) / 3
        if np.dot(np.cross(b - a, c - a), np.array(made.matrix_world.translation) - middle) > 0:
            num_seen += 1
            column, row = seen_by_blender(made, [Vector(middle)])[0].astype(int)
            np.testing.assert_allclose(stored[row, column, :3], SIDES[number], atol=1)
    assert num_seen


def side_of(columns: np.ndarray, rows: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Signed distance from the line through two points, in pixels."""
    (x, y), (dx, dy) = start, (end - start) / np.linalg.norm(end - start)
    return (columns - x) * dy - (rows - y) * dx


MAKE_FIELD = """
import sys
import numpy as np
import torch
from pathlib import Path
from backend.records import save_record
from backend.scene import Region
from backend.stages.published.radiance_field import RadianceField, kept
from backend.stages.radiance import Radiance, RadianceShape

shape = RadianceShape(width=16, layers=2, proposal_width=8, proposal_intervals=8, intervals=6)
field = RadianceField(shape, torch.Generator().manual_seed(0))
region = Region(object_from_world=np.load(sys.argv[1]))
save_record(Path(sys.argv[2]), kept(field, region, torch.tensor([0.0, 1.0, 0.0])), Radiance)
"""
"""A field that has learned nothing, before green."""
ASK_FIELD = """
import sys
import numpy as np
import torch
from pathlib import Path
from backend.maths.radiance import composite
from backend.records import load_record
from backend.stages.published.radiance_field import restored, sample_rays
from backend.stages.radiance import Radiance

radiance = load_record(Path(sys.argv[2]), Radiance)
rays = [torch.from_numpy(part).float() for part in np.load(sys.argv[1])]
with torch.no_grad():
    samples = sample_rays(restored(radiance, torch.device("cpu")), *rays, None)
    behind = torch.from_numpy(radiance.background_srgb)[None]
    np.save(sys.argv[3], composite(samples.log_pass, samples.colour, behind).numpy())
"""
"""The colours of rays, which are given in the region's frame."""


def with_torch(program: str, *words: Path) -> None:
    """Run in the Python of the backend."""
    command = [os.environ["FEWVIEW_PYTHON"], "-c", program, *map(str, words)]
    root = Path(__file__).resolve().parents[2]
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    subprocess.run(command, cwd=root, check=True, timeout=200, env=environment)


def blender_rays(made: Any) -> tuple[np.ndarray, np.ndarray]:
    """Origin, and (height, width, 3) directions, of a ray through each pixel's middle, as Blender draws."""
    render = bpy.context.scene.render
    width, height = (
        side * render.resolution_percentage // 100 for side in (render.resolution_x, render.resolution_y)
    )
    frame = np.array(made.data.view_frame(scene=bpy.context.scene))  # right above, right below, left below
    across = (frame[1] - frame[2]) * ((np.arange(width) + 0.5) / width)[:, None]
    down = (frame[1] - frame[0]) * ((np.arange(height) + 0.5) / height)[:, None, None]
    turn = np.array(made.matrix_world.to_quaternion().to_matrix())
    return np.array(made.matrix_world.translation), (frame[3] + across + down) @ turn.T


@pytest.mark.slow
@needs_python
def test_a_radiance_field_is_seen_as_from_blenders_cameras(result: Any, tmp_path: Path) -> None:
    """Every pixel is what the field says of the ray that Blender sends through it."""
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = 96, 64, 50
    render.pixel_aspect_x, render.pixel_aspect_y = 1.25, 1.0
    move_both(result)
    region_from_job = np.diag([0.8, 0.8, 0.8, 1.0])
    region_from_job[:3, 3] = (-0.3, 0.2, 0.1)
    np.save(tmp_path / "region.npy", region_from_job)
    field = job_of(result) / "result" / "radiance.npz"
    with_torch(MAKE_FIELD, tmp_path / "region.npy", field)
    made = camera("Camera", world_points(result), (1, -2, 0.5), shift_x=0.1)
    assert bpy.ops.fewview.render_novel_views(device="cpu") == {"FINISHED"}

    corners_in_world, corners_in_job = (
        np.append(corners, np.ones((4, 1)), axis=1).T for corners in (world_points(result), CORNERS)
    )
    region_from_world = region_from_job @ corners_in_job @ np.linalg.inv(corners_in_world)
    position, directions = blender_rays(made)
    origin = region_from_world[:3, :3] @ position + region_from_world[:3, 3]
    towards = directions.reshape(-1, 3) @ region_from_world[:3, :3].T
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    np.save(tmp_path / "rays.npy", np.stack([np.broadcast_to(origin, towards.shape), towards]))
    with_torch(ASK_FIELD, tmp_path / "rays.npy", field, tmp_path / "colours.npy")
    expected = 255 * np.load(tmp_path / "colours.npy").reshape(directions.shape)
    image = bpy.data.images["Camera.png"]
    width, height = image.size
    assert (height, width) == directions.shape[:2] == (32, 48)
    found = 255 * np.array(image.pixels, np.float32).reshape(height, width, 4)[::-1, :, :3]
    outside = (expected == (0, 255, 0)).all(axis=-1)
    assert 0.2 < outside.mean() < 0.9
    np.testing.assert_allclose(found, expected, atol=1.5)
    assert np.abs(found[:, ::-1] - expected).max() > 20, "a mirrored picture would be noticed"
