"""Rendered views: cameras around an object, exact intrinsics, a mask of the subject, and nothing changed."""

import importlib
import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="needs Blender's Python, where `import bpy` works")

from bpy_extras.object_utils import world_to_camera_view  # noqa: E402
from mathutils import Matrix, Vector  # noqa: E402

pytestmark = pytest.mark.blender
SMALL = {"resolution_x": 64, "resolution_y": 48, "samples": 1}


@pytest.fixture
def rendering(addon: ModuleType) -> ModuleType:
    return importlib.import_module(addon.__name__ + ".view_rendering")


@pytest.fixture
def cube(addon: ModuleType) -> Any:
    """A cube of 1 m beside the origin, on a floor, under a lamp."""
    bpy.context.scene.render.image_settings.file_format = "PNG"  # fills in what is empty before the first
    bpy.ops.mesh.primitive_plane_add(size=20.0, location=(0, 0, -0.5))
    bpy.context.object.name = "Floor"
    bpy.ops.object.light_add(type="SUN")
    bpy.ops.mesh.primitive_cube_add(size=1.0, location=(3, 1, 0))
    return bpy.context.object


def generate(**arguments: Any) -> list[Any]:
    assert bpy.ops.fewview.generate_views(**{"view_count": 3, **SMALL_SIZE, **arguments}) == {"FINISHED"}
    found = [made for made in bpy.data.objects if "fewview_view" in made]
    return sorted(found, key=lambda camera: camera["fewview_view"])


SMALL_SIZE = {key: value for key, value in SMALL.items() if key != "samples"}


def corners(made: Any) -> list[Any]:
    return [made.matrix_world @ Vector(corner) for corner in made.bound_box]


def pixels_rgba(path: Path) -> Any:
    """(height, width, 4), top row first, values as stored."""
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    width, height = image.size
    values = np.array(image.pixels, np.float32).reshape(height, width, 4)[::-1]
    bpy.data.images.remove(image)
    return values


def transforms(folder: Path) -> list[dict[str, Any]]:
    return json.loads((folder / "transforms.json").read_text(encoding="utf-8"))["frames"]


def projected(frame: dict[str, Any], point: Any) -> tuple[float, float]:
    """Column and row of a point, by the definition of a pinhole."""
    x, y, z = (np.linalg.inv(frame["transform_matrix"]) @ [*point, 1.0])[:3]
    return frame["cx"] + frame["fl_x"] * x / -z, frame["cy"] - frame["fl_y"] * y / -z


# Cameras


@pytest.mark.parametrize("kind", ["ARC", "RING", "HEMISPHERE"])
@pytest.mark.parametrize("size", [(64, 48), (48, 64)])
@pytest.mark.parametrize("aspect", [(1.0, 1.0), (2.0, 1.0), (1.0, 1.5)])
def test_generated_cameras_hold_the_object(cube: Any, kind: str, size: Any, aspect: Any) -> None:
    scene = bpy.context.scene
    render = scene.render
    render.pixel_aspect_x, render.pixel_aspect_y = aspect
    render.resolution_x, render.resolution_y = size
    cameras = generate(arrangement=kind, resolution_x=size[0], resolution_y=size[1])
    bpy.context.view_layer.update()
    seen = np.array([[world_to_camera_view(scene, c, p)[:2] for p in corners(cube)] for c in cameras])
    assert seen.min() > 0.03
    assert seen.max() < 0.97
    assert seen.max() > 0.85 or seen.min() < 0.15


def test_children_and_instances_are_held_too(cube: Any) -> None:
    bpy.ops.mesh.primitive_cube_add(size=0.2, location=(3, 1, 4))
    child = bpy.context.object
    child.parent = cube
    child.matrix_parent_inverse = cube.matrix_world.inverted()
    group = bpy.data.collections.new("group")
    bpy.ops.mesh.primitive_cube_add(size=0.2)
    group.objects.link(bpy.context.object)
    copy = bpy.data.objects.new("copy", None)
    copy.instance_type, copy.instance_collection, copy.location = "COLLECTION", group, (3, -5, 0)
    copy.parent = cube
    copy.matrix_parent_inverse = cube.matrix_world.inverted()
    bpy.context.scene.collection.objects.link(copy)
    cameras = generate(target=cube.name)
    bpy.context.scene.render.resolution_x, bpy.context.scene.render.resolution_y = 64, 48
    bpy.context.view_layer.update()
    for camera in cameras:
        for point in ((3, 1, 4.1), (3, -5.1, 0)):
            seen = world_to_camera_view(bpy.context.scene, camera, Vector(point))
            assert 0 < seen.x < 1
            assert 0 < seen.y < 1


def test_generating_again_replaces_what_was_generated_and_nothing_else(cube: Any) -> None:
    own = bpy.data.objects.new("own", bpy.data.cameras.new("own"))
    bpy.context.scene.collection.objects.link(own)
    first = generate()
    own.parent = first[0]
    names = {made.name for made in bpy.data.objects}
    bpy.context.view_layer.update()
    place = own.matrix_world.copy()
    generate()
    bpy.context.view_layer.update()
    np.testing.assert_allclose(own.matrix_world, place, atol=1e-5)
    assert {made.name for made in bpy.data.objects} == names
    assert own.parent is None
    assert len(generate(view_count=5)) == 5
    assert bpy.ops.fewview.remove_views() == {"FINISHED"}
    assert not [made for made in bpy.data.objects if "fewview_view" in made]
    assert not [made for made in bpy.data.collections if "fewview_view" in made]
    assert own.name in bpy.context.scene.objects
    with pytest.raises(RuntimeError, match="no generated cameras"):
        bpy.ops.fewview.remove_views()


def test_arguments_left_out_are_the_scenes_and_are_not_remembered(cube: Any) -> None:
    settings = bpy.context.scene.fewview
    settings.view_count, settings.lens_mm = 4, 85.0
    assert bpy.ops.fewview.generate_views(lens_mm=35.0) == {"FINISHED"}
    cameras = [made for made in bpy.data.objects if "fewview_view" in made]
    assert [camera.data.lens for camera in cameras] == [35.0] * 4
    assert bpy.ops.fewview.generate_views() == {"FINISHED"}
    cameras = [made for made in bpy.data.objects if "fewview_view" in made]
    assert [camera.data.lens for camera in cameras] == [85.0] * 4
    assert settings.target == cube
    for operator in (bpy.ops.fewview.generate_views, bpy.ops.fewview.render_views):
        arguments = [prop for prop in operator.get_rna_type().properties if prop.identifier != "rna_type"]
        assert all(prop.is_skip_save for prop in arguments)


