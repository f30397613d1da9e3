"""Solved cameras in the scene: where they stand, what they show, and what stays the user's."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="needs Blender's Python, where `import bpy` works")

from bpy_extras.object_utils import world_to_camera_view  # noqa: E402
from mathutils import Matrix, Vector  # noqa: E402

pytestmark = pytest.mark.blender
LENS = {"w": 320, "h": 240, "fl_x": 400.0, "fl_y": 400.0, "cx": 170.0, "cy": 110.0}


def pose(rng: np.random.Generator) -> Any:
    """(4, 4): a random rotation and translation."""
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    matrix[:3, 3] = rng.normal(size=3) * 3
    return matrix


def looking_at_origin(part: Any, count: int = 3) -> list[Any]:
    layout = part("view_layout")
    angles = np.linspace(-0.6, 0.6, count)
    places = [np.array([5 * np.sin(a), -5 * np.cos(a), 1.0]) for a in angles]
    return [layout.world_from_camera_looking_at(place, np.zeros(3)) for place in places]


def write_ply(path: Path, positions: Any, colours: Any) -> None:
    """In the backend's dialect for points."""
    names = "".join(f"property double {axis}\n" for axis in "xyz")
    names += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(positions)}\n{names}end_header\n"
    record = np.zeros(len(positions), [("p", "<f8", 3), ("c", "u1", 3)])
    record["p"], record["c"] = positions, colours
    path.write_bytes(header.encode() + record.tobytes())


@pytest.fixture
def job(part: Any, tmp_path: Path) -> Path:
    """A job's folder with two placed photographs, one that is not, and four points."""
    return make_job(part, tmp_path / "reconstruct-001", estimated=True)


def make_job(part: Any, folder: Path, *, estimated: bool, names: Any = ("a.png", "b.png", "c.png")) -> Path:
    (folder / "result").mkdir(parents=True, exist_ok=True)
    for name in names[:2]:
        image = bpy.data.images.new(name, 320, 240)
        image.filepath_raw, image.file_format = str(folder / name), "PNG"
        image.save()
        bpy.data.images.remove(image)
    frames = [
        {"file_path": name, **LENS, "transform_matrix": matrix.tolist()}
        for name, matrix in zip(names, looking_at_origin(part), strict=False)
    ]
    ours = {
        "estimated": estimated,
        "reprojection_error_px": 0.5,
        "region": {"centre_world": [0, 0, 0], "radius_world": 0.5},
        "unplaced": [{"name": "d.png", "why": "It is blurred"}],
    }
    content = {"frames": frames, "fewview": ours}
    (folder / "result/cameras.json").write_text(json.dumps(content), encoding="utf-8")
    points = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    write_ply(
        folder / "result/sparse.ply", points, np.array([[255, 0, 0], [0, 128, 0], [0, 0, 1], [9, 9, 9]])
    )
    protocol = part("job_folder")
    wanted = protocol.Job(protocol=1, images=(str(folder),), output="result", until="cameras")
    protocol.write_job(folder, wanted)
    return folder


def by_role(role: str) -> list[Any]:
    found = [made for made in bpy.context.scene.objects if made.get("fewview_role") == role]
    return sorted(found, key=lambda made: made.get("fewview_photo", ""))


def import_cameras(folder: Path) -> None:
    assert bpy.ops.fewview.import_cameras(folder=str(folder)) == {"FINISHED"}
    bpy.context.view_layer.update()


# Lenses


