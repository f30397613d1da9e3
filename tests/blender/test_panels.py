"""The sidebar in every state: no error, one main button a step, and a line that says how it stands."""

import importlib
import json
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import fake_layout
import pytest

bpy = pytest.importorskip("bpy", reason="needs Blender's Python, where `import bpy` works")

pytestmark = [pytest.mark.blender, pytest.mark.usefixtures("addon")]

STEPS = ("images", "cameras", "region", "reconstruct", "result")


class Sidebar:
    """The panels, and what brings them into their states."""

    def __init__(self, addon: ModuleType, patch: pytest.MonkeyPatch, folder: Path) -> None:
        self.addon, self.patch, self.folder = addon, patch, folder
        self.panels = self.part("panels")

    def part(self, name: str) -> ModuleType:
        return importlib.import_module(f"{self.addon.__name__}.{name}")

    @property
    def automatic(self) -> str:
        """Icon of a step that needs nothing of the user."""
        return str(self.part("state_lines").AUTOMATIC)

    @property
    def settings(self) -> Any:
        return bpy.context.scene.fewview

    def draw(self, name: str) -> Any:
        """One panel, which must be there."""
        layout = fake_layout.draw(getattr(self.panels, f"FEWVIEW_PT_{name}"))
        assert layout is not None
        return layout

    def line(self, step: str) -> tuple[str, str]:
        """The state line of a step: its icon, which the title shows, too, and its words."""
        label = next(drawn for drawn in self.draw(step).drawn if drawn.kind == "label")
        header = fake_layout.draw_header(getattr(self.panels, f"FEWVIEW_PT_{step}"))
        assert [drawn.icon for drawn in header.drawn] == [label.icon]
        return label.icon, label.text

    def draw_all(self) -> dict[str, Any]:
        """Every panel that is shown; each has at most one main button, and the list its lines."""
        found = {}
        for panel in self.panels.CLASSES:
            if issubclass(panel, bpy.types.Panel):
                layout = fake_layout.draw(panel)
                if layout is not None:
                    found[panel.bl_idname if "bl_idname" in vars(panel) else panel.__name__] = layout
        for step in STEPS:
            self.line(step)
        for name, layout in found.items():
            assert len(layout.main()) <= 1, f"{name}: {layout.main()}"
            assert not any(text.endswith(".") and not text.endswith("..") for text in layout.main())
        for image in self.settings.images:
            row = fake_layout.FakeLayout()
            self.panels.FEWVIEW_UL_images.draw_item(
                None, bpy.context, row, self.settings, image, 0, self.settings, "active_image"
            )
            assert image.name in row.texts()
        return found

    def backend(self, state: str) -> None:
        """Put a Python in its place of which this much is known."""
        environment = self.part("environment")
        protocol = importlib.import_module(f"{self.addon.__name__.rpartition('.')[0]}.backend.wire.protocol")
        if state == "none":
            self.patch.delenv("FEWVIEW_PYTHON", raising=False)
            return
        python = self.folder / "python"
        python.touch()
        os.utime(python, ns=(1, hash(state) % 10**9))  # another Python than in another state
        self.patch.setenv("FEWVIEW_PYTHON", str(python))
        if state != "unknown":
            fine = state == "ready"
            check = protocol.Checked(name="torch", fine=fine, found="2.13.0" if fine else "is missing")
            environment.remember(python, [check], finished=fine)

    def photographs(self, *sizes: tuple[int, int]) -> None:
        """Put pictures on the list, without files: only what is known of them."""
        for index, (width, height) in enumerate(sizes):
            image = self.settings.images.add()
            image.name = image.path = f"{index}.png"
            image.width, image.height = width, height

    def job(self, **known: Any) -> Any:
        """A job runs, of which this is known."""
        jobs = self.part("jobs")
        job = jobs.RunningJob(
            title="Reconstructing",
            process=SimpleNamespace(cancel=lambda: None, close=lambda: None),
            folder=self.folder,
            log_path=self.folder / "log",
            on_finished=lambda _: iter(()),
            on_preview=None,
            on_end=None,
            about_scene=True,
            remedy="Start it again.",
        )
        for name, value in known.items():
            setattr(job, name, value)
        self.patch.setattr(jobs, "_running", job)
        return job

    def ended(
        self, *, failure: Any = None, warnings: tuple[str, ...] = (), notes: tuple[str, ...] = ()
    ) -> None:
        """A job has ended so."""
        jobs = self.part("jobs")
        end = jobs.EndedJob(
            title="Reconstructing",
            failure=failure,
            warnings=warnings,
            checks=(),
            log_path=self.folder / "log",
            seconds=1.0,
            notes=notes,
        )
        self.patch.setattr(jobs, "_ended", end)

    def failure(self, code: str, text: str = "It is too dark.", remedy: str = "Add light.") -> Any:
        protocol = importlib.import_module(f"{self.addon.__name__.rpartition('.')[0]}.backend.wire.protocol")
        return protocol.Failed(code=code, text=text, remedy=remedy)

    def solved(self, unplaced: tuple[tuple[str, str], ...] = ()) -> Path:
        """Step 2 has found two cameras; the file."""
        poses = [[[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 5], [0, 0, 0, 1]] for x in (0, 1)]
        lens = {"w": 64, "h": 48, "fl_x": 80, "fl_y": 80, "cx": 32, "cy": 24}
        frames = [
            {"file_path": f"{index}.png", "transform_matrix": pose, **lens}
            for index, pose in enumerate(poses)
        ]
        ours = {
            "estimated": True,
            "reprojection_error_px": 0.44,
            "region": None,
            "unplaced": [{"name": name, "why": why} for name, why in unplaced],
        }
        path = self.folder / "job" / "result" / "cameras.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"frames": frames, "fewview": ours}))
        folders = self.part("job_folder")
        asked = folders.Job(protocol=1, images=("0.png", "1.png"), output="result", until="cameras")
        folders.write_job(self.folder / "job", asked)
        self.settings.cameras_job = str(self.folder / "job")
        return path

    def result(self, *, colours: bool = True, support: bool = True) -> Any:
        """A mesh has come back."""
        mesh = bpy.data.meshes.new("reconstruct-001")
        mesh.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [], [(0, 1, 2)])
        if colours:
            mesh.color_attributes.new("Color", "BYTE_COLOR", "POINT")
        if support:
            mesh.attributes.new("support", "FLOAT", "POINT")
        made = bpy.data.objects.new("reconstruct-001", mesh)
        made["fewview_role"], made["fewview_job"] = "mesh", str(self.folder / "job")
        bpy.context.scene.collection.objects.link(made)
        self.settings.result = made
        return made

    def target(self) -> Any:
        made = bpy.data.objects.new("Statue", bpy.data.meshes.new("Statue"))
        made.data.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], [], [(0, 1, 2), (0, 1, 3)])
        bpy.context.scene.collection.objects.link(made)
        self.settings.target = made
        return made


