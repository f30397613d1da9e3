"""Rehearsed jobs and what users do meanwhile: undo, save, open another file, switch the add-on off."""

import atexit
import importlib
import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from ticks import assert_ticks_are_quick, tick_until

bpy = pytest.importorskip("bpy", reason="needs Blender's Python, where `import bpy` works")

pytestmark = [pytest.mark.blender, pytest.mark.usefixtures("addon")]

ROLE = "fewview_role"


class Rehearsal:
    """Jobs of a backend that only plays, and the timer that follows them."""

    def __init__(self, addon: ModuleType, patch: pytest.MonkeyPatch, parent: Path) -> None:
        self.addon, self.parent = addon, parent
        self.jobs, self.folders = self.part("jobs"), self.part("job_folder")
        self.reconstruct = self.part("operators.reconstruct")
        self.protocol = importlib.import_module(f"{addon.__name__.rpartition('.')[0]}.backend.wire.protocol")
        self.end, self.seconds = "finished", 0.7
        backend_command = self.reconstruct.backend_command

        def rehearse(python: Path, _verb: str, job: str) -> tuple[str, ...]:
            output = str(Path(job).parent / "result")
            words = ("rehearse", "--seconds", str(self.seconds), "--end", self.end, "--output", output)
            return tuple(backend_command(python, *words))

        patch.setattr(self.reconstruct, "backend_command", rehearse)

    def part(self, name: str) -> ModuleType:
        return importlib.import_module(f"{self.addon.__name__}.{name}")

    def start(self, *, end: str = "finished", seconds: float = 0.7) -> Path:
        """Start a job; its folder."""
        self.end, self.seconds = end, seconds
        folder = self.folders.new_folder(self.parent, "reconstruct")
        asked = self.protocol.Job(
            protocol=self.protocol.PROTOCOL_VERSION, images=("0.png", "1.png"), output="result"
        )
        self.reconstruct.start(Path(sys.executable), folder, asked, scene_name=bpy.context.scene.name)
        return Path(folder)

    def tick_until(self, done: Callable[[], object], limit_s: float = 30.0) -> None:
        """Call the timer's callback as Blender would."""
        tick_until(self.jobs, done, limit_s)

    def to_preview(self) -> Any:
        """Follow it until there is a preview to see."""
        self.tick_until(lambda: with_role("preview") or not self.jobs.running())
        assert self.jobs.running() is not None
        (preview,) = with_role("preview")
        return preview

    def to_end(self) -> Any:
        """Follow it to its end: how it ended."""
        self.tick_until(lambda: self.jobs.ended() is not None)
        assert self.jobs.running() is None
        return self.jobs.ended()


@pytest.fixture
def rehearsal(addon: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Rehearsal]:
    made = Rehearsal(addon, monkeypatch, tmp_path / "jobs")
    made.jobs.stop()
    made.jobs.forget()
    yield made
    made.jobs.stop()
    made.jobs.forget()


def with_role(role: str) -> list[Any]:
    """Objects of the file, in a scene or not, that carry the role."""
    return [made for made in bpy.data.objects if made.get(ROLE) == role]


def assert_one_result(folder: Path) -> Any:
    """The scene has the whole result of the job, once, and no preview."""
    (result,) = with_role("mesh")
    assert result == bpy.context.scene.fewview.result
    assert result.name in bpy.context.scene.objects
    assert result["fewview_job"] == str(folder)
    assert len(result.data.polygons) == 4
    support = [value.value for value in result.data.attributes["support"].data]
    assert support == pytest.approx([1.0, 0.7, 0.3, 0.0])
    colours = [round(255 * value) for value in result.data.color_attributes["Color"].data[0].color_srgb]
    assert colours == [200, 60, 60, 255]
    assert len(with_role("camera")) == 3
    assert with_role("preview") == []
    return result


# A whole job.