@pytest.mark.parametrize("seed", range(40))
def test_any_camera_as_pinhole_agrees_with_blender(part: Any, seed: int) -> None:
    """To 0.01 px with `world_to_camera_view`, for all sensor fits, aspects, shifts and shapes."""
    rng = np.random.default_rng(seed)
    scene = bpy.context.scene
    width, height = (int(side) for side in rng.integers(100, 4000, 2))
    scene.render.resolution_x, scene.render.resolution_y = width, height
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = rng.uniform(1.0, 2.0, 2)
    camera = bpy.data.objects.new("any", bpy.data.cameras.new("any"))
    scene.collection.objects.link(camera)
    data = camera.data
    data.sensor_fit = str(rng.choice(["AUTO", "HORIZONTAL", "VERTICAL"]))
    data.sensor_width, data.sensor_height = rng.uniform(5, 50, 2)
    data.lens, (data.shift_x, data.shift_y) = rng.uniform(5, 200), rng.uniform(-0.5, 0.5, 2)
    camera.matrix_world = Matrix(pose(rng).tolist()) @ Matrix.Scale(rng.uniform(0.1, 5), 4)
    bpy.context.view_layer.update()
    pinhole = part("camera_lens").pinhole_of(scene, camera)
    matrix = part("camera_lens").world_from_camera(camera)
    for _ in range(20):
        in_camera = np.array([*rng.uniform(-0.3, 0.3, 2), -1.0]) * rng.uniform(0.5, 10)
        point = matrix[:3, :3] @ in_camera + matrix[:3, 3]
        share = world_to_camera_view(scene, camera, Vector(point))
        x, y, z = in_camera
        found = (pinhole.cx_px + pinhole.fx_px * x / -z, pinhole.cy_px - pinhole.fy_px * y / -z)
        scale = max(width, height, abs(found[0]), abs(found[1])) / 1000  # float32 of far-off points
        assert found == pytest.approx((share.x * width, (1 - share.y) * height), abs=0.01 * max(scale, 1))


@pytest.mark.parametrize("percentage", [100, 33, 250])
@pytest.mark.parametrize("seed", range(6))
def test_the_pinhole_is_blenders_projection_matrix(part: Any, seed: int, percentage: int) -> None:
    """Also where the percentage cuts off fractions of pixels."""
    rng = np.random.default_rng(seed)
    scene = bpy.context.scene
    render = scene.render
    render.resolution_x, render.resolution_y = (int(side) for side in rng.integers(100, 2000, 2))
    render.resolution_percentage = percentage
    render.pixel_aspect_x, render.pixel_aspect_y = 1.0, rng.uniform(1.0, 2.0)
    camera = bpy.data.objects.new("any", bpy.data.cameras.new("any"))
    scene.collection.objects.link(camera)
    camera.data.sensor_fit = ("AUTO", "HORIZONTAL", "VERTICAL")[seed % 3]
    camera.data.shift_x, camera.data.shift_y = rng.uniform(-0.3, 0.3, 2)
    pinhole = part("camera_lens").pinhole_of(scene, camera)
    depsgraph = bpy.context.evaluated_depsgraph_get()
    matrix = np.array(
        camera.calc_matrix_camera(
            depsgraph,
            x=pinhole.width,
            y=pinhole.height,
            scale_x=render.pixel_aspect_x,
            scale_y=render.pixel_aspect_y,
        )
    )
    width, height = pinhole.width, pinhole.height
    assert pinhole.fx_px == pytest.approx(matrix[0, 0] * width / 2, rel=1e-5)
    assert pinhole.fy_px == pytest.approx(matrix[1, 1] * height / 2, rel=1e-5)
    assert pinhole.cx_px == pytest.approx(width / 2 * (1 - matrix[0, 2]), abs=0.01)
    assert pinhole.cy_px == pytest.approx(height / 2 * (1 + matrix[1, 2]), abs=0.01)