@pytest.fixture
def sidebar(addon: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Sidebar]:
    made = Sidebar(addon, monkeypatch, tmp_path)
    preferences = made.part("preferences").preferences_of(bpy.context)
    before = preferences.environment_folder, preferences.output
    preferences.environment_folder, preferences.output = str(tmp_path / "managed"), str(tmp_path / "jobs")
    system = bpy.context.preferences.system
    online = system.use_online_access
    made.part("jobs").forget()
    made.backend("ready")
    yield made
    preferences.environment_folder, preferences.output = before
    system.use_online_access = online


def delete(made: Any) -> None:
    """As the user does with the Delete key: a pointer of ours keeps it from being removed."""
    bpy.context.view_layer.objects.active = None
    for collection in tuple(made.users_collection):
        collection.objects.unlink(made)


# The fake layout itself: what it lets pass, Blender must let pass.


@pytest.mark.parametrize(
    "wrong",
    [
        lambda layout: layout.label(text="x", icon="NO_SUCH_ICON"),
        lambda layout: layout.prop(bpy.context.scene, "no_such_property"),
        lambda layout: layout.prop(None, "name"),
        lambda layout: layout.operator("fewview.no_such_operator"),
        lambda layout: layout.label(txt="x"),
        lambda layout: layout.labels(text="x"),
        lambda layout: layout.progress(factor=1.5, text="x"),
        lambda layout: setattr(layout, "scale_z", 1.0),
        lambda layout: setattr(layout, "enabled", "yes"),
        lambda layout: setattr(layout.operator("fewview.import_result"), "no_such_argument", ""),
        lambda layout: layout.template_list("FEWVIEW_UL_none", "", bpy.context.scene, "x", bpy.data, "y"),
    ],
)
def test_the_fake_layout_refuses(wrong: Callable[[Any], object]) -> None:
    with pytest.raises(AssertionError):
        wrong(fake_layout.FakeLayout())


def test_the_fake_layout_knows_what_is_large_and_what_is_grey() -> None:
    layout = fake_layout.FakeLayout()
    row = layout.box().row()
    row.scale_y, row.enabled = 1.5, False
    row.column().operator("fewview.add_images", text="Add")
    layout.operator("fewview.dismiss")
    assert layout.main() == ["fewview.add_images"]
    assert [drawn.enabled for drawn in layout.drawn] == [False, True]


# The backend.


@pytest.mark.parametrize("online", [False, True])
def test_without_a_backend(sidebar: Sidebar, online: bool) -> None:
    bpy.context.preferences.system.use_online_access = online
    if bpy.app.online_access != online:
        pytest.skip("Blender was started with --online-mode or --offline-mode")
    sidebar.backend("none")
    layout = sidebar.draw_all()["FEWVIEW_PT_main"]
    assert layout.main() == ["fewview.install_backend"]
    assert "Not set up yet" in layout.texts()
    buttons = [drawn for drawn in layout.drawn if drawn.kind == "operator" and drawn.text]
    for drawn in buttons:  # one name each
        category, name = drawn.what.split(".")
        if category == "fewview":
            assert drawn.text == getattr(bpy.ops.fewview, name).get_rna_type().name
    assert ("screen.userpref_show" in layout.operators()) == (not online)
    assert {"fewview.check_backend", "fewview.copy_install_lines"} <= set(layout.operators())
    assert not bpy.ops.fewview.reconstruct.poll()