def test_a_job_brings_previews_and_one_result(rehearsal: Rehearsal) -> None:
    folder = rehearsal.start()
    seen: dict[int, set[int]] = {}

    def done() -> bool:
        previews = with_role("preview")
        assert len(previews) <= 1
        for preview in previews:
            seen.setdefault(preview.session_uid, set()).add(preview.data.session_uid)
            assert preview.hide_render
        return rehearsal.jobs.ended() is not None

    rehearsal.tick_until(done)
    assert rehearsal.jobs.ended().failure is None
    assert [len(meshes) for meshes in seen.values()] == [2]  # one object, replaced in place
    result = assert_one_result(folder)
    assert result.parent == bpy.context.scene.fewview.root
    used = {made.data for made in bpy.data.objects if made.type == "MESH"}
    assert {mesh for mesh in bpy.data.meshes if mesh.users} == used
    assert not any(mesh.users == 0 for mesh in bpy.data.meshes)


def test_no_tick_keeps_blender_from_its_user(rehearsal: Rehearsal) -> None:
    def run_a_job() -> None:
        rehearsal.start(seconds=0.3)
        assert rehearsal.to_end().failure is None

    assert_ticks_are_quick(rehearsal.jobs, run_a_job)


def test_a_change_of_the_scenes_pixels_is_told_once(rehearsal: Rehearsal) -> None:
    """By a job whose previews need it, and by an import of its result into another scene."""
    words = "pixel aspect was 1 : 1.5 and is now 1 : 1"
    bpy.context.scene.render.pixel_aspect_y = 1.5
    folder = rehearsal.start()
    assert sum(words in text for text in rehearsal.to_end().warnings) == 1
    other = bpy.data.scenes.new("other")
    other.render.pixel_aspect_y = 1.5
    told: list[str] = []
    for _ in rehearsal.part("result_import").import_result_steps(folder, scene_name="other", warnings=told):
        pass
    assert [words in text for text in told] == [True]


def test_several_jobs_one_after_another(rehearsal: Rehearsal) -> None:
    folders = []
    for _ in range(2):
        folders.append(rehearsal.start(seconds=0.1))
        assert rehearsal.to_end().failure is None
    assert [made["fewview_job"] for made in with_role("mesh")] == [str(folder) for folder in folders]
    assert bpy.context.scene.fewview.result["fewview_job"] == str(folders[1])


@pytest.mark.parametrize(("end", "code"), [("failed", "out_of_memory"), ("crashed", "crashed")])
def test_a_job_that_does_not_end_well(rehearsal: Rehearsal, end: str, code: str) -> None:
    rehearsal.start(end=end)
    rehearsal.to_preview()
    failure = rehearsal.to_end().failure
    assert failure.code == code
    assert failure.text
    assert failure.remedy
    assert with_role("mesh") == with_role("preview") == []


def test_cancelling(rehearsal: Rehearsal) -> None:
    rehearsal.start(seconds=20)
    rehearsal.tick_until(lambda: rehearsal.jobs.running().stage)
    assert bpy.ops.fewview.cancel() == {"FINISHED"}
    assert rehearsal.jobs.running().cancelling
    started = time.monotonic()
    assert rehearsal.to_end().cancelled
    assert time.monotonic() - started < 2.0
    assert with_role("mesh") == with_role("preview") == []


def test_cancelling_while_a_preview_is_shown(rehearsal: Rehearsal) -> None:
    rehearsal.start(seconds=7)
    rehearsal.to_preview()
    bpy.ops.fewview.cancel()
    assert rehearsal.to_end().cancelled
    assert with_role("preview") == []


# What users do meanwhile.


def test_undo_and_redo_while_it_runs(rehearsal: Rehearsal) -> None:
    bpy.ops.ed.undo_push(message="before")
    bpy.context.scene.fewview.seed = 7
    bpy.ops.ed.undo_push(message="the user's")
    folder = rehearsal.start(seconds=2)
    rehearsal.to_preview()
    bpy.ops.ed.undo()
    assert bpy.context.scene.fewview.seed == 0
    assert rehearsal.jobs.running() is not None
    rehearsal.tick_until(lambda: rehearsal.jobs.running().stage == "mesh")
    bpy.ops.ed.redo()
    assert bpy.context.scene.fewview.seed == 7
    assert rehearsal.to_end().failure is None
    assert_one_result(folder)


