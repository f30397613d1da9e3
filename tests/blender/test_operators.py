"""All operators: their words, whether they can be undone, why each is greyed; the list of photographs."""

import importlib
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

bpy = pytest.importorskip("bpy", reason="needs Blender's Python, where `import bpy` works")

pytestmark = [pytest.mark.blender, pytest.mark.usefixtures("addon")]

Set = Callable[["Situation"], None]


@dataclass(frozen=True, kw_only=True)
class Expected:
    """What is asked of an operator."""

    undo: bool
    """Whether it changes data, at once: what a job brings later has its own undo step."""
    grey: tuple[tuple[Set, str], ...] = ()
    """Ways into states in which it must be greyed, and words of the reason."""


class Situation:
    """Brings Blender and the add-on into a state, and out of it again."""

    def __init__(self, addon: ModuleType, patch: pytest.MonkeyPatch, folder: Path) -> None:
        self.addon, self.patch, self.folder = addon, patch, folder
        self.settings = bpy.context.scene.fewview

    def part(self, name: str) -> ModuleType:
        return importlib.import_module(f"{self.addon.__name__}.{name}")

    def nothing(self) -> None:
        """As after File > New."""

    def running(self, *, cancelling: bool = False) -> None:
        job = SimpleNamespace(title="Reconstructing", cancelling=cancelling, about_scene=False)
        self.patch.setattr(self.part("jobs"), "_running", job)

    def cancelling(self) -> None:
        self.running(cancelling=True)

    def no_backend(self) -> None:
        self.patch.delenv("FEWVIEW_PYTHON", raising=False)
        self.part("preferences").preferences_of(bpy.context).environment_folder = str(self.folder)

    def wrong_backend(self) -> None:
        self.patch.setenv("FEWVIEW_PYTHON", str(self.folder / "nowhere"))

    def some_backend(self) -> None:
        self.patch.setenv("FEWVIEW_PYTHON", sys.executable)
        self.patch.setattr(self.part("environment"), "_known", {})

    def few_points(self) -> None:
        self.some_backend()
        self.result()

    def editing_points(self) -> None:
        self.some_backend()
        self.editing()

    def result_and_running(self) -> None:
        self.result()
        self.running()

    def offline(self) -> None:
        bpy.context.preferences.system.use_online_access = False

    def online(self) -> None:
        bpy.context.preferences.system.use_online_access = True
        if not bpy.app.online_access:
            pytest.skip("Blender was started with --offline-mode")

    def online_and_running(self) -> None:
        self.online()
        self.running()

    def result(self) -> None:
        """A mesh without colours and support."""
        mesh = bpy.data.meshes.new("result")
        mesh.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [], [(0, 1, 2)])
        made = bpy.data.objects.new("result", mesh)
        made["fewview_role"] = "mesh"
        bpy.context.scene.collection.objects.link(made)
        bpy.context.view_layer.objects.active = made
        self.settings.result = made

    def editing(self) -> None:
        self.result()
        bpy.ops.object.mode_set(mode="EDIT")

    def region(self) -> None:
        assert bpy.ops.fewview.add_region() == {"FINISHED"}

    def linked_scene(self) -> None:
        """A scene of another file, with something to look at."""
        self.result()
        own, path = bpy.context.scene, str(self.folder / "other.blend")
        bpy.data.libraries.write(path, {own})
        with bpy.data.libraries.load(path, link=True) as (given, wanted):
            wanted.scenes = given.scenes
        bpy.context.window.scene = next(made for made in bpy.data.scenes if made != own)

    def made_environment(self) -> None:
        self.patch.setattr(self.part("environment"), "can_be_removed", lambda _: True)
        self.running()


ON_RESULT = ((Situation.nothing, "Reconstruct first"), (Situation.editing, "Object Mode"))
NEEDS_OWN_SCENE = (
    Situation.linked_scene,
    "is linked from other.blend and takes no new objects: make it local",
)
NEEDS_BACKEND = (
    (Situation.no_backend, "press Set Up FewView"),
    (Situation.wrong_backend, "is not there"),
)