def test_a_backend_that_failed_its_check(sidebar: Sidebar) -> None:
    sidebar.backend("broken")
    layout = sidebar.draw_all()["FEWVIEW_PT_main"]
    assert layout.main() == ["fewview.install_backend"]
    assert "torch: is missing" in layout.texts()


@pytest.mark.parametrize("state", ["unknown", "ready"])
def test_nobody_is_kept_from_work_by_a_backend_that_may_do(sidebar: Sidebar, state: str) -> None:
    sidebar.backend(state)
    assert sidebar.draw_all()["FEWVIEW_PT_main"].drawn == []
    assert bpy.ops.fewview.reconstruct.poll()


@pytest.mark.parametrize(
    ("state", "words", "main"),
    [
        ("none", "Set up FewView once", ["fewview.install_backend"]),
        ("unknown", "Not checked yet", ["fewview.check_backend"]),
        ("ready", "Ready to reconstruct", []),
    ],
)
def test_the_preferences_say_how_it_stands(sidebar: Sidebar, state: str, words: str, main: list[str]) -> None:
    sidebar.backend(state)
    module = sidebar.part("preferences")
    layout = fake_layout.FakeLayout()
    found = module.preferences_of(bpy.context)
    page = SimpleNamespace(layout=layout, bl_rna=found.bl_rna)
    module.FEWVIEW_AP_preferences.draw(page, bpy.context)
    assert words in layout.texts()
    assert layout.main() == main
    assert layout.props() == {"backend_python", "environment_folder", "torch_build", "output"}
    buttons = [drawn.what for drawn in layout.drawn if drawn.kind == "operator"]
    assert buttons.count("fewview.install_backend") == 1  # again where it is ready, but not twice
    build = [drawn.what for drawn in layout.drawn].index("torch_build")
    assert "fewview.remove_backend" in [drawn.what for drawn in layout.drawn[build:-1]]


# Step 1.


def test_an_empty_list_asks_for_photographs(sidebar: Sidebar) -> None:
    found = sidebar.draw_all()
    assert sidebar.line("images") == ("RADIOBUT_OFF", "No photographs yet")
    assert found["FEWVIEW_PT_images"].main() == ["fewview.add_images"]
    assert sidebar.line("reconstruct") == ("RADIOBUT_OFF", "Add photographs in step 1 first")
    assert not found["FEWVIEW_PT_reconstruct"].operators()["fewview.reconstruct"].enabled
    assert found["FEWVIEW_PT_reconstruct"].main() == []
    assert sidebar.line("result") == ("RADIOBUT_OFF", "No mesh yet")
    assert found["FEWVIEW_PT_result"].operators() == {}
    assert "FEWVIEW_PT_render" not in found


def test_enough_photographs(sidebar: Sidebar) -> None:
    sidebar.photographs(*[(800, 600)] * 3)
    found = sidebar.draw_all()
    assert sidebar.line("images") == ("CHECKMARK", "3 photographs")
    assert found["FEWVIEW_PT_images"].main() == []
    assert sidebar.line("reconstruct") == ("PLAY", "Ready to start")
    assert found["FEWVIEW_PT_reconstruct"].main() == ["fewview.reconstruct"]


@pytest.mark.parametrize(
    ("sizes", "words"),
    [
        ([(800, 600)], "One photograph shows no depth: add more"),
        ([(800, 600)] * 2, "Two photographs are few"),
        ([(800, 600), (600, 800), (700, 600)], "Sizes differ"),
        ([(800, 600)] * 41, "Many photographs take long"),
    ],
)
def test_a_doubtful_list_says_why(sidebar: Sidebar, sizes: list[tuple[int, int]], words: str) -> None:
    sidebar.photographs(*sizes)
    layout = sidebar.draw_all()["FEWVIEW_PT_images"]
    assert words in " ".join(layout.texts())
    assert sidebar.line("images")[0] == "ERROR"


def test_sizes_of_turned_photographs_do_not_differ(sidebar: Sidebar) -> None:
    sidebar.photographs((800, 600), (600, 800), (800, 600))
    assert sidebar.line("images") == ("CHECKMARK", "3 photographs")