def test_undo_after_its_end_brings_no_preview_back(rehearsal: Rehearsal) -> None:
    rehearsal.start(seconds=2)
    rehearsal.to_preview()
    bpy.ops.object.empty_add()
    bpy.ops.ed.undo_push(message="the user's")
    assert rehearsal.to_end().failure is None
    bpy.ops.ed.undo_push(message="the result")  # as in a window
    bpy.ops.ed.undo()
    assert with_role("mesh") == with_role("preview") == []
    bpy.ops.ed.redo()
    assert len(with_role("mesh")) == 1


def test_undo_at_every_step(rehearsal: Rehearsal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rehearsal.jobs, "_BUDGET_S", -1.0)  # each tick is one step
    bpy.ops.ed.undo_push(message="before")
    bpy.context.scene.fewview.seed = 7
    bpy.ops.ed.undo_push(message="the user's")
    folder = rehearsal.start(seconds=0.3)
    turns = [bpy.ops.ed.redo, bpy.ops.ed.undo] * 40

    def undo_or_redo() -> bool:
        if rehearsal.jobs.running().pending is not None:  # amid the work on the scene
            turns.pop()()
        return not turns

    rehearsal.tick_until(undo_or_redo)
    assert rehearsal.to_end().failure is None
    (result,) = with_role("mesh")
    assert result["fewview_job"] == str(folder)
    assert with_role("preview") == []


def test_saving_while_it_runs(rehearsal: Rehearsal, tmp_path: Path) -> None:
    path = tmp_path / "scene.blend"
    folder = rehearsal.start(seconds=2)
    rehearsal.to_preview()
    assert bpy.ops.wm.save_as_mainfile(filepath=str(path)) == {"FINISHED"}
    assert path.is_file()
    assert rehearsal.to_end().failure is None
    assert_one_result(folder)


def test_a_saved_preview_is_gone_when_the_file_is_opened(rehearsal: Rehearsal, tmp_path: Path) -> None:
    path = tmp_path / "scene.blend"
    rehearsal.start(seconds=2)
    rehearsal.to_preview()
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    rehearsal.to_end()
    bpy.ops.wm.open_mainfile(filepath=str(path))
    assert with_role("preview") == []


def test_opening_another_file_while_it_runs(rehearsal: Rehearsal) -> None:
    folder = rehearsal.start(seconds=2)
    rehearsal.to_preview()
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    assert rehearsal.jobs.running() is not None
    end = rehearsal.to_end()
    assert end.failure is None
    assert any("Past Jobs" in text for text in end.warnings)
    assert not bpy.data.objects
    assert bpy.ops.fewview.import_result(folder=str(folder)) == {"FINISHED"}
    assert_one_result(folder)


def test_a_file_that_cannot_be_opened_leaves_it_alone(rehearsal: Rehearsal, tmp_path: Path) -> None:
    folder = rehearsal.start(seconds=2)
    rehearsal.to_preview()
    with pytest.raises(RuntimeError, match=r"none\.blend"):
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "none.blend"))
    ended = rehearsal.to_end()
    assert ended.failure is None
    assert not any("Another file" in warning for warning in ended.warnings)
    assert_one_result(folder)


@pytest.mark.parametrize("role", ["camera", "mesh"])
def test_opening_another_file_amid_the_import(
    rehearsal: Rehearsal, monkeypatch: pytest.MonkeyPatch, role: str
) -> None:
    monkeypatch.setattr(rehearsal.jobs, "_BUDGET_S", -1.0)  # each tick is one step
    rehearsal.start(seconds=0.1)
    meshes = len(bpy.data.meshes)
    rehearsal.tick_until(
        lambda: (
            rehearsal.jobs.running().finished
            and (with_role("camera") if role == "camera" else len(bpy.data.meshes) > meshes + 1)
        )
    )
    assert with_role("mesh") == []
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    assert rehearsal.to_end().failure is None
    assert not bpy.data.objects