OPERATORS = {
    "add_images": Expected(undo=True),
    "add_region": Expected(undo=True, grey=((Situation.region, "a region already"), NEEDS_OWN_SCENE)),
    "cancel": Expected(
        undo=False,
        grey=((Situation.nothing, "Nothing is running"), (Situation.cancelling, "stopping already")),
    ),
    "check_backend": Expected(undo=False, grey=((Situation.running, "Wait until"),)),
    "clear_images": Expected(undo=True, grey=((Situation.nothing, "Add photographs first"),)),
    "copy_install_lines": Expected(undo=False),
    "copy_report": Expected(undo=False),
    "decimate": Expected(undo=True, grey=ON_RESULT),
    "dismiss": Expected(undo=False),
    "estimate_cameras": Expected(
        undo=False, grey=((Situation.running, "Wait for"), *NEEDS_BACKEND, NEEDS_OWN_SCENE)
    ),
    "export": Expected(undo=False, grey=ON_RESULT),
    "fit_region": Expected(undo=True, grey=(NEEDS_OWN_SCENE,)),
    "fit_points": Expected(
        undo=False,
        grey=(
            (Situation.running, "still running"),
            *NEEDS_BACKEND,
            (Situation.some_backend, "Select a mesh or a point cloud"),
            (Situation.few_points, "Only 3 points"),
            (Situation.editing_points, "Object Mode"),
            NEEDS_OWN_SCENE,
        ),
    ),
    "generate_views": Expected(undo=True, grey=((Situation.nothing, "Add an object"), NEEDS_OWN_SCENE)),
    "import_cameras": Expected(undo=True, grey=(NEEDS_OWN_SCENE,)),
    "import_result": Expected(undo=True, grey=((Situation.editing, "Object Mode"), NEEDS_OWN_SCENE)),
    "install_backend": Expected(
        undo=False,
        grey=((Situation.offline, "Allow Online Access"), (Situation.online_and_running, "Wait until")),
    ),
    "measure_error": Expected(undo=True, grey=ON_RESULT),
    "open_camera_report": Expected(undo=False, grey=((Situation.nothing, "Estimate the cameras"),)),
    "open_folder": Expected(undo=False),
    "open_report": Expected(undo=False),
    "reconstruct": Expected(
        undo=False, grey=((Situation.running, "still running"), *NEEDS_BACKEND, NEEDS_OWN_SCENE)
    ),
    "remesh": Expected(undo=True, grey=ON_RESULT),
    "remove_backend": Expected(
        undo=False,
        grey=((Situation.no_backend, "no environment"), (Situation.made_environment, "Wait until")),
    ),
    "remove_cameras": Expected(undo=True, grey=((Situation.nothing, "no imported cameras"),)),
    "remove_image": Expected(undo=True, grey=((Situation.nothing, "Add photographs first"),)),
    "remove_region": Expected(undo=True, grey=((Situation.nothing, "no region"),)),
    "remove_views": Expected(undo=True, grey=((Situation.nothing, "no generated cameras"),)),
    "render_novel_views": Expected(
        undo=False,
        grey=(
            *ON_RESULT,
            (Situation.result_and_running, "still running"),
            (Situation.few_points, "files of the job are gone"),
        ),
    ),
    "render_views": Expected(
        undo=False, grey=((Situation.running, "Wait for"), (Situation.nothing, "Generate cameras first"))
    ),
    "show_colour": Expected(undo=True, grey=(*ON_RESULT, (Situation.result, "no colors"))),
    "show_error": Expected(undo=True, grey=(*ON_RESULT, (Situation.result, "Measure the error first"))),
    "show_log": Expected(undo=True, grey=((Situation.nothing, "No job has run"),)),
    "show_photograph": Expected(undo=True, grey=((Situation.nothing, "Estimate the cameras first"),)),
    "show_support": Expected(undo=True, grey=(*ON_RESULT, (Situation.result, "support"))),
}
GREY = [
    pytest.param(name, into, words, id=f"{name}-{into.__name__}")
    for name, expected in OPERATORS.items()
    for into, words in expected.grey
]
FILE_BROWSER = {"filepath", "directory", "files", "filter_glob", "check_existing"}
"""Properties that Blender's file browser gives a meaning."""
SMALL_WORDS = {"a", "an", "and", "as", "at", "by", "for", "from", "in", "of", "on", "or", "the", "to", "with"}


@pytest.fixture
def situation(addon: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Situation]:
    preferences = bpy.context.preferences
    online = preferences.system.use_online_access
    made = Situation(addon, monkeypatch, tmp_path)
    made.part("jobs").forget()
    chosen = made.part("preferences").preferences_of(bpy.context)
    before = chosen.environment_folder
    yield made
    if bpy.context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    chosen.environment_folder = before
    preferences.system.use_online_access = online