def test_a_missing_file_is_shown(sidebar: Sidebar) -> None:
    sidebar.photographs(*[(800, 600)] * 3)
    sidebar.settings.images[1].problem = "The file is missing"
    sidebar.settings.active_image = 1
    layout = sidebar.draw_all()["FEWVIEW_PT_images"]
    assert sidebar.line("images") == ("ERROR", "1 of 3 files missing")
    assert any(drawn.icon == "ERROR" and "missing" in drawn.text for drawn in layout.drawn)
    sidebar.settings.images[1].use = False
    sidebar.settings.active_image = 0
    sidebar.draw_all()
    assert sidebar.line("images") == ("ERROR", "2 photographs")  # few, but not missing
    sidebar.settings.images[0].use = False
    assert sidebar.line("images") == ("ERROR", "1 photograph in use")
    sidebar.settings.images[2].problem = "The file is missing"
    assert sidebar.line("images") == ("ERROR", "1 of 1 file missing")
    sidebar.settings.images[2].use = False
    assert sidebar.line("images") == ("ERROR", "0 photographs in use")


def test_an_active_photograph_that_is_not_there(sidebar: Sidebar) -> None:
    sidebar.photographs(*[(800, 600)] * 3)
    for index in (-1, 3, 10**6):
        sidebar.settings.active_image = index
        sidebar.draw_all()


def test_the_generated_cameras_come_before_the_rendering(sidebar: Sidebar) -> None:
    sidebar.settings.source = "RENDER"
    layout = sidebar.draw_all()["FEWVIEW_PT_images"]
    assert layout.main() == ["fewview.generate_views"]
    assert not {"fewview.render_views", "fewview.remove_views"} & set(layout.operators())
    target = sidebar.target()
    assert bpy.ops.fewview.generate_views(target=target.name) == {"FINISHED"}
    layout = sidebar.draw_all()["FEWVIEW_PT_images"]
    assert layout.main() == ["fewview.render_views"]
    assert layout.operators()["fewview.generate_views"].text == "Generate Again"
    assert layout.operators()["fewview.remove_views"].icon == "X"
    sidebar.photographs(*[(800, 600)] * 3)
    assert sidebar.draw_all()["FEWVIEW_PT_images"].main() == []


@pytest.mark.parametrize("cameras", ["SELECTED", "ANIMATED"])
def test_the_users_own_cameras(sidebar: Sidebar, cameras: str) -> None:
    sidebar.settings.source, sidebar.settings.view_cameras = "RENDER", cameras
    found = sidebar.draw_all()
    layout = found["FEWVIEW_PT_images"]
    assert layout.main() == ["fewview.render_views"]
    assert ("frame_step" in layout.props()) == (cameras == "ANIMATED")
    assert "lens_mm" not in found["FEWVIEW_PT_render"].props()
    assert not bpy.ops.fewview.render_views.poll()  # greyed: there is none yet


@pytest.mark.parametrize(
    ("layout", "arc", "elevation"), [("ARC", 1, 1), ("RING", 0, 1), ("HEMISPHERE", 0, 0)]
)
def test_each_layout_shows_what_it_takes(sidebar: Sidebar, layout: str, arc: int, elevation: int) -> None:
    sidebar.settings.source, sidebar.settings.layout = "RENDER", layout
    props = sidebar.draw_all()["FEWVIEW_PT_images"].props()
    assert ("arc" in props, "elevation" in props) == (bool(arc), bool(elevation))


@pytest.mark.parametrize("engine", ["CYCLES", "WORKBENCH", "SCENE"])
def test_samples_belong_to_cycles(sidebar: Sidebar, engine: str) -> None:
    sidebar.settings.source, sidebar.settings.engine = "RENDER", engine
    assert ("samples" in sidebar.draw_all()["FEWVIEW_PT_render"].props()) == (engine == "CYCLES")


# Steps 2 and 3.


def test_cameras_are_estimated_unless_they_are_known(sidebar: Sidebar) -> None:
    layout = sidebar.draw_all()["FEWVIEW_PT_cameras"]
    assert sidebar.line("cameras") == (sidebar.automatic, "Estimated when you reconstruct")
    assert layout.operators()["fewview.estimate_cameras"].text == "Estimate Cameras"
    assert "fewview.show_photograph" not in layout.operators()
    sidebar.settings.camera_source = "KNOWN"
    assert sidebar.line("cameras") == ("RADIOBUT_OFF", "No file chosen")
    sidebar.settings.cameras_path = str(sidebar.folder / "transforms.json")
    assert sidebar.line("cameras") == ("ERROR", "The file is missing")
    (sidebar.folder / "transforms.json").touch()
    assert sidebar.line("cameras") == ("CHECKMARK", "Known")
    layout = sidebar.draw_all()["FEWVIEW_PT_cameras"]
    assert layout.operators()["fewview.estimate_cameras"].text == "Load Cameras"
    assert "cameras_path" in layout.props()