def previews() -> list[Any]:
    return [made for made in bpy.context.scene.objects if made.get(ROLE) == "preview"]


@pytest.mark.parametrize("how", ["removed", "deleted", "hidden", "emptied"])
def test_the_preview_is_taken_away(rehearsal: Rehearsal, how: str) -> None:
    folder = rehearsal.start(seconds=2)
    preview = rehearsal.to_preview()
    match how:
        case "removed":
            bpy.data.objects.remove(preview)
        case "deleted":
            bpy.context.scene.collection.objects.unlink(preview)
        case "hidden":
            preview.hide_set(True)
        case "emptied":
            bpy.data.meshes.remove(preview.data)  # takes the object with it
    rehearsal.tick_until(lambda: [len(made.data.polygons) for made in previews()] == [4])  # the next one came
    assert rehearsal.to_end().failure is None
    assert_one_result(folder)


def test_renaming_the_scene_while_it_runs(rehearsal: Rehearsal) -> None:
    folder = rehearsal.start(seconds=2)
    rehearsal.to_preview()
    bpy.context.scene.name = "another name"
    assert rehearsal.to_end().failure is None
    assert_one_result(folder)


def test_removing_the_scene_while_it_runs(rehearsal: Rehearsal) -> None:
    folder = rehearsal.start(seconds=2)
    rehearsal.to_preview()
    first = bpy.context.scene
    other = bpy.data.scenes.new("Other")
    if bpy.context.window is not None:
        bpy.context.window.scene = other
    bpy.data.scenes.remove(first)
    end = rehearsal.to_end()
    assert "no longer there" in end.failure.text
    assert not other.objects
    assert with_role("preview") == []
    assert bpy.ops.fewview.import_result(folder=str(folder)) == {"FINISHED"}


def test_working_in_edit_mode_while_it_runs(rehearsal: Rehearsal) -> None:
    mesh = bpy.data.meshes.new("mine")
    mesh.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [], [(0, 1, 2)])
    mine = bpy.data.objects.new("mine", mesh)
    bpy.context.scene.collection.objects.link(mine)
    bpy.context.view_layer.objects.active = mine
    folder = rehearsal.start()
    bpy.ops.object.mode_set(mode="EDIT")
    assert rehearsal.to_end().failure is None
    assert mine.mode == "EDIT"
    assert bpy.context.view_layer.objects.active == mine
    bpy.ops.object.mode_set(mode="OBJECT")
    assert_one_result(folder)


def test_switching_the_add_on_off_while_it_runs(rehearsal: Rehearsal) -> None:
    rehearsal.start(seconds=20)
    rehearsal.tick_until(lambda: rehearsal.jobs.running().stage)
    process = rehearsal.jobs.running().process._process
    rehearsal.addon.unregister()
    try:
        assert process.poll() is not None
        assert rehearsal.jobs.running() is None
        assert not bpy.app.timers.is_registered(rehearsal.jobs._tick)
        assert rehearsal.jobs._tick() is None  # one that was on its way
    finally:
        rehearsal.addon.register()


def test_no_preview_is_left_where_the_add_on_is_switched_off(rehearsal: Rehearsal) -> None:
    rehearsal.start(seconds=2)
    rehearsal.to_preview()
    rehearsal.addon.unregister()
    try:
        assert with_role("preview") == []
    finally:
        rehearsal.addon.register()


# Coming and going.


def traces() -> dict[str, object]:
    """What an add-on can leave behind in Blender."""
    handlers = {
        name: [(made.__module__, made.__qualname__) for made in found]
        for name in dir(bpy.app.handlers)
        if isinstance(found := getattr(bpy.app.handlers, name), list)
    }
    return {
        "handlers": handlers,
        "types": sorted(name for name in dir(bpy.types) if name.upper().startswith("FEWVIEW")),
        "operators": list(dir(bpy.ops.fewview)),
        "settings": sorted(
            f"{kind.__name__}.{name}"
            for kind in (bpy.types.Scene, bpy.types.Object, bpy.types.WindowManager, bpy.types.Mesh)
            for name in dir(kind)
            if "fewview" in name.lower()
        ),
    }