def test_generating_around_nothing_says_why(addon: ModuleType) -> None:
    with pytest.raises(RuntimeError, match="Add an object"):
        bpy.ops.fewview.generate_views()
    bpy.ops.object.empty_add()
    with pytest.raises(RuntimeError, match="Empty: there is no visible surface; show it, or choose another"):
        bpy.ops.fewview.generate_views()
    with pytest.raises(RuntimeError, match="no object Moon"):
        bpy.ops.fewview.generate_views(target="Moon")


# Pictures


def test_rendered_views_are_exact_masked_and_taken_over(cube: Any, tmp_path: Path) -> None:
    """The subject's outline in the alpha is where its corners are by the file's cameras."""
    generate()
    assert bpy.ops.fewview.render_views(output=str(tmp_path), **SMALL) == {"FINISHED"}
    folder = tmp_path / "views-001"
    assert sorted(path.name for path in folder.iterdir()) == ["images", "transforms.json", "truth.ply"]
    frames = transforms(folder)
    assert [frame["file_path"] for frame in frames] == [f"images/00{i}.png" for i in range(3)]
    for frame in frames:
        alpha = pixels_rgba(folder / frame["file_path"])[..., 3]
        rows, columns = np.nonzero(alpha > 0.5)
        seen = np.array([projected(frame, corner) for corner in corners(cube)])
        edges = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        np.testing.assert_allclose(edges, [*seen.min(axis=0), *seen.max(axis=0)], atol=1.5)
        assert alpha[0].max() == 0.0
    settings = bpy.context.scene.fewview
    assert [(image.width, image.height, image.use) for image in settings.images] == [(64, 48, True)] * 3
    assert settings.images[0].path == str(folder / "images/000.png")
    assert (settings.source, settings.camera_source) == ("RENDER", "KNOWN")
    assert settings.cameras_path == str(folder / "transforms.json")
    assert settings.truth == str(folder / "truth.ply")


def test_what_came_with_rendered_views_goes_with_them(cube: Any, tmp_path: Path) -> None:
    """Else the photographs that come after them would be measured against the views' object."""
    generate(view_count=2)
    rendered(tmp_path / "jobs")
    settings = bpy.context.scene.fewview
    bpy.ops.fewview.clear_images()
    assert (settings.camera_source, settings.cameras_path, settings.truth) == ("ESTIMATE", "", "")
    rendered(tmp_path / "jobs")
    settings.cameras_path = settings.truth = str(tmp_path / "own")
    bpy.ops.fewview.clear_images()
    assert (settings.camera_source, settings.cameras_path) == ("KNOWN", settings.truth)


def test_where_nothing_can_be_written_says_what_to_do(cube: Any, tmp_path: Path) -> None:
    generate(view_count=2)
    (tmp_path / "file").touch()
    with pytest.raises(RuntimeError, match=r"jobs cannot be written \(.*\): choose another output folder"):
        bpy.ops.fewview.render_views(output=str(tmp_path / "file" / "jobs"))