def test_found_cameras_and_who_has_none(sidebar: Sidebar) -> None:
    sidebar.solved()
    layout = sidebar.draw_all()["FEWVIEW_PT_cameras"]
    assert sidebar.line("cameras") == ("CHECKMARK", "2 of 2 photographs placed")
    assert "Accurate to 0.4 pixels" in layout.texts()
    assert {"fewview.remove_cameras", "fewview.show_photograph"} <= set(layout.operators())
    path = sidebar.solved(unplaced=(("dark.jpg", "too few features"),))
    os.utime(path, ns=(1, 1))  # within the same tick of the file system's clock, maybe
    layout = sidebar.draw_all()["FEWVIEW_PT_cameras"]
    assert sidebar.line("cameras") == ("ERROR", "2 of 3 photographs placed")
    assert {"dark.jpg could not be placed", "too few features"} <= set(layout.texts())
    sidebar.settings.camera_source = "KNOWN"  # others, which are not loaded
    sidebar.settings.cameras_path = str(path)
    assert sidebar.line("cameras") == ("CHECKMARK", "Known")


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b'{"frames": []}', None])
def test_damaged_cameras_are_as_none(sidebar: Sidebar, content: bytes | None) -> None:
    path = sidebar.solved()
    path.unlink()
    if content is None:
        path.mkdir()
    else:
        path.write_bytes(content)
    sidebar.draw_all()
    assert sidebar.line("cameras") == (sidebar.automatic, "Estimated when you reconstruct")


def test_a_region_and_one_that_was_deleted(sidebar: Sidebar) -> None:
    assert sidebar.line("region") == (sidebar.automatic, "Found automatically")
    assert bpy.ops.fewview.add_region() == {"FINISHED"}
    layout = sidebar.draw_all()["FEWVIEW_PT_region"]
    assert sidebar.line("region") == ("CHECKMARK", "Set by the sphere in the scene")
    assert layout.props() == {"location", "scale"}
    delete(sidebar.settings.region)
    assert sidebar.settings.region is not None  # the pointer keeps it
    layout = sidebar.draw_all()["FEWVIEW_PT_region"]
    assert sidebar.line("region") == (sidebar.automatic, "Found automatically")
    assert set(layout.operators()) == {"fewview.add_region"}
    assert bpy.ops.fewview.add_region() == {"FINISHED"}
    assert sidebar.line("region")[0] == "CHECKMARK"


# Jobs.


def test_a_job_that_starts(sidebar: Sidebar) -> None:
    sidebar.job()
    layout = sidebar.draw_all()["FEWVIEW_PT_main"]
    (bar,) = [drawn for drawn in layout.drawn if drawn.kind == "progress"]
    assert (bar.values["factor"], bar.text) == (0.0, "Starting  0%")
    assert set(layout.operators()) == {"fewview.cancel", "fewview.show_log"}
    assert not any("left" in text for text in layout.texts())
    assert not bpy.ops.fewview.reconstruct.poll()


def test_a_job_on_its_way(sidebar: Sidebar) -> None:
    before = ["photos", "cameras", "region"]
    sidebar.job(
        stage="stereo",
        stages_before=before,
        stage_index=4,
        stage_count=7,
        fraction=0.5,
        text="view 2 of 6",
        started_s=time.monotonic() - 60,
        warnings=["first", "second", "third"],
    )
    texts = sidebar.draw_all()["FEWVIEW_PT_main"].texts()
    assert "view 2 of 6" in texts
    assert any(text.startswith("Comparing photographs  ") for text in texts)
    assert any(text.startswith("About ") for text in texts)
    assert [text for text in ("first", "second", "third") if text in texts] == ["second", "third"]
    assert not any("sign of life" in text for text in texts)


def test_a_job_of_unknown_stages(sidebar: Sidebar) -> None:
    sidebar.job(stage="something_new", stage_index=9, stage_count=2, fraction=1.0)
    assert any("Something new" in text for text in sidebar.draw_all()["FEWVIEW_PT_main"].texts())


def test_a_job_that_is_silent_for_long(sidebar: Sidebar) -> None:
    sidebar.job(stage="train", stage_index=5, stage_count=7, heard_s=time.monotonic() - 40)
    texts = " ".join(sidebar.draw_all()["FEWVIEW_PT_main"].texts())
    assert "No sign of life for 40 s" in texts


def test_a_job_that_stops(sidebar: Sidebar) -> None:
    sidebar.job(stage="train", stage_index=5, stage_count=7, cancelling=True)
    assert "Stopping..." in sidebar.draw_all()["FEWVIEW_PT_main"].texts()
    assert not bpy.ops.fewview.cancel.poll()


def test_a_running_job_hides_how_the_last_one_ended(sidebar: Sidebar) -> None:
    sidebar.ended(failure=sidebar.failure("too_dark"))
    sidebar.job()
    sidebar.backend("none")
    layout = sidebar.draw_all()["FEWVIEW_PT_main"]
    assert set(layout.operators()) == {"fewview.cancel", "fewview.show_log"}