@pytest.mark.parametrize("allowed", [True, False])
def test_a_reconstruction_may_go_online_where_blender_may(
    allowed: bool, situation: Situation, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (situation.online if allowed else situation.offline)()
    module = situation.part("operators.reconstruct")
    environments: list[dict[str, str] | None] = []
    monkeypatch.setattr(module.jobs, "start", lambda *_, **k: environments.append(k["environment"]))
    job = module.Job(protocol=module.PROTOCOL_VERSION, images=("photos",), output="result")
    module.start(Path("python"), tmp_path, job, scene_name=bpy.context.scene.name)
    if allowed:
        assert environments == [None]
    else:
        (environment,) = environments
        assert environment is not None
        assert environment["FEWVIEW_OFFLINE"] == "1"
        assert "PYTHONPATH" in environment


@pytest.fixture
def settings(addon: ModuleType) -> Any:
    return bpy.context.scene.fewview


def is_title(text: str) -> bool:
    """Whether it is in title case, as Blender's labels are."""
    words = text.split()
    return bool(words) and all(
        word[0].isupper() or not word[0].isalpha() or (index > 0 and word in SMALL_WORDS)
        for index, word in enumerate(words)
    )


def rna_of(name: str) -> Any:
    return getattr(bpy.ops.fewview, name).get_rna_type()


def add_pictures(folder: Path, *names: str, size: tuple[int, int] = (4, 3)) -> Path:
    """Write picture files; the folder."""
    folder.mkdir(exist_ok=True)
    image = bpy.data.images.new("picture", *size)
    image.file_format = "PNG"
    for name in names:
        image.save(filepath=str(folder / name))
    bpy.data.images.remove(image)
    return folder


def names_in(settings: Any) -> list[str]:
    return [image.name for image in settings.images]


# Words.


@pytest.mark.skipif(bpy.app.version < (4, 5), reason="every path may begin with // before")
def test_every_path_may_be_relative_to_the_file() -> None:
    """Else Blender warns of //, and its file browser gives none that survives when a project is moved."""
    owners = [
        bpy.context.scene.fewview.bl_rna,
        bpy.context.scene.fewview.bl_rna.properties["images"].fixed_type,
    ]
    names = [name for name in dir(bpy.ops.fewview) if name not in {"check_backend", "install_backend"}]
    owners += [getattr(bpy.ops.fewview, name).get_rna_type() for name in names]
    paths = [
        (owner.identifier, prop.identifier, prop.is_path_supports_blend_relative)
        for owner in owners
        for prop in owner.properties
        if prop.type == "STRING" and prop.subtype in {"FILE_PATH", "DIR_PATH"}
    ]
    assert len(paths) > 15
    assert [path for path in paths if not path[2]] == []


def test_every_operator_is_in_the_table() -> None:
    assert set(dir(bpy.ops.fewview)) == set(OPERATORS)


@pytest.mark.parametrize("name", OPERATORS)
def test_its_words_are_as_blenders(name: str) -> None:
    rna = rna_of(name)
    assert rna.identifier == f"FEWVIEW_OT_{name}"
    assert getattr(bpy.types, rna.identifier).bl_idname in {f"fewview.{name}", rna.identifier}
    assert is_title(rna.name), rna.name
    tooltip = rna.description
    assert tooltip, "it has no tooltip"
    assert tooltip[0].isupper()
    assert tooltip[-1].isalnum() or tooltip[-1] in ")%", tooltip
    assert "\n" not in tooltip
    assert "  " not in tooltip


@pytest.mark.parametrize("name", OPERATORS)
def test_its_arguments_say_what_they_are(name: str) -> None:
    for argument in rna_of(name).properties:
        if argument.identifier == "rna_type" or argument.identifier in FILE_BROWSER:
            continue
        assert is_title(argument.name), f"{argument.identifier}: {argument.name}"
        described = bool(argument.description) or (
            argument.type == "ENUM" and all(item.description for item in argument.enum_items)
        )
        assert described, f"{argument.identifier} has no description"
        assert not argument.description.endswith("."), argument.description


@pytest.mark.parametrize("name", OPERATORS)
def test_it_can_be_undone_if_it_changes_data(name: str) -> None:
    cls = getattr(bpy.types, f"FEWVIEW_OT_{name}")
    assert ("UNDO" in getattr(cls, "bl_options", set())) == OPERATORS[name].undo


def test_settings_say_what_they_are(settings: Any) -> None:
    for group in (settings.bl_rna, settings.bl_rna.properties["images"].fixed_type):
        for made in group.properties:
            if made.identifier not in {"rna_type", "name"} and made.type != "COLLECTION":
                assert is_title(made.name), f"{made.identifier}: {made.name}"
                assert not made.description.endswith("."), made.description


# Greyed buttons.


def test_every_operator_with_a_poll_has_a_grey_state() -> None:
    with_poll = {
        name
        for name in OPERATORS
        if callable(getattr(getattr(bpy.types, f"FEWVIEW_OT_{name}"), "poll", None))
    }
    assert with_poll == {name for name, expected in OPERATORS.items() if expected.grey}


@pytest.mark.parametrize(("name", "into", "words"), GREY)
def test_a_greyed_button_says_why(situation: Situation, name: str, into: Set, words: str) -> None:
    into(situation)
    operator = getattr(bpy.ops.fewview, name)
    assert not operator.poll()
    with pytest.raises(RuntimeError) as refusal:
        operator()
    # Blender puts its own words in front, and only the reason is ours.
    reason = str(refusal.value).partition("poll()")[2].strip()
    assert words in reason
    assert reason[0].isupper() or reason[0] == "/"
    assert not reason.endswith(".")


def test_a_linked_scene_that_was_made_local_is_as_any_other(situation: Situation) -> None:
    situation.linked_scene()
    api = situation.part("api")
    with pytest.raises(situation.part("jobs").JobError, match="is linked from"):
        api.reconstruct([situation.folder], output=situation.folder)
    bpy.context.scene.make_local()
    assert bpy.ops.fewview.add_region() == {"FINISHED"}
    bpy.context.view_layer.objects.active = bpy.context.scene.fewview.result
    assert bpy.ops.fewview.generate_views(view_count=2) == {"FINISHED"}


# The list of photographs.


def test_chosen_files_come_in_the_order_that_was_given(settings: Any, tmp_path: Path) -> None:
    folder = add_pictures(tmp_path, "b.png", "a.png", "c.png")
    files = [{"name": "c.png"}, {"name": "a.png"}]
    assert bpy.ops.fewview.add_images(directory=str(folder), files=files) == {"FINISHED"}
    assert names_in(settings) == ["c.png", "a.png"]
    assert [Path(image.path) for image in settings.images] == [folder / "c.png", folder / "a.png"]
    assert (settings.images[0].width, settings.images[0].height) == (4, 3)
    assert "Small" in settings.images[0].problem
    assert settings.active_image == 1
    assert settings.source == "FILES"


@pytest.mark.parametrize("argument", ["directory", "filepath"])
def test_a_folder_gives_its_images_by_name(settings: Any, tmp_path: Path, argument: str) -> None:
    names = [f"{letter}.png" for letter in "hcfbgdea"]
    add_pictures(tmp_path, *names)
    (tmp_path / "notes.txt").write_text("no picture")
    (tmp_path / "folder.png").mkdir()
    assert bpy.ops.fewview.add_images(**{argument: str(tmp_path)}) == {"FINISHED"}
    assert names_in(settings) == sorted(names)


def test_one_file(settings: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    add_pictures(tmp_path, "a.PNG", "b.png", "c.png")
    assert bpy.ops.fewview.add_images(filepath=str(tmp_path / "b.png")) == {"FINISHED"}
    assert "1 photograph added" in capfd.readouterr().out
    assert names_in(settings) == ["b.png"]
    # The file browser says both.
    assert bpy.ops.fewview.add_images(directory=str(tmp_path), filepath=str(tmp_path / "a.PNG"))
    assert names_in(settings) == ["b.png", "a.PNG"]


def test_the_same_again_changes_nothing(settings: Any, tmp_path: Path) -> None:
    add_pictures(tmp_path, "a.png", "b.png")
    bpy.ops.fewview.add_images(filepath=str(tmp_path / "b.png"))
    settings.images[0].use = False
    bpy.ops.fewview.add_images(directory=str(tmp_path))
    bpy.ops.fewview.add_images(directory=str(tmp_path))
    assert names_in(settings) == ["b.png", "a.png"]
    assert not settings.images[0].use


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({}, "no images"),
        ({"directory": "{}"}, "no images"),
        ({"directory": "{}", "files": [{"name": "notes.txt"}]}, "no images"),
        ({"directory": "{}/nowhere"}, "nowhere is not there"),
        ({"filepath": "{}/nowhere.png"}, "nowhere.png is not there"),
        ({"directory": "{}", "files": [{"name": "nowhere.png"}]}, "nowhere.png is not there"),
    ],
)
def test_what_cannot_be_added_is_said(
    settings: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: dict[str, Any],
    words: str,
) -> None:
    elsewhere = add_pictures(tmp_path / "elsewhere", "a.png")
    monkeypatch.chdir(elsewhere)  # the folder that Blender was started in is not meant
    given = tmp_path / "given"
    given.mkdir()
    (given / "notes.txt").write_text("no picture")
    filled = {
        key: value.format(given) if isinstance(value, str) else value for key, value in arguments.items()
    }
    with pytest.raises(RuntimeError, match=words):
        bpy.ops.fewview.add_images(**filled)
    assert not settings.images