@pytest.mark.parametrize("seed", range(20))
def test_a_pinhole_becomes_a_camera_that_sees_the_same(part: Any, seed: int) -> None:
    """fx != fy and the principal point anywhere."""
    rng = np.random.default_rng(seed)
    intrinsics, scene = part("intrinsics"), bpy.context.scene
    width, height = (int(side) for side in rng.integers(100, 4000, 2))
    fx = float(width * rng.uniform(0.3, 5))
    pinhole = intrinsics.Pinhole(
        fx_px=fx,
        fy_px=fx * rng.uniform(0.6, 1.6),
        cx_px=width * rng.uniform(0.2, 0.8),
        cy_px=height * rng.uniform(0.2, 0.8),
        width=width,
        height=height,
    )
    render = scene.render
    render.resolution_x, render.resolution_y = width, height
    render.pixel_aspect_x, render.pixel_aspect_y = intrinsics.aspect_pair(pinhole.pixel_aspect)
    camera = bpy.data.objects.new("any", bpy.data.cameras.new("any"))
    scene.collection.objects.link(camera)
    part("camera_lens").apply_lens(camera.data, pinhole, pixel_aspect=pinhole.pixel_aspect)
    bpy.context.view_layer.update()
    for _ in range(20):
        column, row = rng.uniform(0, width), rng.uniform(0, height)
        x, y = (column - pinhole.cx_px) / pinhole.fx_px, -(row - pinhole.cy_px) / pinhole.fy_px
        share = world_to_camera_view(scene, camera, Vector((x, y, -1)) * 3)
        assert (share.x * width, (1 - share.y) * height) == pytest.approx((column, row), abs=0.01)


# Import


def test_known_cameras_stand_where_they_are_said_to(part: Any, tmp_path: Path) -> None:
    job = make_job(part, tmp_path / "job", estimated=False)
    import_cameras(job)
    cameras = by_role("camera")
    assert [camera["fewview_photo"] for camera in cameras] == ["a.png", "b.png", "c.png"]
    for camera, expected in zip(cameras, looking_at_origin(part), strict=True):
        np.testing.assert_allclose(np.array(camera.matrix_world), expected, atol=1e-6)
        assert camera.parent is None
    assert (bpy.context.scene.fewview.root, by_role("root")) == (None, [])
    assert bpy.context.scene.fewview.cameras_job == str(job)


def test_estimated_cameras_hang_on_a_root_that_places_them_upright(part: Any, job: Path) -> None:
    import_cameras(job)
    (root,) = by_role("root")
    assert bpy.context.scene.fewview.root == root
    np.testing.assert_array_equal(np.array(root.matrix_world), np.eye(4))  # for the user to move
    world_from_solved = part("camera_objects").world_from_solved(root)
    for camera, solved in zip(by_role("camera"), looking_at_origin(part), strict=True):
        expected = world_from_solved @ solved
        expected[:3, :3] /= 2  # a camera keeps its own size
        np.testing.assert_allclose(np.array(camera.matrix_world), expected, atol=1e-5)
        found = part("camera_lens").world_from_camera(camera)
        np.testing.assert_allclose(found[:3, 3], (world_from_solved @ solved)[:3, 3], atol=1e-5)
    (points,) = by_role("points")
    np.testing.assert_allclose(np.array(points.matrix_world), world_from_solved, atol=1e-6)
    scale = np.cbrt(np.linalg.det(world_from_solved[:3, :3]))
    assert scale == pytest.approx(2.0)  # the region's radius of 0.5 becomes 1 m


def test_the_scenes_frame_is_the_photographs(part: Any, job: Path) -> None:
    """The imported camera has the pinhole of the file."""
    import_cameras(job)
    assert bpy.ops.fewview.show_photograph(photograph="b.png") == {"FINISHED"}
    scene = bpy.context.scene
    assert scene.camera["fewview_photo"] == "b.png"
    pinhole = part("camera_lens").pinhole_of(scene, scene.camera)
    assert (pinhole.width, pinhole.height) == (320, 240)
    found = (pinhole.fx_px, pinhole.fy_px, pinhole.cx_px, pinhole.cy_px)
    assert found == pytest.approx((400, 400, 170, 110), abs=1e-3)


def test_photographs_are_behind_their_cameras(job: Path) -> None:
    import_cameras(job)
    first, _, third = by_role("camera")
    assert first.data.show_background_images
    assert Path(first.data.background_images[0].image.filepath) == job / "a.png"
    assert not third.data.background_images  # there is no such file


def test_a_photograph_that_blender_does_not_read_is_named_and_not_shown(part: Any, tmp_path: Path) -> None:
    job = make_job(part, tmp_path / "reconstruct-001", estimated=True, names=("a.heic", "b.png", "c.png"))
    import_cameras(job)
    first, second, _ = by_role("camera")
    assert not first.data.background_images
    assert second.data.background_images
    ours = part("camera_objects")
    lost, unread = ours.problems(ours.read_import(job, (job,)))
    assert "Not found" in lost
    assert "c.png" in lost
    assert "Blender does not read" in unread
    assert "a.heic" in unread