def test_a_job_that_failed(sidebar: Sidebar) -> None:
    sidebar.ended(
        failure=sidebar.failure("crashed", "The backend ended.\nTraceback\nand more", ""),
        warnings=tuple("abcde"),
    )
    layout = sidebar.draw_all()["FEWVIEW_PT_main"]
    texts = layout.texts()
    assert texts[:2] == ["Reconstructing failed", "The backend ended."]
    assert "Traceback" not in texts
    assert set(layout.operators()) == {"fewview.dismiss", "fewview.show_log", "fewview.copy_report"}
    assert not any(drawn.icon == "FORWARD" for drawn in layout.drawn)  # there is no remedy
    assert [text for text in texts if text in "abcde"] == ["a", "b", "c"]
    sidebar.ended(failure=sidebar.failure("too_dark"))
    layout = sidebar.draw_all()["FEWVIEW_PT_main"]
    assert ("Add light.", "FORWARD") in [(drawn.text, drawn.icon) for drawn in layout.drawn]
    assert bpy.ops.fewview.dismiss() == {"FINISHED"}
    assert sidebar.draw_all()["FEWVIEW_PT_main"].drawn == []


def test_a_job_that_was_cancelled(sidebar: Sidebar) -> None:
    sidebar.ended(failure=sidebar.failure("cancelled", "Stopped."))
    layout = sidebar.draw_all()["FEWVIEW_PT_main"]
    assert layout.texts() == ["Reconstructing was cancelled", "Add light."]  # what to do next
    assert set(layout.operators()) == {"fewview.dismiss"}


def test_a_job_that_ended_well(sidebar: Sidebar) -> None:
    sidebar.ended(warnings=("dark.jpg is dark",))
    assert sidebar.draw_all()["FEWVIEW_PT_main"].texts() == ["Reconstructing is done", "dark.jpg is dark"]
    sidebar.ended(notes=("3 pictures",))
    assert sidebar.draw_all()["FEWVIEW_PT_main"].texts() == ["Reconstructing is done", "3 pictures"]
    sidebar.ended()
    assert sidebar.draw_all()["FEWVIEW_PT_main"].drawn == []


# Step 5.


def test_a_result_and_what_can_be_done_with_it(sidebar: Sidebar) -> None:
    sidebar.photographs(*[(800, 600)] * 3)
    made = sidebar.result()
    found = sidebar.draw_all()
    assert sidebar.line("result") == ("CHECKMARK", made.name)
    assert sidebar.line("reconstruct") == ("CHECKMARK", "Done; start again as you like")
    layout = found["FEWVIEW_PT_result"]
    assert layout.main() == []
    names = ["show_colour", "show_support", "show_error", "decimate", "remesh", "export"]
    names += ["open_folder"]
    assert set(layout.operators()) == {f"fewview.{name}" for name in names}
    assert bpy.ops.fewview.show_support() == {"FINISHED"}
    texts = " ".join(sidebar.draw_all()["FEWVIEW_PT_result"].texts())
    assert sidebar.part("heat_map").SUPPORT.legend in texts
    assert not bpy.ops.fewview.show_error.poll()


@pytest.mark.parametrize("name", ["mesh.ply", "radiance.npz"])
def test_a_result_with_its_files_can_be_rendered(sidebar: Sidebar, name: str) -> None:
    sidebar.result()
    path = sidebar.folder / "job" / "result" / name
    path.parent.mkdir(parents=True)
    path.touch()
    assert "fewview.render_novel_views" in sidebar.draw_all()["FEWVIEW_PT_result"].operators()
    path.unlink()
    assert "fewview.render_novel_views" not in sidebar.draw_all()["FEWVIEW_PT_result"].operators()


def test_the_report_has_a_button_while_it_is_there(sidebar: Sidebar) -> None:
    """A surface fitted to points has none."""
    sidebar.result()
    page = sidebar.folder / "job" / "result" / "report.html"
    page.parent.mkdir(parents=True)
    for there in (True, False):
        page.touch() if there else page.unlink()
        layout = sidebar.draw_all()["FEWVIEW_PT_result"]
        assert ("fewview.open_report" in layout.operators()) == there


def test_the_report_of_the_cameras_has_a_button_while_it_is_there(sidebar: Sidebar) -> None:
    page = sidebar.solved().with_name("cameras.html")
    sidebar.result()
    steps = ("FEWVIEW_PT_cameras", "FEWVIEW_PT_result")
    for there in (True, False):
        page.touch() if there else page.unlink()
        found = sidebar.draw_all()
        assert ["fewview.open_camera_report" in found[step].operators() for step in steps] == [there] * 2
    page.touch()
    bpy.context.scene.fewview.camera_source = "KNOWN"  # others than those of the report
    assert "fewview.open_camera_report" not in sidebar.draw_all()["FEWVIEW_PT_result"].operators()


def test_a_result_without_colours_and_support(sidebar: Sidebar) -> None:
    sidebar.result(colours=False, support=False)
    sidebar.draw_all()
    assert not bpy.ops.fewview.show_colour.poll()
    assert not bpy.ops.fewview.show_support.poll()