def test_a_full_list_says_so(
    settings: Any, situation: Situation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = situation.part("operators.images")
    monkeypatch.setattr(images, "MOST_IMAGES", 2)
    add_pictures(tmp_path, "a.png", "b.png", "c.png")
    said: list[tuple[set[str], str]] = []
    operator = SimpleNamespace(
        directory=str(tmp_path),
        filepath="",
        files=(),
        report=lambda kind, text: said.append((kind, text)),
    )
    operator._paths = lambda: images.FEWVIEW_OT_add_images._paths(operator)
    assert images.FEWVIEW_OT_add_images.execute(operator, bpy.context) == {"FINISHED"}
    assert names_in(settings) == ["a.png", "b.png"]
    assert any(kind == {"WARNING"} and "full" in text for kind, text in said)


def test_pictures_that_cannot_be_read_are_named(
    settings: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    add_pictures(tmp_path, "a.png", "b.png")
    (tmp_path / "camera.NEF").write_bytes(b"")
    assert bpy.ops.fewview.add_images(directory=str(tmp_path)) == {"FINISHED"}
    assert names_in(settings) == ["a.png", "b.png"]
    assert "camera.NEF" in capfd.readouterr().out
    (tmp_path / "a.png").unlink()
    (tmp_path / "b.png").unlink()
    with pytest.raises(RuntimeError, match=r"camera\.NEF"):
        bpy.ops.fewview.add_images(directory=str(tmp_path))


def test_photographs_are_removed_one_by_one_and_all(settings: Any, tmp_path: Path) -> None:
    add_pictures(tmp_path, "a.png", "b.png", "c.png")
    bpy.ops.fewview.add_images(directory=str(tmp_path))
    settings.active_image = 1
    bpy.ops.fewview.remove_image()
    assert names_in(settings) == ["a.png", "c.png"]
    assert settings.active_image == 1
    bpy.ops.fewview.remove_image()
    assert settings.active_image == 0
    settings.active_image = 77  # a script's
    bpy.ops.fewview.remove_image()
    assert not settings.images
    assert settings.active_image == 0
    bpy.ops.fewview.add_images(directory=str(tmp_path))
    bpy.ops.fewview.clear_images()
    assert not settings.images
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "b.png", "c.png"]


@pytest.mark.parametrize(
    ("area", "region", "taken"),
    [
        ("VIEW_3D", {"type": "UI", "active_panel_category": "FewView"}, True),
        ("VIEW_3D", {"type": "UI", "active_panel_category": "Item"}, False),
        ("VIEW_3D", {"type": "WINDOW"}, False),
        ("IMAGE_EDITOR", {"type": "UI", "active_panel_category": "FewView"}, False),
        (None, None, False),
    ],
)
def test_pictures_are_dropped_on_our_tab_alone(
    area: str | None, region: dict[str, str] | None, taken: bool
) -> None:
    context = SimpleNamespace(
        area=None if area is None else SimpleNamespace(type=area),
        region=None if region is None else SimpleNamespace(**region),
    )
    handler = bpy.types.FEWVIEW_FH_images
    assert handler.poll_drop(context) == taken
    assert handler.bl_import_operator == "fewview.add_images"
    operators_module = importlib.import_module(handler.__module__)
    assert set(handler.bl_file_extensions.split(";")) == set(operators_module.SUFFIXES)


def test_the_log_is_no_text_of_the_users(situation: Situation, tmp_path: Path) -> None:
    mine = bpy.data.texts.new("FewView Log")
    mine.from_string("mine")
    situation.patch.setattr(situation.part("jobs"), "log_path", lambda: tmp_path / "result" / "log")
    if bpy.app.background:
        for _ in range(2):
            assert bpy.ops.fewview.show_log() == {"FINISHED"}
        assert mine.as_string() == "mine"
        assert len(bpy.data.texts) == 2