def test_photographs_that_were_turned_in_the_camera_are_turned_back(part: Any, job: Path) -> None:
    """EXIF says 90 degrees clockwise; Blender fits the picture before it turns it."""
    import_cameras(job)
    assert by_role("camera")[0].data.background_images[0].rotation == 0.0
    tag = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0"
    (job / "a.png").write_bytes(b"\xff\xd8\xff\xe1\0\x22Exif\0\0" + tag)
    import_cameras(job)
    background = by_role("camera")[0].data.background_images[0]
    assert background.rotation == pytest.approx(np.pi / 2)
    assert background.scale == pytest.approx(320 / 240)


def test_sizes_follow_the_root(job: Path) -> None:
    """The subject, of 1 m radius in the world, lies within the clipping range."""
    import_cameras(job)
    for camera in by_role("camera"):
        distance = camera.matrix_world.translation.length
        assert 0 < camera.data.clip_start < 0.05 * distance
        assert camera.data.clip_end == pytest.approx(2 * distance + 100, rel=0.01)
        assert camera.data.display_size == pytest.approx(0.3)


def test_points_have_their_colours(job: Path) -> None:
    import_cameras(job)
    (points,) = by_role("points")
    mesh = points.data
    assert len(mesh.vertices) == 4
    np.testing.assert_allclose(mesh.vertices[1].co, (0.1, 0, 0), atol=1e-7)
    colours = np.array([value.color_srgb for value in mesh.color_attributes[0].data]) * 255
    np.testing.assert_allclose(colours[:2], [[255, 0, 0, 255], [0, 128, 0, 255]], atol=0.6)
    assert points.hide_render


def test_importing_again_replaces_in_place(part: Any, job: Path) -> None:
    scene = bpy.context.scene
    own = bpy.data.objects.new("a", bpy.data.cameras.new("a"))
    scene.collection.objects.link(own)
    import_cameras(job)
    first = {made.name for made in scene.objects}
    (root,) = by_role("root")
    root.location, own.parent = (7, 0, 0), by_role("camera")[2]
    by_role("camera")[0].location = (0, 0, 0)
    by_role("camera")[0].matrix_parent_inverse = Matrix.Translation((1, 2, 3))
    import_cameras(job)
    assert {made.name for made in scene.objects} == first
    assert root.location.x == 7  # as the user put it
    expected = part("camera_objects").world_from_solved(root) @ looking_at_origin(part)[0]
    expected[:3, :3] /= np.cbrt(np.linalg.det(expected[:3, :3]))
    np.testing.assert_allclose(np.array(by_role("camera")[0].matrix_world), expected, atol=1e-5)
    make_job(part, job, estimated=True, names=("a.png", "b.png"))
    import_cameras(job)
    assert [camera["fewview_photo"] for camera in by_role("camera")] == ["a.png", "b.png"]
    assert (own.name in scene.objects, own.parent) == (True, None)


def test_jobs_do_not_replace_each_other(part: Any, job: Path, tmp_path: Path) -> None:
    import_cameras(job)
    import_cameras(make_job(part, tmp_path / "reconstruct-002", estimated=True))
    assert len(by_role("camera")) == 6
    assert bpy.ops.fewview.remove_cameras() == {"FINISHED"}
    assert not list(bpy.context.scene.objects)
    assert not list(bpy.data.collections)
    with pytest.raises(RuntimeError, match="no imported cameras"):
        bpy.ops.fewview.remove_cameras()


def test_the_root_stays_while_something_hangs_on_it(job: Path) -> None:
    import_cameras(job)
    mesh = bpy.data.objects.new("mesh", bpy.data.meshes.new("mesh"))
    bpy.context.scene.collection.objects.link(mesh)
    (mesh.parent,) = by_role("root")
    bpy.ops.fewview.remove_cameras()
    assert mesh.parent == by_role("root")[0]
    assert not by_role("camera")