def test_a_result_beside_the_original(sidebar: Sidebar) -> None:
    made, target = sidebar.result(), sidebar.target()
    layout = sidebar.draw_all()["FEWVIEW_PT_result"]
    assert "fewview.measure_error" in layout.operators()
    assert "hide_viewport" in layout.props()
    assert bpy.ops.fewview.measure_error() == {"FINISHED"}
    texts = " ".join(sidebar.draw_all()["FEWVIEW_PT_result"].texts())
    assert "Distance from the original: median 0.00 %" in texts
    made["fewview_error_percent"] = "nonsense"
    sidebar.draw_all()
    delete(target)
    assert "fewview.measure_error" not in sidebar.draw_all()["FEWVIEW_PT_result"].operators()


def test_the_numbers_of_the_report(sidebar: Sidebar) -> None:
    sidebar.result()
    path = sidebar.folder / "job" / "result" / "report.json"
    path.parent.mkdir(parents=True)
    path.write_text('{"mesh": {"num_faces": 12345}, "total_seconds": 61.2}')
    texts = sidebar.draw_all()["FEWVIEW_PT_result"].texts()
    assert {"12,345 triangles", "Computed in 61 s"} <= set(texts)


def test_the_numbers_of_a_surface_fitted_to_points(sidebar: Sidebar) -> None:
    """Its report has fewer keys, and no visible part: there are no cameras."""
    sidebar.result()
    path = sidebar.folder / "job" / "result" / "report.json"
    path.parent.mkdir(parents=True)
    report: dict[str, Any] = {
        "mesh": {"num_faces": 2000, "watertight": True},
        "total_seconds": 3.4,
        "error": {"visible": None, "whole": {"chamfer_percent": 0.123}},
    }
    lines = ["2,000 triangles, closed", "Error of the whole: 0.12 % of the size", "Computed in 3 s"]
    read = sidebar.part("result_numbers").result_lines

    def shown() -> list[str]:
        path.write_text(json.dumps(report))
        os.utime(path, ns=(len(json.dumps(report)),) * 2)  # each is another file
        found = list(read(sidebar.folder / "job"))
        texts = sidebar.draw_all()["FEWVIEW_PT_result"].texts()
        assert texts[1 : 1 + len(found)] == found
        return found

    assert shown() == lines
    del report["error"]["visible"]
    assert shown() == lines
    report["error"] = None
    assert shown() == [lines[0], lines[2]]
    report["mesh"]["watertight"] = False
    assert shown() == ["2,000 triangles, open", lines[2]]
    report["mesh"]["watertight"] = "perhaps"
    assert shown() == ["2,000 triangles", lines[2]]
    del report["error"], report["total_seconds"], report["mesh"]["watertight"]
    assert shown() == ["2,000 triangles"]
    del report["mesh"]
    assert shown() == []


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(b"[]", id="list"),
        pytest.param(b"{", id="cut"),
        pytest.param(b"\xff", id="no text"),
        pytest.param(b'{"mesh": {"num_faces": 1e999}}', id="infinite"),
        pytest.param(b'{"mesh": {"num_faces": 1%s}}' % (b"0" * 400), id="huge"),
        pytest.param(b"[" * 100_000, id="deep"),
    ],
)
def test_a_damaged_report_has_no_numbers(sidebar: Sidebar, content: bytes) -> None:
    sidebar.result()
    path = sidebar.folder / "job" / "result" / "report.json"
    path.parent.mkdir(parents=True)
    path.write_bytes(content)
    assert not any("triangles" in text for text in sidebar.draw_all()["FEWVIEW_PT_result"].texts())


def test_the_selected_result_is_the_one_that_is_shown(sidebar: Sidebar) -> None:
    first, second = sidebar.result(), sidebar.result()
    assert sidebar.line("result")[1] == second.name
    bpy.context.view_layer.objects.active = first
    assert sidebar.line("result")[1] == first.name
    sidebar.draw_all()


def test_a_deleted_result_is_none(sidebar: Sidebar) -> None:
    sidebar.photographs(*[(800, 600)] * 3)
    delete(sidebar.result())
    assert sidebar.settings.result is not None  # the pointer keeps it
    found = sidebar.draw_all()
    assert sidebar.line("result") == ("RADIOBUT_OFF", "No mesh yet")
    assert found["FEWVIEW_PT_result"].operators() == {}
    assert sidebar.line("reconstruct") == ("PLAY", "Ready to start")


def test_a_result_that_is_no_mesh_any_more(sidebar: Sidebar) -> None:
    sidebar.settings.result = bpy.data.objects.new("curve", bpy.data.curves.new("curve", "CURVE"))
    bpy.context.scene.collection.objects.link(sidebar.settings.result)
    sidebar.draw_all()
    assert sidebar.line("result") == ("RADIOBUT_OFF", "No mesh yet")