def test_beside_a_file_that_is_not_saved_is_nowhere(
    part: Callable[[str], ModuleType], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A startup file may have such a setting; Blender would take the folder that it was started in."""
    jobs_parent = part("operators.reconstruct").jobs_parent
    monkeypatch.chdir(tmp_path)
    unset = jobs_parent(bpy.context)
    bpy.context.scene.fewview.output = "//jobs"
    assert jobs_parent(bpy.context) == unset
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "own.blend"))
    assert jobs_parent(bpy.context) == tmp_path / "jobs"


def test_a_second_rendering_gets_a_folder_of_its_own(cube: Any, tmp_path: Path) -> None:
    generate(view_count=2)
    for _ in range(2):
        bpy.ops.fewview.render_views(output=str(tmp_path), **SMALL)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["views-001", "views-002"]
    first, second = ((tmp_path / f"views-00{i}/images/000.png").read_bytes() for i in (1, 2))
    assert first == second
    assert not any(chunk in first for chunk in (b"tEXt", b"zTXt", b"iTXt", b"eXIf"))  # nothing of the user's


def test_without_a_target_everything_is_in_the_mask(cube: Any, tmp_path: Path) -> None:
    generate(view_count=2)
    bpy.ops.fewview.render_views(target="", output=str(tmp_path), **SMALL)
    assert not (tmp_path / "views-001/truth.ply").exists()
    assert pixels_rgba(tmp_path / "views-001/images/000.png")[-1, :, 3].min() > 0.99


def test_the_floor_still_lights_the_subject(cube: Any, tmp_path: Path) -> None:
    """A glowing floor that is not in the mask is seen in the colour of the cube."""
    bpy.data.objects["Sun"].hide_render = True
    glow = bpy.data.materials.new("glow")
    if glow.node_tree is None:  # before Blender 5.0 a new material has no nodes
        glow.use_nodes = True
    shader = next(node for node in glow.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    shader.inputs["Emission Color"].default_value = (1.0, 0.0, 0.0, 1.0)
    shader.inputs["Emission Strength"].default_value = 5.0
    bpy.data.objects["Floor"].data.materials.append(glow)
    generate(view_count=2)
    bpy.ops.fewview.render_views(output=str(tmp_path), **{**SMALL, "samples": 16})
    picture = pixels_rgba(tmp_path / "views-001/images/000.png")
    inside = picture[picture[..., 3] > 0.99]
    assert inside[:, 0].mean() > 0.2
    assert inside[:, 0].mean() > 3 * inside[:, 2].mean()


@pytest.mark.parametrize("percentage", [100, 50])
@pytest.mark.parametrize("fit", ["AUTO", "HORIZONTAL", "VERTICAL"])
def test_selected_cameras_have_their_own_lenses(cube: Any, tmp_path: Path, fit: str, percentage: int) -> None:
    """Off-centre, with high pixels, not the same in each: as `world_to_camera_view` has it to 0.01 px."""
    scene = bpy.context.scene
    scene.render.pixel_aspect_y = 1.25
    scene.render.resolution_percentage = percentage
    for lens, shift in ((35.0, (0.1, -0.05)), (50.0, (-0.2, 0.15))):
        camera = bpy.data.objects.new("mine", bpy.data.cameras.new("mine"))
        scene.collection.objects.link(camera)
        camera.data.lens, camera.data.sensor_fit = lens, fit
        camera.data.shift_x, camera.data.shift_y = shift
        camera.matrix_world = Matrix.Translation((3, -4, 1)) @ Matrix.Rotation(1.4, 4, "X")
        camera.scale = (2, 2, 2)
        camera.select_set(True)
    arguments = {"view_cameras": "SELECTED", "output": str(tmp_path), "target": cube.name, **SMALL}
    bpy.ops.fewview.render_views(**arguments)
    frames = transforms(tmp_path / "views-001")
    cameras = [made for made in bpy.context.view_layer.objects if made.type == "CAMERA"]
    assert len(frames) == 2
    assert scene.render.resolution_percentage == percentage
    scene.render.resolution_percentage = 100
    scene.render.resolution_x, scene.render.resolution_y = 64, 48
    for camera, frame in zip(cameras, frames, strict=True):
        assert frame["fl_x"] != pytest.approx(frame["fl_y"])
        for point in corners(cube):
            share = world_to_camera_view(scene, camera, point)
            expected = (share.x * 64, (1 - share.y) * 48)
            assert projected(frame, point) == pytest.approx(expected, abs=0.01)


def test_an_animated_camera_is_followed_through_markers(cube: Any, tmp_path: Path) -> None:
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, 21
    cameras = []
    for index in range(2):
        camera = bpy.data.objects.new(f"mine {index}", bpy.data.cameras.new("mine"))
        scene.collection.objects.link(camera)
        camera.rotation_euler = (np.pi / 2, 0, 0)
        for frame, x in ((1, 2.0 + index), (21, 4.0 + index)):
            camera.location = (x, -6, 0)
            camera.data.lens = 20 + frame
            camera.keyframe_insert("location", frame=frame)
            camera.data.keyframe_insert("lens", frame=frame)
        cameras.append(camera)
    scene.camera = cameras[0]
    scene.timeline_markers.new("cut", frame=11).camera = cameras[1]
    scene.timeline_markers.new("start", frame=1).camera = cameras[0]
    scene.frame_set(5)
    arguments = {"view_cameras": "ANIMATED", "frame_step": 10, "output": str(tmp_path), **SMALL}
    bpy.ops.fewview.render_views(**arguments)
    frames = transforms(tmp_path / "views-001")
    assert [frame["transform_matrix"][0][3] for frame in frames] == pytest.approx([2.0, 4.0, 5.0])
    assert frames[0]["fl_x"] / 64 * 36 == pytest.approx(21, rel=1e-4)
    assert frames[2]["fl_x"] / 64 * 36 == pytest.approx(41, rel=1e-4)
    assert (scene.frame_current, scene.camera) == (5, cameras[0])


def test_workbench_masks_too(cube: Any, tmp_path: Path, rendering: ModuleType) -> None:
    """Not rendered, as it needs a GPU or its software: the floor is hidden from it as from a camera."""
    changes = rendering._mask_changes(bpy.context.scene, (cube,), "BLENDER_WORKBENCH")
    assert {(made.name, name, value) for made, name, value in changes} == {
        ("Floor", "hide_render", True),
        ("Sun", "hide_render", True),
    }


# Pictures, masks and the true surface are of the same things


def true_surface(folder: Path) -> Any:
    ply = importlib.import_module("bl_ext.user_default.fewview.addon.ply")
    return ply.read_ply(folder / "truth.ply")


def rendered(output: Path, **arguments: Any) -> Path:
    """Folder of new views of a tiny size."""
    assert bpy.ops.fewview.render_views(output=str(output), **{**SMALL, **arguments}) == {"FINISHED"}
    return max(output.glob("views-*"))


def assert_pictures_show_the_truth(folder: Path) -> None:
    """The outline in each mask is that of the true surface, by the file's cameras, and whole."""
    points = true_surface(folder).positions
    for frame in transforms(folder):
        rows, columns = np.nonzero(pixels_rgba(folder / frame["file_path"])[..., 3] > 0.5)
        seen = np.array([projected(frame, point) for point in points])
        assert seen.min() > 0
        assert (seen.max(axis=0) < (64, 48)).all()
        edges = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        np.testing.assert_allclose(edges, [*seen.min(axis=0), *seen.max(axis=0)], atol=1.5)


def add_camera(name: str, distance: float) -> Any:
    """It looks at the cube from the front."""
    camera = bpy.data.objects.new(name, bpy.data.cameras.new(name))
    bpy.context.scene.collection.objects.link(camera)
    camera.location, camera.rotation_euler = (3, 1 - distance, 0), (np.pi / 2, 0, 0)
    bpy.context.view_layer.update()
    return camera


def add_cube(name: str, size: float, location: tuple[float, float, float]) -> Any:
    bpy.ops.mesh.primitive_cube_add(size=size, location=location)
    bpy.context.object.name = name
    return bpy.context.object


def scatter(carrier: Any, scattered: Any) -> None:
    """Geometry Nodes add the object at each of the vertices."""
    tree = bpy.data.node_groups.new("scatter", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    kinds = ("NodeGroupInput", "GeometryNodeInstanceOnPoints", "GeometryNodeJoinGeometry", "NodeGroupOutput")
    came, placed, joined, goes = (tree.nodes.new(kind) for kind in kinds)
    info = tree.nodes.new("GeometryNodeObjectInfo")
    info.inputs["Object"].default_value, info.inputs["As Instance"].default_value = scattered, True
    for start, end in (
        (came.outputs[0], placed.inputs["Points"]),
        (info.outputs["Geometry"], placed.inputs["Instance"]),
        (came.outputs[0], joined.inputs[0]),
        (placed.outputs[0], joined.inputs[0]),
        (joined.outputs[0], goes.inputs[0]),
    ):
        tree.links.new(start, end)
    carrier.modifiers.new("Scatter", "NODES").node_group = tree


def scatter_particles(carrier: Any, scattered: Any) -> None:
    carrier.modifiers.new("Particles", "PARTICLE_SYSTEM")
    settings = carrier.particle_systems[0].settings
    settings.type, settings.count, settings.render_type = "HAIR", 30, "OBJECT"
    settings.instance_object, settings.particle_size = scattered, 0.5
    settings.display_percentage = 10


def test_a_marker_with_a_camera_does_not_take_the_pictures(cube: Any, tmp_path: Path) -> None:
    scene = bpy.context.scene
    own, far = generate(view_count=2)[0], add_camera("far", 30)
    marker = scene.timeline_markers.new("cut", frame=1)
    marker.camera, scene.camera = far, own  # in this order: the first changes the scene's too
    assert_pictures_show_the_truth(rendered(tmp_path, target="Cube"))
    assert (marker.camera, scene.camera) == (far, own)


def test_what_was_moved_without_a_key_is_rendered_where_it_is_said_to_be(cube: Any, tmp_path: Path) -> None:
    """And stands afterwards where it was moved to."""
    camera = generate(view_count=2)[0]
    camera.keyframe_insert("location", frame=1)
    cube.keyframe_insert("location", frame=1)
    camera.location, cube.location = camera.location * 1.1, (3.1, 1, 0.1)
    before = state()
    assert_pictures_show_the_truth(rendered(tmp_path, target="Cube"))
    assert state() == before


@pytest.mark.parametrize("scattering", [scatter, scatter_particles])
def test_what_is_scattered_over_the_subject_is_part_of_it(
    cube: Any, tmp_path: Path, scattering: Callable[[Any, Any], None]
) -> None:
    scattering(cube, add_cube("Rock", 0.4, (60, 0, 0)))
    generate(view_count=2, target="Cube")
    folder = rendered(tmp_path, target="Cube")
    assert np.ptp(true_surface(folder).positions, axis=0).min() > 1.1
    assert_pictures_show_the_truth(folder)


def hide_in_renders(part: Any) -> None:
    part.hide_render = True


def hide_collection_in_renders(part: Any) -> None:
    collection = bpy.data.collections.new("cutters")
    bpy.context.scene.collection.children.link(collection)
    for other in part.users_collection:
        other.objects.unlink(part)
    collection.objects.link(part)
    collection.hide_render = True


def hide_in_viewport(part: Any) -> None:
    part.hide_viewport = True


def close_eye(part: Any) -> None:
    part.hide_set(True)


def hide_collection_in_viewport(part: Any) -> None:
    hide_collection_in_renders(part)
    layer = bpy.context.view_layer.layer_collection.children["cutters"]
    layer.collection.hide_render = False
    layer.hide_viewport = layer.collection.hide_viewport = True


@pytest.mark.parametrize(
    ("hide", "size"),
    [
        *((hide_in_renders, 1.0), (hide_collection_in_renders, 1.0)),
        *((hide_in_viewport, 2.0), (close_eye, 2.0), (hide_collection_in_viewport, 2.0)),
    ],
)
def test_children_are_part_of_the_subject_where_renders_show_them(
    cube: Any, tmp_path: Path, hide: Callable[[Any], None], size: float
) -> None:
    """As a cutter is not, though the viewport shows it."""
    child = add_cube("Child", 2.0, (0, 0, 0))
    child.parent = cube
    hide(child)
    generate(view_count=2, target="Cube")
    child.select_set(True)
    before = state()
    folder = rendered(tmp_path, target="Cube")
    assert np.ptp(true_surface(folder).positions, axis=0) == pytest.approx([size] * 3)
    assert_pictures_show_the_truth(folder)
    assert state() == before
    assert child.hide_get() == (hide == close_eye)


def test_modifiers_of_renders_are_framed_and_measured(cube: Any, tmp_path: Path) -> None:
    array = cube.modifiers.new("Array", "ARRAY")
    array.count, array.show_viewport = 6, False
    generate(view_count=2, target="Cube")
    assert_pictures_show_the_truth(rendered(tmp_path, target="Cube"))
    assert not array.show_viewport


def test_an_instance_has_the_modifiers_of_renders(cube: Any, tmp_path: Path) -> None:
    """Of the empty's collection: a part that renders hide, and one that the viewport hides."""
    collection = bpy.data.collections.new("inside")
    for index, name in enumerate(("shown", "cutter")):
        part = add_cube(name, 1.0 + index, (0, 0, 0))
        bpy.context.scene.collection.objects.unlink(part)
        collection.objects.link(part)
        part.hide_viewport, part.hide_render = name == "shown", name == "cutter"
    array = collection.objects["shown"].modifiers.new("Array", "ARRAY")
    array.count, array.show_viewport = 3, False
    empty = bpy.data.objects.new("Instance", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", collection
    bpy.context.scene.collection.objects.link(empty)
    generate(view_count=2, target="Instance")
    folder = rendered(tmp_path, target="Instance")
    assert np.ptp(true_surface(folder).positions, axis=0) == pytest.approx([3, 1, 1])
    assert_pictures_show_the_truth(folder)
    hidden = [(part.hide_viewport, part.hide_render) for part in collection.objects]
    assert hidden == [(True, False), (False, True)]


def test_the_truth_is_as_simplified_as_renders(cube: Any, tmp_path: Path) -> None:
    subdivision = cube.modifiers.new("Subdivision", "SUBSURF")
    subdivision.levels, subdivision.render_levels = 1, 3
    render = bpy.context.scene.render
    render.use_simplify, render.simplify_subdivision, render.simplify_subdivision_render = True, 0, 2
    generate(view_count=2, target="Cube")
    folder = rendered(tmp_path, target="Cube")
    assert len(true_surface(folder).positions) == 98
    assert (render.simplify_subdivision, subdivision.levels) == (0, 1)


@pytest.mark.parametrize("kind", ["CURVE", "FONT", "META"])
def test_curves_are_in_the_truth_once(cube: Any, part: Callable[[str], ModuleType], kind: str) -> None:
    if kind == "CURVE":
        bpy.ops.curve.primitive_bezier_circle_add()
        bpy.context.object.data.bevel_depth = 0.1
    elif kind == "FONT":
        bpy.ops.object.text_add()
        bpy.context.object.data.extrude = 0.1
    else:
        bpy.ops.object.metaball_add()
    made = bpy.context.object
    bpy.context.view_layer.update()
    alone = bpy.data.meshes.new_from_object(made.evaluated_get(bpy.context.evaluated_depsgraph_get()))
    alone.calc_loop_triangles()
    num_faces = len(alone.loop_triangles)
    assert num_faces
    assert len(part("true_mesh").true_mesh((made,)).faces) == num_faces


def test_an_object_that_is_in_no_picture_says_why(cube: Any, tmp_path: Path) -> None:
    generate(view_count=2)
    cube.visible_camera = False
    with pytest.raises(RuntimeError, match=r"Cube is in no picture: is it hidden from cameras\?"):
        rendered(tmp_path)
    assert not list(tmp_path.rglob("transforms.json"))
    cube.visible_camera = True
    hide_collection_in_renders(cube)
    before = state()
    with pytest.raises(RuntimeError, match=r"Cube is in no picture: is its collection hidden from renders\?"):
        rendered(tmp_path)
    assert state() == before


def test_an_object_that_was_deleted_says_so(cube: Any, tmp_path: Path) -> None:
    """The field still shows it; without an object there would be no masks."""
    generate(view_count=2)
    bpy.context.scene.collection.objects.unlink(cube)
    with pytest.raises(RuntimeError, match="Cube is no longer in the scene: choose another object, or none"):
        rendered(tmp_path)
    assert rendered(tmp_path, target="")


@pytest.mark.parametrize(("energy", "is_told"), [(0.0, True), (2.0, False), (20.0, True)])
def test_too_much_light_and_none_are_told(
    cube: Any,
    second_blender: ModuleType,
    part: Callable[[str], ModuleType],
    tmp_path: Path,
    energy: float,
    is_told: bool,
) -> None:
    """Of which AgX, in the viewport, shows the one and Solid mode the other."""
    bpy.data.objects["Sun"].data.energy = energy
    bpy.context.scene.world = bpy.data.worlds.new("grey") if energy else None
    bpy.context.scene.view_settings.view_transform = "AgX"
    generate(view_count=2)
    rendered(tmp_path)
    told = part("jobs").ended().warnings
    assert bool(told) == is_told
    assert all("white or black without texture in 2 of 2 views: change the lights" in text for text in told)


def test_samples_are_those_that_are_asked_for(cube: Any, rendering: ModuleType) -> None:
    layer = bpy.context.view_layer
    layer.samples = 4096  # which count before the scene's
    assert (layer, "samples", 0) in rendering.render_changes(bpy.context.scene, request(rendering))


def test_a_linked_object_of_the_same_name_is_another_one(cube: Any, tmp_path: Path) -> None:
    bpy.data.libraries.write(str(tmp_path / "other.blend"), {cube}, fake_user=True)
    with bpy.data.libraries.load(str(tmp_path / "other.blend"), link=True) as (_, wanted):
        wanted.objects = ["Cube"]
    (linked,) = wanted.objects
    bpy.context.scene.collection.objects.link(linked)
    cube.location = (3, 1, 5)
    for made in (cube, linked):
        generate(view_count=2, target=made.name_full)
        assert bpy.context.scene.fewview.target == made
        folder = rendered(tmp_path)
        middle = true_surface(folder).positions.mean(axis=0)
        assert middle == pytest.approx(tuple(made.location), abs=1e-5)
        assert_pictures_show_the_truth(folder)


def test_objects_behind_the_scene_are_not_in_the_mask(cube: Any, tmp_path: Path) -> None:
    generate(view_count=2, target="Cube")
    floor = bpy.data.objects["Floor"]
    behind = bpy.data.scenes.new("behind")
    bpy.context.scene.collection.objects.unlink(floor)
    behind.collection.objects.link(floor)
    bpy.context.scene.background_set = behind
    assert_pictures_show_the_truth(rendered(tmp_path, target="Cube"))
    assert floor.visible_camera


def test_fog_is_not_in_the_mask(cube: Any, tmp_path: Path) -> None:
    world = bpy.context.scene.world = bpy.data.worlds.new("foggy")
    if world.node_tree is None:  # before Blender 5.0 a new world has no nodes
        world.use_nodes = True
    tree = world.node_tree
    fog = tree.nodes.new("ShaderNodeVolumeScatter")
    fog.inputs["Density"].default_value = 0.05
    output = next(node for node in tree.nodes if node.type == "OUTPUT_WORLD")
    link = tree.links.new(fog.outputs[0], output.inputs["Volume"])
    generate(view_count=2, target="Cube")
    assert_pictures_show_the_truth(rendered(tmp_path, target="Cube"))
    assert not link.is_muted


def test_workbench_does_not_see_through_the_subject(cube: Any, rendering: ModuleType) -> None:
    """Not rendered, as it needs a GPU or its software: the mask would be as transparent as the X-ray."""
    shading = bpy.context.scene.display.shading
    assert (shading, "show_xray", False) in rendering.render_changes(bpy.context.scene, request(rendering))


def test_pencils_are_hidden_from_every_engine(cube: Any, rendering: ModuleType) -> None:
    """Not rendered, as it needs a GPU or its software: no ray shows them, so none can be kept from them."""
    if bpy.app.version < (4, 3):
        bpy.ops.object.gpencil_add(type="STROKE")
    else:
        bpy.ops.object.grease_pencil_add(type="STROKE")
    changes = rendering._mask_changes(bpy.context.scene, (cube,), "CYCLES")
    assert (bpy.context.object, "hide_render", True) in changes
    assert (bpy.data.objects["Floor"], "visible_camera", False) in changes


def test_what_keys_would_show_in_the_mask_is_refused(cube: Any, tmp_path: Path) -> None:
    generate(view_count=2, target="Cube")
    floor = bpy.data.objects["Floor"]
    floor.keyframe_insert("hide_render", frame=1)
    before = state()
    with pytest.raises(RuntimeError, match="Floor would be in the mask: its 'Disable in Renders' has keys"):
        rendered(tmp_path, target="Cube", engine="WORKBENCH")
    assert state() == before
    assert_pictures_show_the_truth(rendered(tmp_path, target="Cube"))


# What is left behind


def dump(owner: Any, depth: int = 3) -> dict[str, Any]:
    """All values that can be read, by path."""
    found: dict[str, Any] = {}
    for prop in owner.bl_rna.properties:
        if prop.identifier in {"rna_type", "bl_rna"}:
            continue
        value = getattr(owner, prop.identifier)
        if prop.type == "POINTER":
            if value is not None and not isinstance(value, bpy.types.ID) and depth:
                found |= {f"{prop.identifier}.{k}": v for k, v in dump(value, depth - 1).items()}
            elif isinstance(value, bpy.types.ID):
                found[prop.identifier] = value.name_full
        elif prop.type != "COLLECTION":
            is_array = getattr(prop, "is_array", False)
            found[prop.identifier] = tuple(np.ravel(value)) if is_array else value
    return found


def state() -> dict[str, Any]:
    bpy.context.view_layer.update()  # else what is derived may be from before the last change
    scene = bpy.context.scene
    parts = {
        "render": scene.render,
        "cycles": scene.cycles,
        "view": scene.view_settings,
        "display": scene.display_settings,
        "world": scene.world,
    }
    found = {f"{name}.{k}": v for name, part in parts.items() if part for k, v in dump(part).items()}
    found |= {"frame": scene.frame_current_final, "camera": scene.camera and scene.camera.name}
    for made in scene.objects:
        found |= {f"{made.name}.{k}": v for k, v in dump(made, 0).items()}
        found |= {f"{made.name}.{m.name}.{k}": v for m in made.modifiers for k, v in dump(m, 0).items()}
        if made.type == "CAMERA":
            found |= {f"{made.name}.data.{k}": v for k, v in dump(made.data).items()}
    return found


@pytest.fixture
def unusual(cube: Any) -> dict[str, Any]:
    """A scene in which nearly everything that rendering changes is set to something else."""
    scene, render = bpy.context.scene, bpy.context.scene.render
    generate(view_count=2)
    bpy.context.view_layer.objects.active = cube
    subdivision = cube.modifiers.new("Subdivision", "SUBSURF")
    subdivision.levels, subdivision.render_levels, subdivision.show_viewport = 0, 2, False
    for frame, turn in ((10, 0.0), (24, 3.0)):
        cube.rotation_euler.z = turn
        cube.keyframe_insert("rotation_euler", frame=frame)
    render.engine = "BLENDER_WORKBENCH"
    if hasattr(render.image_settings, "media_type"):
        render.image_settings.media_type = "MULTI_LAYER_IMAGE"
    render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
    render.image_settings.color_depth = "32"
    render.resolution_percentage, render.use_border, render.use_crop_to_border = 37, True, True
    render.border_min_x, render.border_max_y = 0.25, 0.5
    render.use_stamp, render.use_motion_blur, render.use_multiview = True, True, True
    render.film_transparent, render.dither_intensity, render.filepath = False, 1.7, "//mine"
    scene.view_settings.view_transform = "Filmic"
    scene.view_settings.look = "Filmic - High Contrast" if bpy.app.version < (4, 0) else "High Contrast"
    scene.view_settings.gamma, scene.view_settings.exposure = 1.3, 0.5
    scene.view_settings.use_curve_mapping = True
    scene.cycles.samples, scene.cycles.seed, scene.cycles.use_denoising = 77, 5, True
    blur = scene.camera.data.dof
    blur.use_dof, blur.aperture_fstop, blur.focus_distance = True, 0.05, 0.5
    scene.frame_set(17, subframe=0.25)
    bpy.data.objects["Floor"].visible_camera = False
    return state()


def test_every_setting_is_as_it_was(unusual: dict[str, Any], tmp_path: Path) -> None:
    bpy.ops.fewview.render_views(output=str(tmp_path), **SMALL)
    assert state() == unusual
    bpy.ops.fewview.render_views(
        output=str(tmp_path), view_cameras="ANIMATED", frame_step=150, **{**SMALL, "engine": "CYCLES"}
    )
    assert state() == unusual


def test_pictures_do_not_depend_on_what_is_set(unusual: dict[str, Any], tmp_path: Path) -> None:
    """But for what the user sees as the look of the scene: its exposure."""
    bpy.ops.fewview.render_views(output=str(tmp_path), **SMALL)
    scene, render = bpy.context.scene, bpy.context.scene.render
    render.use_border = render.use_crop_to_border = render.use_stamp = False
    render.use_motion_blur = render.use_multiview = False
    render.dither_intensity, render.resolution_percentage = 0.0, 100
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look, scene.view_settings.gamma = "None", 1.0
    scene.view_settings.use_curve_mapping = scene.camera.data.dof.use_dof = False
    bpy.data.objects["Floor"].visible_camera = True
    bpy.ops.fewview.render_views(output=str(tmp_path), **SMALL)
    first, second = ((tmp_path / f"views-00{i}/images/000.png").read_bytes() for i in (1, 2))
    assert first == second
    assert pixels_rgba(tmp_path / "views-001/images/000.png").shape == (48, 64, 4)


def request(rendering: ModuleType, **changes: Any) -> Any:
    names = [made.name_full for made in bpy.context.scene.objects if made.type == "CAMERA"]
    given = {
        "scene": bpy.context.scene.name_full,
        "view_layer": bpy.context.view_layer.name,
        "views": tuple(rendering.View(camera=name) for name in names),
        "target": "Cube",
        "engine": "CYCLES",
        "samples": 1,
        "width": 64,
        "height": 48,
        **changes,
    }
    return rendering.ViewRequest(**given)


@pytest.fixture
def break_second_view(rendering: ModuleType, monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    take = rendering._take

    def broken(*arguments: Any, noise_seed: int) -> Any:
        if noise_seed == 1:
            raise RuntimeError("out of order")
        return take(*arguments, noise_seed=noise_seed)

    return lambda: monkeypatch.setattr(rendering, "_take", broken)


def test_after_an_error_every_setting_is_as_it_was(
    unusual: dict[str, Any], rendering: ModuleType, break_second_view: Callable[[], None], tmp_path: Path
) -> None:
    break_second_view()
    views = rendering.render_views(request(rendering), tmp_path / "new")
    assert next(views)[0] == 0
    assert state() != unusual
    with pytest.raises(RuntimeError, match="out of order"):
        next(views)
    assert state() == unusual
    assert not (tmp_path / "new/transforms.json").exists()


def test_a_rendering_that_is_left_restores_everything(
    unusual: dict[str, Any], rendering: ModuleType, tmp_path: Path
) -> None:
    views: Iterator[Any] = rendering.render_views(request(rendering), tmp_path / "new")
    next(views)
    views.close()
    assert state() == unusual
    assert sorted(path.name for path in (tmp_path / "new").rglob("*")) == ["000.png", "images"]


def test_an_operators_error_restores_everything_and_reaches_the_script(
    unusual: dict[str, Any], break_second_view: Callable[[], None], tmp_path: Path
) -> None:
    break_second_view()
    with pytest.raises(RuntimeError, match="out of order"):
        bpy.ops.fewview.render_views(output=str(tmp_path), **SMALL)
    assert state() == unusual
    assert not bpy.context.scene.fewview.images


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"views": ()}, "no cameras"),
        ({"view_layer": "Moon"}, "Moon is not what Blender shows"),
        ({"target": "Moon"}, "no object Moon"),
        ({"target": "Floor"}, "Floor is hidden"),
        ({"target": "Sun"}, "Sun cannot be rendered: there is no visible surface"),
    ],
)
def test_what_cannot_be_rendered_says_why(
    cube: Any, rendering: ModuleType, tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    generate(view_count=2)
    bpy.data.objects["Floor"].hide_render = True
    with pytest.raises(ValueError, match=message):
        list(rendering.render_views(request(rendering, **changes), tmp_path / "new"))


def test_cameras_that_have_just_been_moved_are_where_they_are(
    cube: Any, rendering: ModuleType, tmp_path: Path
) -> None:
    camera = generate(view_count=2)[0]
    camera.location = (1, 2, 3)
    list(rendering.render_views(request(rendering, target=None), tmp_path / "new"))
    assert np.array(transforms(tmp_path / "new")[0]["transform_matrix"])[:3, 3] == pytest.approx((1, 2, 3))


def test_the_users_folder_is_not_written_into(cube: Any, rendering: ModuleType, tmp_path: Path) -> None:
    generate(view_count=2)
    (tmp_path / "images").mkdir()
    with pytest.raises(FileExistsError):
        list(rendering.render_views(request(rendering), tmp_path))


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("GENERATED", "no generated cameras"),
        ("SELECTED", "No camera is selected"),
        ("ANIMATED", "The scene has no camera"),
    ],
)
def test_no_cameras_say_what_to_do(cube: Any, tmp_path: Path, kind: str, message: str) -> None:
    with pytest.raises(RuntimeError, match="Generate cameras first, or add one"):
        bpy.ops.fewview.render_views()
    camera = bpy.data.objects.new("mine", bpy.data.cameras.new("mine"))
    bpy.context.scene.collection.objects.link(camera)
    with pytest.raises(RuntimeError, match=message):
        bpy.ops.fewview.render_views(view_cameras=kind, output=str(tmp_path))
    assert not list(tmp_path.iterdir())