def test_an_import_is_one_undo_step(job: Path) -> None:
    bpy.ops.ed.undo_push(message="before")
    import_cameras(job)
    bpy.ops.ed.undo_push(message="import")  # in background Blender pushes none for operators of scripts
    bpy.ops.ed.undo()
    assert not list(bpy.context.scene.objects)
    bpy.ops.ed.redo()
    assert len(by_role("camera")) == 3


def test_an_undo_between_two_steps_of_an_import_is_survived(part: Any, job: Path) -> None:
    for message in ("start", "before"):
        bpy.ops.ed.undo_push(message=message)
    steps = part("operators.cameras").show_cameras("Scene", job, [])
    for _ in range(3):
        next(steps)
    bpy.ops.ed.undo()
    for _ in steps:
        pass
    bpy.context.view_layer.update()
    assert len(by_role("root")) == 1
    assert all(camera.parent == by_role("root")[0] for camera in by_role("camera"))


def test_pixels_that_are_not_square_are_the_scenes(part: Any, job: Path) -> None:
    path = job / "result/cameras.json"
    content = json.loads(path.read_text())
    for frame in content["frames"]:
        frame["fl_y"] = 320.0
    path.write_text(json.dumps(content))
    import_cameras(job)
    bpy.ops.fewview.show_photograph(photograph="a.png")
    scene = bpy.context.scene
    pinhole = part("camera_lens").pinhole_of(scene, scene.camera)
    found = (pinhole.fx_px, pinhole.fy_px, pinhole.cx_px, pinhole.cy_px)
    assert found == pytest.approx((400, 320, 170, 110), abs=1e-3)
    content["frames"][0]["fl_y"] = 400.0
    path.write_text(json.dumps(content))
    wanted = part("camera_objects").read_import(job, (job,))
    assert any("distorted" in text for text in part("camera_objects").problems(wanted))


def aspect(render: Any) -> tuple[float, float]:
    return render.pixel_aspect_x, render.pixel_aspect_y


def test_a_change_of_the_scenes_pixels_is_told(part: Any, job: Path) -> None:
    render = bpy.context.scene.render
    render.pixel_aspect_x, render.pixel_aspect_y = 1.0, 1.5
    told: list[str] = []
    for _ in part("operators.cameras").show_cameras("Scene", job, told):
        pass
    assert aspect(render) == (1.0, 1.0)
    assert any("pixel aspect was 1 : 1.5 and is now 1 : 1" in text for text in told)


def test_square_pixels_of_another_kind_stay(part: Any, job: Path) -> None:
    """Two numbers that are alike say the same, whichever they are."""
    render = bpy.context.scene.render
    render.pixel_aspect_x = render.pixel_aspect_y = 2.0
    told: list[str] = []
    for _ in part("operators.cameras").show_cameras("Scene", job, told):
        pass
    assert aspect(render) == (2.0, 2.0)
    assert not any("pixel aspect" in text for text in told)


def test_unplaced_photographs_are_marked_in_the_list(part: Any, job: Path) -> None:
    image = bpy.context.scene.fewview.images.add()
    image.path = str(job / "d.png")
    warnings: list[str] = []
    for _ in part("operators.cameras").show_cameras("Scene", job, warnings):
        pass
    assert image.problem == "It is blurred"
    assert "d.png could not be placed: It is blurred" in warnings


def test_what_cannot_be_imported_says_why_and_changes_nothing(job: Path) -> None:
    with pytest.raises(RuntimeError, match="no job folder"):
        bpy.ops.fewview.import_cameras()
    with pytest.raises(RuntimeError, match="cannot be read"):
        bpy.ops.fewview.import_cameras(folder=str(job / "nowhere"))
    (job / "result/sparse.ply").write_bytes(b"ply\nnonsense")
    with pytest.raises(RuntimeError, match="sparse"):
        bpy.ops.fewview.import_cameras(folder=str(job))
    assert not list(bpy.context.scene.objects)