def test_past_jobs_can_be_imported(sidebar: Sidebar) -> None:
    layout = sidebar.draw_all()["FEWVIEW_PT_past_jobs"]
    assert layout.texts() == ["None in the output folder", "Import Result..."]
    assert not hasattr(layout.drawn[-1].button, "folder")
    folders = [sidebar.folder / "jobs" / f"reconstruct-{number:03d}" for number in range(12)]
    for folder in folders:
        (folder / "result").mkdir(parents=True)
        (folder / "result" / "mesh.ply").touch()
        images = ["photos"] if folder == folders[5] else ["a.png"] * 4
        asked = {"protocol": 1, "images": images, "output": "result", "preset": "fast"}
        (folder / "job.json").write_text(json.dumps(asked))
    os.utime(folders[3] / "result" / "mesh.ply", (2e9, 2e9))
    os.utime(folders[5] / "result" / "mesh.ply", (1.9e9, 1.9e9))
    buttons = [d for d in sidebar.draw_all()["FEWVIEW_PT_past_jobs"].drawn if d.kind == "operator"]
    assert len(buttons) == 8 + 1
    assert (buttons[0].what, buttons[0].text) == (
        "fewview.import_result",
        "reconstruct-003: fast, 4 images",
    )
    assert buttons[0].button.folder == str(folders[3])
    assert buttons[1].text == "reconstruct-005: fast"  # how many lie in a folder is not known
    assert (buttons[-1].what, buttons[-1].text) == ("fewview.import_result", "Import Result...")
    assert not hasattr(buttons[-1].button, "folder")  # it opens a file browser


def test_points_alone_have_a_box(sidebar: Sidebar) -> None:
    layout = sidebar.draw_all()["FEWVIEW_PT_points"]
    assert set(layout.operators()) == {"fewview.fit_points"}
    assert layout.props() == {"point_method", "point_normals"}
    assert layout.main() == []  # it is not the step to take next
    assert "DEFAULT_CLOSED" in sidebar.panels.FEWVIEW_PT_points.bl_options


# Undo and other files.


def test_all_panels_after_undo_and_in_another_file(sidebar: Sidebar) -> None:
    bpy.ops.ed.undo_push(message="empty")
    sidebar.photographs(*[(800, 600)] * 3)
    sidebar.solved()
    sidebar.result()
    sidebar.target()
    bpy.ops.fewview.add_region()
    bpy.ops.ed.undo_push(message="full")
    sidebar.draw_all()
    assert sidebar.line("result")[0] == "CHECKMARK"
    bpy.ops.ed.undo()
    if sidebar.settings.result is not None:  # add_region pushed a step of its own
        bpy.ops.ed.undo()
    sidebar.draw_all()
    assert sidebar.line("result") == ("RADIOBUT_OFF", "No mesh yet")
    bpy.ops.ed.redo()
    sidebar.draw_all()
    path = sidebar.folder / "saved.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    sidebar.draw_all()
    assert sidebar.line("images") == ("RADIOBUT_OFF", "No photographs yet")
    bpy.ops.wm.open_mainfile(filepath=str(path))
    sidebar.draw_all()
    assert sidebar.line("result")[0] == "CHECKMARK"
    assert sidebar.line("images") == ("CHECKMARK", "3 photographs")


def test_what_panels_ask_of_a_scene_of_many_objects_is_quick(sidebar: Sidebar) -> None:
    """They are drawn many times a second: a known object is found at once, ours in one short pass."""
    scene, mesh = bpy.context.scene, bpy.data.meshes.new("many")
    for index in range(4_000):
        scene.collection.objects.link(bpy.data.objects.new(f"{index}", mesh))
    result, in_scene, jobs_of = (
        sidebar.result(),
        sidebar.part("scenes").in_scene,
        sidebar.part("camera_objects").jobs_of,
    )

    def shortest_s(work: Callable[[], object]) -> float:
        """Of many: now and then another program has the core."""
        times = []
        for _ in range(30):
            started = time.perf_counter()
            work()
            times.append(time.perf_counter() - started)
        return min(times)

    one_pass_s = shortest_s(lambda: [made for made in scene.objects if "mark" in made])
    assert shortest_s(lambda: in_scene(scene, result)) < one_pass_s / 10
    assert shortest_s(lambda: jobs_of(scene)) < 2 * one_pass_s


def test_a_narrow_sidebar_breaks_lines_and_loses_no_word(sidebar: Sidebar) -> None:
    text = "3 to 20 pictures of one thing, each from a step further round it"
    for width in (1, 120, 300, 2000):
        layout = fake_layout.FakeLayout()
        context = SimpleNamespace(preferences=bpy.context.preferences, region=SimpleNamespace(width=width))
        sidebar.panels.draw_text(layout, context, text, icon="ERROR")
        assert " ".join(layout.texts()) == text
        icons = [drawn.icon for drawn in layout.drawn]
        assert icons == ["ERROR"] + ["BLANK1"] * (len(icons) - 1)
    assert len(icons) == 1


def test_words_without_end_leave_room_for_the_buttons(sidebar: Sidebar) -> None:
    """Of a program gone mad: they are drawn many times a second."""
    endless = "word " * 200_000
    sidebar.job(stage="mesh", stage_count=1, text=endless, warnings=[endless])
    began = time.perf_counter()
    drawn = sidebar.draw("main").drawn
    assert time.perf_counter() - began < 0.05
    assert len(drawn) < 200
    assert sum(len(one.text) for one in drawn) < 5000