def test_orthographic_and_mirrored_cameras_are_refused(cube: Any, tmp_path: Path) -> None:
    (camera,) = generate(view_count=2)[:1]
    camera.data.type = "ORTHO"
    with pytest.raises(RuntimeError, match="no perspective camera"):
        bpy.ops.fewview.render_views(output=str(tmp_path), **SMALL)
    camera.data.type, camera.scale = "PERSP", (-1, 1, 1)
    with pytest.raises(RuntimeError, match="mirrored"):
        bpy.ops.fewview.render_views(output=str(tmp_path), **SMALL)


def test_the_truth_is_what_is_rendered(unusual: dict[str, Any], tmp_path: Path) -> None:
    """With the subdivision of renders, though the viewport shows none."""
    bpy.ops.fewview.render_views(output=str(tmp_path), **SMALL)
    header = (tmp_path / "views-001/truth.ply").read_bytes()[:200]
    assert b"element vertex 98\n" in header


def test_the_request_survives_its_file(rendering: ModuleType, cube: Any) -> None:
    generate()
    wanted = request(rendering)
    assert rendering.decode_request(rendering.encode_request(wanted)) == wanted


# The second Blender


@pytest.fixture
def second_blender(addon: ModuleType, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The module; where Blender is a Python module, with a Python as the Blender that it starts."""
    worker = importlib.import_module(addon.__name__ + ".render_worker")

    def command(folder: Path) -> tuple[str, ...]:
        script = (
            f"import bpy, importlib; bpy.ops.wm.open_mainfile(filepath={str(folder / worker.COPY)!r});"
            f"importlib.import_module({worker.__name__!r}).main({str(folder)!r})"
        )
        return (sys.executable, "-c", script)

    if not bpy.app.binary_path:
        monkeypatch.setattr(worker, "worker_command", command)
    monkeypatch.setattr(worker, "needs_waiting", lambda: False)
    return worker


@pytest.fixture
def painted(cube: Any, tmp_path: Path) -> Any:
    """The cube glows in the colour of a picture that a saved .blend names by a relative path."""
    (tmp_path / "own/textures").mkdir(parents=True)
    image = bpy.data.images.new("green", 8, 8)
    image.pixels = [0.0, 1.0, 0.0, 1.0] * 64
    image.filepath_raw, image.file_format = str(tmp_path / "own/textures/green.png"), "PNG"
    image.save()
    bpy.data.images.remove(image)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "own/work.blend"))
    cube = bpy.data.objects["Cube"]
    glow = bpy.data.materials.new("glow")
    if glow.node_tree is None:  # before Blender 5.0 a new material has no nodes
        glow.use_nodes = True
    tree = glow.node_tree
    texture, emission = tree.nodes.new("ShaderNodeTexImage"), tree.nodes.new("ShaderNodeEmission")
    texture.image = bpy.data.images.load("//textures/green.png")
    tree.links.new(texture.outputs[0], emission.inputs[0])
    output = next(node for node in tree.nodes if node.type == "OUTPUT_MATERIAL")
    tree.links.new(emission.outputs[0], output.inputs[0])
    cube.data.materials.append(glow)
    return cube


def test_a_second_blender_renders_what_is_not_saved(
    painted: Any, second_blender: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(second_blender, "clean", lambda _: None)  # here: the second one cleans by itself
    painted.location.x = 7.0  # since the file was saved
    generate(view_count=2)
    before = {path: path.read_bytes() for path in (tmp_path / "own").rglob("*") if path.is_file()}
    image = bpy.data.images[0]
    assert image.filepath == "//textures/green.png"
    assert bpy.ops.fewview.render_views(output=str(tmp_path / "jobs"), **SMALL) == {"FINISHED"}
    folder = tmp_path / "jobs/views-001"
    assert sorted(path.name for path in folder.iterdir()) == [
        *("images", "render.log", "transforms.json", "truth.ply"),
    ]
    picture = pixels_rgba(folder / "images/001.png")
    inside = picture[picture[..., 3] > 0.99]
    assert len(inside) > 100
    np.testing.assert_allclose(inside, np.tile([0, 1, 0, 1], (len(inside), 1)), atol=0.01)
    assert projected(transforms(folder)[0], (7, 1, 0)) == pytest.approx((32, 24), abs=0.1)
    assert [image.width for image in bpy.context.scene.fewview.images] == [64, 64]
    assert image.filepath == "//textures/green.png"
    assert bpy.data.filepath == str(tmp_path / "own/work.blend")
    assert {path: path.read_bytes() for path in before} == before


def add_cloth(_: Path) -> Any:
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=4, y_subdivisions=4, location=(3, 1, 3))
    bpy.context.object.modifiers.new("Cloth", "CLOTH").point_cache.frame_end = 12
    return bpy.context.object


def cloth_collection() -> Any:
    """The cloth in a collection that is not in the scene."""
    cloth = add_cloth(Path())
    bpy.context.scene.collection.objects.unlink(cloth)
    collection = bpy.data.collections.new("Clothes")
    collection.objects.link(cloth)
    return collection


def add_instance(collection: Any) -> Any:
    shown = bpy.data.objects.new("Shown", None)
    shown.instance_type, shown.instance_collection = "COLLECTION", collection
    bpy.context.scene.collection.objects.link(shown)
    return shown


def linked_clothes(tmp_path: Path) -> Any:
    path = str(tmp_path / "clothes.blend")
    collection = cloth_collection()
    bpy.data.libraries.write(path, {collection}, fake_user=True)
    bpy.data.batch_remove([*collection.objects, collection])
    with bpy.data.libraries.load(path, link=True) as (_, wanted):
        wanted.collections = ["Clothes"]
    return wanted.collections[0]


def overridden_cloth(tmp_path: Path) -> Any:
    scene = bpy.context.scene
    clothes = linked_clothes(tmp_path).override_hierarchy_create(scene, bpy.context.view_layer)
    if clothes not in scene.collection.children_recursive:
        scene.collection.children.link(clothes)
    return clothes.objects[0]


def add_cloth_on_disk(tmp_path: Path) -> Any:
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "own.blend"))  # else there is no cache on disk
    cloth = add_cloth(tmp_path)
    cloth.modifiers["Cloth"].point_cache.use_disk_cache = True
    return cloth


def add_baked_cloth_on_disk(tmp_path: Path) -> Any:
    cloth = add_cloth_on_disk(tmp_path)
    with bpy.context.temp_override(point_cache=cloth.modifiers["Cloth"].point_cache):
        bpy.ops.ptcache.bake(bake=True)
    assert cloth.modifiers["Cloth"].point_cache.is_baked
    return cloth


def add_rigid_body(_: Path) -> Any:
    falling = add_cube("Falling", 1.0, (3, 1, 3))
    bpy.ops.rigidbody.object_add(type="ACTIVE")
    return falling


def add_zone(_: Path) -> Any:
    """A cube that sinks by a simulation zone of Geometry Nodes."""
    sinking = add_cube("Sinking", 1.0, (3, 1, 3))
    tree = bpy.data.node_groups.new("sink", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    kinds = ("NodeGroupInput", "GeometryNodeSimulationInput", "GeometryNodeTransform")
    came, begins, moved = (tree.nodes.new(kind) for kind in kinds)
    ends, goes = (tree.nodes.new(kind) for kind in ("GeometryNodeSimulationOutput", "NodeGroupOutput"))
    begins.pair_with_output(ends)
    moved.inputs["Translation"].default_value = (0, 0, -0.1)
    for start, end in (
        (came.outputs[0], begins.inputs["Geometry"]),
        (begins.outputs["Geometry"], moved.inputs["Geometry"]),
        (moved.outputs[0], ends.inputs["Geometry"]),
        (ends.outputs["Geometry"], goes.inputs[0]),
    ):
        tree.links.new(start, end)
    sinking.modifiers.new("Sink", "NODES").node_group = tree
    return sinking


def add_baked_zone(tmp_path: Path) -> Any:
    """It was baked to a disk, beside the file, and would sink slower by now."""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "own.blend"))
    sinking = add_zone(tmp_path)
    modifier = sinking.modifiers["Sink"]
    if hasattr(modifier, "bake_target"):
        modifier.bake_target = "DISK"
    bpy.context.view_layer.update()
    bake = modifier.bakes[0]
    bake.use_custom_simulation_frame_range, bake.frame_start, bake.frame_end = True, 1, 12
    bpy.ops.object.geometry_node_bake_single(
        session_uid=sinking.session_uid, modifier_name="Sink", bake_id=bake.bake_id
    )
    assert modifier.bake_directory.startswith("//")
    nodes = modifier.node_group.nodes
    next(node for node in nodes if node.type == "TRANSFORM_GEOMETRY").inputs["Translation"].default_value = (
        *(0, 0, -0.01),
    )
    return sinking


@pytest.mark.parametrize(
    "simulated",
    [
        add_cloth,
        lambda _: add_instance(cloth_collection()),
        lambda tmp_path: add_instance(linked_clothes(tmp_path)),
        overridden_cloth,
        add_cloth_on_disk,
        add_baked_cloth_on_disk,
        add_rigid_body,
        add_zone,
        add_baked_zone,
    ],
    ids=[
        "cloth",
        "instanced",
        "linked",
        "overridden",
        "disk",
        "baked disk",
        "rigid body",
        "zone",
        "baked zone",
    ],
)
def test_a_second_blender_has_what_was_simulated(
    cube: Any,
    second_blender: ModuleType,
    part: Callable[[str], ModuleType],
    tmp_path: Path,
    simulated: Callable[[Path], Any],
) -> None:
    """Neither the frames of a simulation nor where things lie are to be had without those before."""
    target = simulated(tmp_path)
    scene, before = bpy.context.scene, bpy.data.filepath
    for frame in range(1, 13):
        scene.frame_set(frame)
    fallen = part("true_mesh").true_mesh((target,)).vertices
    assert fallen[:, 2].min() < 2.6
    generate(view_count=2, target=target.name)
    folder = rendered(tmp_path, target=target.name)
    np.testing.assert_allclose(true_surface(folder).positions, fallen, atol=0.01)
    assert_pictures_show_the_truth(folder)
    assert bpy.data.filepath == before
    assert sorted(path.name for path in folder.iterdir()) == [
        *("images", "render.log", "transforms.json", "truth.ply"),
    ]


def test_what_a_second_blender_lacks_is_said(
    cube: Any, second_blender: ModuleType, part: Callable[[str], ModuleType], tmp_path: Path
) -> None:
    assert second_blender.not_copied() == ()
    image = bpy.data.images.new("painted", 2, 2)
    image.pixels = [0.0] * 16
    image.pack()
    assert second_blender.not_copied() == ()
    image.pixels = [1.0] * 16
    (sentence,) = second_blender.not_copied()
    assert sentence == "Rendered as they were last saved or packed: painted"
    generate(view_count=2)
    rendered(tmp_path)
    assert sentence in part("jobs").ended().warnings  # where the panel shows it


def test_an_error_in_the_second_blender_reaches_the_first(
    cube: Any, second_blender: ModuleType, tmp_path: Path
) -> None:
    generate(view_count=2)[1].data.type = "ORTHO"
    with pytest.raises(RuntimeError, match=r"could not be rendered: .* no perspective camera"):
        bpy.ops.fewview.render_views(output=str(tmp_path), **SMALL)
    assert not (tmp_path / "views-001/transforms.json").exists()
    assert not (tmp_path / "views-001" / second_blender.COPY).exists()


def test_a_scene_that_cannot_be_copied_says_so(
    cube: Any, second_blender: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    generate(view_count=2)
    monkeypatch.setattr(second_blender, "COPY", "nowhere/scene.blend")
    with pytest.raises(RuntimeError, match=r"cannot be copied to .*views-001: is the disk full\?"):
        bpy.ops.fewview.render_views(output=str(tmp_path), **SMALL)
    assert not list((tmp_path / "views-001").iterdir())


def test_nothing_is_left_of_a_second_blender_that_does_not_start(
    cube: Any, second_blender: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    generate(view_count=2)
    command = (sys.executable, "-c", "raise SystemExit(3)")
    monkeypatch.setattr(second_blender, "worker_command", lambda _: command)
    with pytest.raises(RuntimeError, match="exit code 3"):
        bpy.ops.fewview.render_views(output=str(tmp_path), **SMALL)
    assert [path.name for path in (tmp_path / "views-001").iterdir()] == ["render.log"]


@pytest.mark.parametrize("samples", [1, 100_000])
def test_the_second_blender_is_cancelled_between_views_or_within_one(
    cube: Any, second_blender: ModuleType, addon: ModuleType, tmp_path: Path, samples: int
) -> None:
    generate(view_count=900 if samples == 1 else 2)
    jobs = importlib.import_module(addon.__name__ + ".jobs")
    threading.Timer(5.0, jobs.cancel).start()
    started = time.monotonic()
    with pytest.raises(RuntimeError, match="The rendering was stopped"):
        bpy.ops.fewview.render_views(
            output=str(tmp_path), resolution_x=400, resolution_y=300, samples=samples
        )
    assert 4.5 < time.monotonic() - started < (6.3 if samples == 1 else 9.0)
    assert jobs.ended().cancelled
    assert not (tmp_path / "views-001/transforms.json").exists()
    assert not bpy.context.scene.fewview.images