def test_photographs_are_found_by_name_and_folder(part: Any, tmp_path: Path) -> None:
    find = part("camera_objects").photograph_or_none
    for name in ("one/a.png", "two/a.png", "two/b.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    files = tuple(tmp_path / name for name in ("one/a.png", "two/a.png", "two/b.png"))
    assert find("b.png", files) == files[2]
    assert find("b.png", (tmp_path / "two",)) == files[2]
    assert find("two/a.png", files) == files[1]
    assert find("a.png", files) is None  # either
    assert find("../two/b.png", (tmp_path / "one",)) is None


def test_photographs_without_a_camera_cannot_be_looked_at(part: Any, job: Path) -> None:
    with pytest.raises(RuntimeError, match="Estimate the cameras first"):
        bpy.ops.fewview.show_photograph(photograph="a.png")
    import_cameras(job)
    with pytest.raises(RuntimeError, match=r"d\.png has no camera"):
        bpy.ops.fewview.show_photograph(photograph="d.png")
    with pytest.raises(RuntimeError, match="Choose a photograph"):
        bpy.ops.fewview.show_photograph()


# The job


@pytest.fixture
def backend(part: Any, job: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A stand-in for the backend that copies the job's results; its folder is the output."""
    script = tmp_path / "stand_in.py"
    script.write_text(
        "import json, pathlib, shutil, sys\n"
        "folder = pathlib.Path(sys.argv[1]).parent\n"
        f"shutil.copytree({str(job / 'result')!r}, folder / 'result')\n"
        "say = lambda **line: print(json.dumps(line), flush=True)\n"
        "say(type='hello', protocol=1, backend='x', python='x', pid=1)\n"
        "say(type='finished', output=str(folder / 'result'), files=['cameras.json', 'sparse.ply'])\n",
        encoding="utf-8",
    )
    cameras = part("operators.cameras")
    monkeypatch.setattr(cameras, "backend_python_or_reason", lambda _: (Path(sys.executable), ""))
    command = lambda _python, _verb, path: (sys.executable, str(script), path)  # noqa: E731
    monkeypatch.setattr(cameras, "backend_command", command)
    return tmp_path / "jobs"


def test_finding_cameras_ends_with_them_in_the_scene(part: Any, job: Path, backend: Path) -> None:
    bpy.ops.ed.undo_push(message="before")
    found = bpy.ops.fewview.estimate_cameras(images=str(job), output=str(backend), preset="fast", seed=3)
    assert found == {"FINISHED"}
    assert len(by_role("camera")) == 3
    folder = backend / "reconstruct-001"
    assert bpy.context.scene.fewview.cameras_job == str(folder)
    written = json.loads((folder / "job.json").read_text())
    assert written["images"] == [str(job)]
    assert (written["until"], written["preset"], written["seed"]) == ("cameras", "fast", 3)
    assert (written["cameras"], written["output"]) == (None, "result")
    bpy.ops.ed.undo()
    assert not by_role("camera")


def test_known_cameras_are_passed_on(job: Path, backend: Path) -> None:
    bpy.ops.fewview.estimate_cameras(
        images=str(job), output=str(backend), camera_source="KNOWN", cameras_path=str(job / "t.json")
    )
    written = json.loads((backend / "reconstruct-001/job.json").read_text())
    assert written["cameras"] == str(job / "t.json")


def test_what_is_missing_for_a_job_says_what_to_do(part: Any, job: Path, backend: Path) -> None:
    with pytest.raises(RuntimeError, match="no photographs"):
        bpy.ops.fewview.estimate_cameras(output=str(backend))
    with pytest.raises(RuntimeError, match="no file of known cameras"):
        bpy.ops.fewview.estimate_cameras(images=str(job), output=str(backend), camera_source="KNOWN")
    assert not backend.exists()


def test_without_a_backend_the_button_says_so(part: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(part("operators.cameras"), "backend_python_or_reason", lambda _: (None, "not set up"))
    with pytest.raises(RuntimeError, match="not set up"):
        bpy.ops.fewview.estimate_cameras()