def test_it_comes_and_goes_without_a_trace(addon: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[object] = []
    at_exit: list[object] = []
    register, unregister = bpy.utils.register_cli_command, bpy.utils.unregister_cli_command

    def add(name: str, run: object) -> object:
        commands.append(register(name, run))
        return commands[-1]

    def remove(command: object) -> None:
        commands.remove(command)
        unregister(command)

    timer = importlib.import_module(f"{addon.__name__}.jobs")._tick
    with_it = traces()
    addon.unregister()
    try:
        monkeypatch.setattr(bpy.utils, "register_cli_command", add)
        monkeypatch.setattr(bpy.utils, "unregister_cli_command", remove)
        monkeypatch.setattr(atexit, "register", at_exit.append)
        monkeypatch.setattr(atexit, "unregister", at_exit.remove)
        without = traces()
        assert without["types"] == without["operators"] == without["settings"] == []
        assert not any("fewview" in module for found in without["handlers"].values() for module, _ in found)
        for _ in range(2):
            addon.register()
            assert traces() == with_it
            assert len(commands) == len(at_exit) == 1
            addon.unregister()
            assert traces() == without
            assert commands == at_exit == []
            assert not bpy.app.timers.is_registered(timer)
    finally:
        addon.unregister()  # nothing, unless the test failed
        monkeypatch.undo()
        addon.register()


def test_the_classes_are_all_registered(addon: ModuleType) -> None:
    """None is forgotten in the tuples CLASSES."""
    for module in addon._modules():
        for made in vars(module).values():
            if isinstance(made, type) and made.__module__ == module.__name__ and "FEWVIEW_" in made.__name__:
                assert made.is_registered, made.__name__


# Past jobs.


def test_a_past_job_after_a_restart(rehearsal: Rehearsal) -> None:
    folder = rehearsal.start(seconds=0.1)
    assert rehearsal.to_end().failure is None
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    assert bpy.ops.fewview.import_result(folder=str(folder)) == {"FINISHED"}
    assert_one_result(folder)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.context.scene.fewview.output = str(folder.parent)
    assert bpy.ops.fewview.import_result() == {"FINISHED"}
    assert_one_result(folder)


@pytest.fixture
def german() -> Iterator[None]:
    view = bpy.context.preferences.view
    before = view.language, view.use_translate_new_dataname, view.use_translate_interface
    try:
        view.language = "de_DE"
    except TypeError:
        pytest.skip("this Blender has no translations")
    view.use_translate_new_dataname = view.use_translate_interface = True
    yield
    view.language, view.use_translate_new_dataname, view.use_translate_interface = before


@pytest.mark.usefixtures("german")
def test_in_a_translated_blender(rehearsal: Rehearsal) -> None:
    assert bpy.app.translations.pgettext_data("Cube") != "Cube"
    folder = rehearsal.start(seconds=0.1)
    assert rehearsal.to_end().failure is None
    result = assert_one_result(folder)
    (material,) = result.data.materials
    for node in material.node_tree.nodes:
        node.name = f"übersetzt {node.bl_idname}"  # as some translations name them
    kinds = {node.bl_idname for node in material.node_tree.nodes}
    assert kinds == {
        "ShaderNodeOutputMaterial",
        "ShaderNodeBsdfPrincipled",
        "ShaderNodeVertexColor",
        "ShaderNodeTexImage",
        "ShaderNodeUVMap",
    }

    def colour_comes_from() -> str:
        (link,) = (link for link in material.node_tree.links if link.from_socket.type == "RGBA")
        return link.from_node.bl_idname

    assert len(material.node_tree.links) == 3
    assert colour_comes_from() == "ShaderNodeTexImage"
    assert bpy.ops.fewview.show_support() == {"FINISHED"}
    assert result.data.color_attributes.active_color.name != "Color"
    assert colour_comes_from() == "ShaderNodeVertexColor"
    assert bpy.ops.fewview.show_colour() == {"FINISHED"}
    assert result.data.color_attributes.active_color.name == "Color"
    assert colour_comes_from() == "ShaderNodeTexImage"
    # Its own words stay as they are: Blender translates labels where it draws them.
    assert bpy.ops.fewview.add_region() == {"FINISHED"}


# Hostile files.

GOOD = {"protocol": 1, "images": ["0.png"], "output": "result"}


@pytest.mark.parametrize(
    "content",
    [
        pytest.param({**GOOD, "protocol": 99}, id="version"),
        pytest.param({**GOOD, "protocol": True}, id="version that is no number"),
        pytest.param({**GOOD, "execute": "rm"}, id="unknown key"),
        pytest.param({"protocol": 1}, id="missing keys"),
        pytest.param({**GOOD, "seed": 10**400}, id="huge seed"),
        pytest.param({**GOOD, "seed": -1}, id="negative seed"),
        pytest.param({**GOOD, "seed": 1.5}, id="broken seed"),
        pytest.param({**GOOD, "preset": "magic"}, id="preset"),
        pytest.param({**GOOD, "output": "../../elsewhere"}, id="output outside"),
        pytest.param({**GOOD, "output": "/"}, id="output at the root"),
        pytest.param({**GOOD, "output": "a\0b"}, id="output with a null"),
        pytest.param({**GOOD, "images": "0.png"}, id="images that are no list"),
        pytest.param({**GOOD, "region_centre": [0, 0, 0]}, id="half a region"),
        pytest.param(json.dumps(GOOD).replace("1", "NaN", 1).encode(), id="NaN"),
        pytest.param(json.dumps(GOOD).encode() + b" " * 2_000_000, id="2 MB"),
        pytest.param(b"[" * 100_000, id="deep"),
        pytest.param(b"1" * 10_000, id="long number"),
        pytest.param(b"\xff\xfe{}", id="no UTF-8"),
        pytest.param(b"", id="empty"),
        pytest.param(b"null", id="null"),
        pytest.param(None, id="a folder in its place"),
    ],
)
def test_a_hostile_job_is_refused_and_not_listed(rehearsal: Rehearsal, content: Any) -> None:
    folder = rehearsal.start(seconds=0.1)
    rehearsal.to_end()
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    assert [job.folder for job in rehearsal.folders.past_jobs(folder.parent)] == [folder]
    path = folder / "job.json"
    path.unlink()
    if content is None:
        path.mkdir()
    else:
        path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
    with pytest.raises(RuntimeError, match=r"Error: \S+"):
        bpy.ops.fewview.import_result(folder=str(folder))
    assert not bpy.data.objects
    assert not bpy.data.meshes
    assert not list(rehearsal.folders.past_jobs(folder.parent))
    bpy.context.scene.fewview.output = str(folder.parent)
    with pytest.raises(RuntimeError, match="no finished job"):
        bpy.ops.fewview.import_result()


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights on Windows")
@pytest.mark.parametrize("name", ["mesh.ply", "cameras.json"])
def test_a_result_that_lies_elsewhere_is_refused(rehearsal: Rehearsal, tmp_path: Path, name: str) -> None:
    folder = rehearsal.start(seconds=0.1)
    rehearsal.to_end()
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    inside, outside = folder / "result" / name, tmp_path / name
    inside.rename(outside)
    inside.symlink_to(outside)
    with pytest.raises(RuntimeError, match="outside"):
        bpy.ops.fewview.import_result(folder=str(folder))
    assert not bpy.data.objects


@pytest.mark.parametrize("image", ["a\0b", "/", "..", "", "x" * 10_000], ids=lambda name: name[:5])
def test_odd_names_of_photographs_do_no_harm(rehearsal: Rehearsal, image: str) -> None:
    folder = rehearsal.start(seconds=0.1)
    rehearsal.to_end()
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    (folder / "job.json").write_text(json.dumps({**GOOD, "images": [image]}), encoding="utf-8")
    assert bpy.ops.fewview.import_result(folder=str(folder)) == {"FINISHED"}
    assert_one_result(folder)
