"""The Python that reconstructs: how it is found, checked, made and removed, and what the extension brings."""

import importlib
import os
import shlex
import shutil
import subprocess
import sys
import tomllib
import zipfile
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import fake_layout
import pytest

from tests.stand_in_packages import write_uv, write_wheels

bpy = pytest.importorskip("bpy", reason="needs Blender's Python, where `import bpy` works")

pytestmark = pytest.mark.blender

ROOT = Path(__file__).resolve().parents[2]
BACKEND = ROOT / ".venv" / "bin" / "python"
posix_only = pytest.mark.skipif(sys.platform == "win32", reason="paths of POSIX")
needs_backend = pytest.mark.skipif(not BACKEND.exists(), reason=f"{BACKEND} is not here")


def can_make_one() -> bool:
    """Whether there is a Python that makes virtual environments: Debian's own does not."""
    names = [sys.executable, *(f"python3.{minor}" for minor in (13, 12, 11))]
    found = [path for name in names if (path := shutil.which(name))]
    test = "import venv, ensurepip"
    return any(subprocess.run([path, "-c", test], capture_output=True).returncode == 0 for path in found)


@pytest.fixture
def environment(addon: ModuleType) -> Any:
    return importlib.import_module(f"{addon.__name__}.environment")


@pytest.fixture
def operators(addon: ModuleType) -> Any:
    return importlib.import_module(f"{addon.__name__}.operators.environment")


@pytest.fixture
def preferences(addon: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The add-on's, with a folder of the test's own for the managed environment."""
    monkeypatch.delenv("FEWVIEW_PYTHON", raising=False)
    module = importlib.import_module(f"{addon.__name__}.preferences")
    chosen = module.preferences_of(bpy.context)
    chosen.environment_folder, chosen.backend_python = str(tmp_path / "managed"), ""
    yield chosen
    chosen.property_unset("environment_folder")
    chosen.property_unset("backend_python")


@pytest.fixture
def online() -> Any:
    system = bpy.context.preferences.system
    before = system.use_online_access
    system.use_online_access = True
    if not bpy.app.online_access:
        pytest.skip("Blender was started with --offline-mode")
    yield
    system.use_online_access = before


def touch(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    return path


def bare_environment(folder: Path) -> Path:
    """A Python without any package."""
    command = [sys.executable, "-m", "venv", "--without-pip", str(folder)]
    subprocess.run(command, check=True, capture_output=True, timeout=60)
    return folder / "bin" / "python"


# Which Python.


@posix_only
def test_the_variable_comes_before_the_preference_and_that_before_the_managed_one(
    environment: Any, tmp_path: Path
) -> None:
    first, second = touch(tmp_path / "first"), touch(tmp_path / "second")
    third = touch(tmp_path / "managed" / "bin" / "python")
    managed = tmp_path / "managed"

    def found(variable: str, preference: str) -> Path:
        return environment.find_python(variable=variable, preference=preference, managed=managed).path

    assert found(str(first), str(second)) == first
    assert found("", str(second)) == second
    assert found(" ", "") == third
    third.unlink()
    assert environment.find_python(variable="", preference="", managed=managed) is None


def test_a_choice_that_is_not_there_is_said_and_not_passed_over(environment: Any, tmp_path: Path) -> None:
    touch(tmp_path / "managed" / "bin" / "python")
    for variable, preference, words in (
        ("/no/python", "", "FEWVIEW_PYTHON"),
        ("", "/no/python", "preferences"),
    ):
        with pytest.raises(environment.PythonMissing, match=words) as caught:
            environment.find_python(variable=variable, preference=preference, managed=tmp_path / "managed")
        assert "/no/python" in str(caught.value)


@posix_only
def test_a_link_stays_a_link_and_a_folder_means_its_python(environment: Any, tmp_path: Path) -> None:
    """A virtual environment is known by the path of the link that starts it."""
    link = tmp_path / "venv" / "bin" / "python"
    link.parent.mkdir(parents=True)
    link.symlink_to(sys.executable)
    for text in (str(link), str(tmp_path / "venv")):
        assert environment.find_python(variable=text, preference="", managed=tmp_path).path == link


@posix_only
def test_an_environment_whose_python_was_removed_is_said(environment: Any, tmp_path: Path) -> None:
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "python").symlink_to(tmp_path / "gone")
    touch(tmp_path / ".fewview-environment")
    with pytest.raises(environment.PythonMissing, match="press Set Up FewView again"):
        environment.find_python(variable="", preference="", managed=tmp_path)


@pytest.mark.parametrize(
    ("windows", "variables", "expected"),
    [
        (True, {"LOCALAPPDATA": "/local"}, Path("/local/fewview")),
        (True, {}, None),
        (False, {"LOCALAPPDATA": "/local"}, None),
    ],
)
def test_on_windows_the_managed_one_has_a_short_path(
    environment: Any, windows: bool, variables: dict[str, str], expected: Path | None
) -> None:
    assert environment.short_folder(variables, windows=windows) == expected


def test_the_managed_one_goes_where_it_is_chosen_else_short_else_to_blenders_folder(
    preferences: Any, operators: Any, environment: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(environment, "short_folder", lambda _: tmp_path / "short")
    assert operators.managed_folder(bpy.context) == tmp_path / "managed" / "environment"
    preferences.environment_folder = ""
    assert operators.managed_folder(bpy.context) == tmp_path / "short" / "environment"
    monkeypatch.undo()
    assert operators.managed_folder(bpy.context) == operators.user_folder() / "environment"


# By hand.


def test_the_lines_for_a_shell_are_words_again(environment: Any, tmp_path: Path) -> None:
    folder = tmp_path / "it's mine"
    first, second = environment.hand_lines(folder, windows=False).splitlines()
    assert shlex.split(first) == ["python3.12", "-m", "venv", str(folder)]
    words = shlex.split(second)
    assert words[:5] == [f"{folder}/bin/python", "-m", "pip", "install", "--constraint"]
    assert Path(words[5]).is_file()
    assert any(word.startswith("torch>=") for word in words[6:])


def test_the_lines_for_cmd_quote_what_it_would_take_for_its_own(environment: Any) -> None:
    first, second = environment.hand_lines(Path("C:/a b"), windows=True).splitlines()
    assert first.endswith('"C:/a b"')
    assert '"torch>=2.6"' in second
    assert second.count('"') % 2 == 0


def test_sizes_are_told(environment: Any) -> None:
    for build in ("cpu", "default", "cuda"):
        assert "GB to download" in environment.size_text(build)
    assert environment.size_text("cpu") != environment.size_text("cuda")


# What is known of it.


def checked(environment: Any, name: str, found: str, *, fine: bool = True) -> Any:
    return environment.Checked(name=name, fine=fine, found=found)


def test_readiness_is_of_one_python_as_it_was(environment: Any, tmp_path: Path) -> None:
    python = touch(tmp_path / "bin" / "python")
    touch(tmp_path / "pyvenv.cfg")
    assert environment.readiness(python).state is environment.State.UNKNOWN
    checks = [checked(environment, "torch", "2.13.0"), checked(environment, "cpu", "2 cores")]
    environment.remember(python, checks, finished=True)
    known = environment.readiness(python)
    assert (known.state, known.text) == (environment.State.READY, "torch 2.13.0, CPU 2 cores")
    cuda = checked(environment, "cuda", "NVIDIA H200")
    environment.remember(python, [checks[0], cuda, checks[1]], finished=True)
    assert environment.readiness(python).text == "torch 2.13.0, CUDA NVIDIA H200"
    assert environment.readiness(touch(tmp_path / "other")).state is environment.State.UNKNOWN
    os.utime(tmp_path / "pyvenv.cfg", ns=(1, 1))  # made anew
    assert environment.readiness(python).state is environment.State.UNKNOWN


def test_a_gpu_that_fails_is_told_beside_ready(environment: Any, tmp_path: Path) -> None:
    """The check says ready; the CPU is what it computes on."""
    checks = [
        checked(environment, "torch", "2.13.0"),
        checked(environment, "cuda", "GTX 1080: no code for it", fine=False),
        checked(environment, "cpu", "2 cores"),
    ]
    python = touch(tmp_path / "python")
    environment.remember(python, checks, finished=True)
    known = environment.readiness(python)
    assert known.state is environment.State.READY
    assert known.text == "torch 2.13.0, CPU 2 cores; CUDA fails: GTX 1080: no code for it"


def test_what_is_missing_is_named(environment: Any, tmp_path: Path) -> None:
    python = touch(tmp_path / "python")
    faults = [checked(environment, name, "gone", fine=False) for name in "abcde"]
    for count, text in ((1, "a: gone"), (3, "Missing: a, b, c"), (5, "Missing: a, b, c and 2 more")):
        environment.remember(python, faults[:count], finished=False)
        assert environment.readiness(python).text == text
        assert environment.readiness(python).state is environment.State.NOT_READY
    environment.remember(python, [], finished=False)
    assert "Show Log" in environment.readiness(python).text


# The operators.


def test_without_a_backend_operators_say_what_to_do(preferences: Any, operators: Any) -> None:
    python, reason = operators.backend_python_or_reason(bpy.context)
    assert python is None
    assert "Set Up FewView" in reason
    with pytest.raises(RuntimeError, match="FewView is not set up"):
        bpy.ops.fewview.check_backend()
    preferences.backend_python = "/no/python"
    python, reason = operators.backend_python_or_reason(bpy.context)
    assert python is None
    assert "/no/python" in reason
    with pytest.raises(RuntimeError, match="/no/python"):
        bpy.ops.fewview.check_backend()


@posix_only
def test_a_python_without_packages_is_not_ready(preferences: Any, operators: Any, tmp_path: Path) -> None:
    python = bare_environment(tmp_path / "bare")
    preferences.backend_python = str(python)
    assert operators.backend_python_or_reason(bpy.context) == (python, ""), "not checked yet, so taken"
    with pytest.raises(RuntimeError, match="cannot reconstruct: numpy"):
        bpy.ops.fewview.check_backend()
    found, reason = operators.backend_python_or_reason(bpy.context)
    assert found is None
    assert "Missing: numpy, pillow, pillow-heif and 14 more" in reason
    state, text = operators.backend_state(bpy.context)
    assert state.value == "not ready"
    assert "numpy" in text


@needs_backend
def test_the_backends_python_is_ready(preferences: Any, operators: Any, environment: Any) -> None:
    assert bpy.ops.fewview.check_backend(python=str(BACKEND)) == {"FINISHED"}
    known = environment.readiness(BACKEND)
    assert known.state is environment.State.READY
    assert known.text.startswith("torch 2")
    preferences.backend_python = str(BACKEND)
    assert operators.backend_python_or_reason(bpy.context) == (BACKEND, "")


def test_nothing_is_downloaded_unless_that_is_allowed(preferences: Any) -> None:
    if bpy.app.online_access:
        pytest.skip("Blender was started with --online-mode")
    with pytest.raises(RuntimeError, match="Allow Online Access"):
        bpy.ops.fewview.install_backend()


def test_there_is_nothing_to_remove(preferences: Any, operators: Any) -> None:
    with pytest.raises(RuntimeError, match="no environment that the add-on made"):
        bpy.ops.fewview.remove_backend()
    theirs = touch(operators.managed_folder(bpy.context) / "bin" / "python")
    with pytest.raises(RuntimeError, match="no environment that the add-on made"):
        bpy.ops.fewview.remove_backend()
    assert theirs.exists()


@pytest.mark.skipif(not can_make_one(), reason="no Python here has venv and ensurepip")
def test_one_is_made_used_and_removed(
    preferences: Any, operators: Any, environment: Any, online: None, tmp_path: Path, monkeypatch: Any
) -> None:
    """With small wheels in place of the packages; all else is as for a user."""
    dependencies = importlib.import_module(
        environment.__name__.replace("addon.environment", "backend.doctor")
    )
    write_wheels(tmp_path / "wheels", dependencies.DEPENDENCIES)
    write_uv(tmp_path / "wheels")
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path / "wheels"))
    code = Path(environment.__file__).parents[1]
    before = files_in(code)

    # whatever the disk: the default build may ask for 11 GB of room, which small wheels do not take
    assert bpy.ops.fewview.install_backend(build="cpu") == {"FINISHED"}
    folder = tmp_path / "managed" / "environment"
    python, reason = operators.backend_python_or_reason(bpy.context)
    assert (python, reason) == (environment.python_in(folder), "")
    state, text = operators.backend_state(bpy.context)
    assert (state, text.split(",")[0]) == (environment.State.READY, "torch " + version_of(folder, "torch"))

    assert bpy.ops.fewview.remove_backend() == {"FINISHED"}
    assert not folder.exists()
    assert operators.backend_python_or_reason(bpy.context)[0] is None
    assert files_in(code) == before, "the extension's folder was written to"
    assert not list((code / "backend" / "commands").glob("__pycache__/*")), "by another Python"


def version_of(folder: Path, package: str) -> str:
    (info,) = folder.glob(f"lib/python*/site-packages/{package}-*.dist-info")
    return info.name.removeprefix(f"{package}-").removesuffix(".dist-info")


def files_in(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if "__pycache__" not in path.parts}


def test_an_installation_that_fails_leaves_nothing_that_could_be_taken_for_one(
    preferences: Any, operators: Any, online: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    touch(tmp_path / "elsewhere" / "environment" / "thesis.txt")
    with pytest.raises(RuntimeError, match="was not made by FewView"):
        bpy.ops.fewview.install_backend(folder=str(tmp_path / "elsewhere" / "environment"))
    assert operators.backend_python_or_reason(bpy.context)[0] is None


def test_the_lines_are_copied(
    preferences: Any, environment: Any, tmp_path: Path, monkeypatch: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    assert bpy.ops.fewview.copy_install_lines() == {"FINISHED"}
    said = capfd.readouterr().out
    folder = tmp_path / "fewview-environment"
    lines = environment.hand_lines(folder)
    assert "Python 3.12" in said
    assert f"Run them in {environment.shell_name()}, where" in said
    assert environment.shell_name(windows=True) == "the Command Prompt (cmd)"  # as hand_lines quotes
    assert "3.12" in lines.split()[0 if sys.platform != "win32" else 1]
    assert str(environment.python_in(folder)) in said
    assert lines.splitlines()[1].startswith(shlex.quote(str(environment.python_in(folder))))


@pytest.mark.parametrize("made", [False, True])
def test_setting_up_again_offers_to_make_anew(
    preferences: Any, operators: Any, environment: Any, monkeypatch: Any, made: bool
) -> None:
    """It is ready: without that tick it would stay as it is."""
    folder = operators.managed_folder(bpy.context)
    if made:
        touch(environment.python_in(folder))
        touch(folder / ".fewview-environment")
        check = importlib.import_module(
            environment.__name__.replace("addon.environment", "backend.wire.protocol")
        ).Checked(name="torch", fine=True, found="2.13.0")
        environment.remember(environment.python_in(folder), [check], finished=True)
        assert operators.backend_state(bpy.context)[0] is environment.State.READY
    cls = operators.FEWVIEW_OT_install_backend
    layout = fake_layout.FakeLayout()
    drawn = SimpleNamespace(layout=layout, build="cpu", folder="", bl_rna=rna_of(cls))
    drawn._build, drawn._folder = partial(cls._build, drawn), partial(cls._folder, drawn)
    cls.draw(drawn, bpy.context)
    assert layout.props() == ({"build", "again"} if made else {"build"})
    assert bpy.ops.fewview.remove_backend.poll() == made


def rna_of(cls: Any) -> Any:
    return fake_layout.operator_type(cls.bl_idname)


def test_removing_has_a_title_that_can_be_done(
    preferences: Any, operators: Any, environment: Any, monkeypatch: Any
) -> None:
    """The sidebar says "... is done"."""
    touch(operators.managed_folder(bpy.context) / ".fewview-environment")
    titles: list[str] = []
    monkeypatch.setattr(operators.jobs, "start", lambda title, *_, **__: titles.append(title))
    monkeypatch.setattr(operators.jobs, "follow", lambda _: {"FINISHED"})
    assert bpy.ops.fewview.remove_backend() == {"FINISHED"}
    assert titles == ["Removing the setup"]


def test_the_words_of_the_preferences_have_no_jargon(preferences: Any, operators: Any) -> None:
    properties = preferences.bl_rna.properties
    page = [properties[name].description for name in ("backend_python", "environment_folder")]
    assert not [text for text in page if "managed" in text or "pycolmap" in text]
    assert all("Set Up FewView" in text for text in page)
    asked = fake_layout.operator_type("fewview.install_backend").properties["build"].enum_items
    chosen = properties["torch_build"].enum_items
    assert chosen.keys() == ["cpu", "default", "cuda"]  # saved in users' preferences
    for items in (asked, chosen):
        assert "every computer" not in items["cpu"].description
        assert (items["default"].name, "index" in items["default"].description) == ("Standard", False)


def test_tooltips_are_as_blender_has_them(operators: Any) -> None:
    for cls in operators.CLASSES:
        tip = cls.__doc__
        assert tip[0].isupper()
        assert not tip.endswith(".")
        assert "UNDO" not in getattr(cls, "bl_options", set())


# What the extension brings.


def test_the_zip_holds_what_is_needed_and_nothing_else(extension_zip: Path) -> None:
    with zipfile.ZipFile(extension_zip) as file:
        names = [name for name in file.namelist() if not name.endswith("/")]
    assert {name.split("/")[0] for name in names} == {
        "addon",
        "backend",
        "blender_manifest.toml",
        "__init__.py",
        "pyproject.toml",
        "constraints.txt",
        "LICENSE",
        "README.md",
        "CHANGELOG.md",
    }
    assert {"backend/wire/client.py", "addon/operators/environment.py"} <= set(names)
    assert not [name for name in names if "__pycache__" in name or name.endswith((".pyc", ".blend"))]


def test_it_is_offered_to_the_computers_that_it_can_be_set_up_on() -> None:
    """As Blender names them; backend/commands/computers.py refuses the others."""
    with (ROOT / "blender_manifest.toml").open("rb") as file:
        assert tomllib.load(file)["platforms"] == ["windows-x64", "macos-arm64", "linux-x64"]


def test_permissions_say_what_for_in_a_line_that_blender_takes() -> None:
    """Blender's `extension validate` asks for at most 64 characters without punctuation at their end."""
    with (ROOT / "blender_manifest.toml").open("rb") as file:
        permissions = tomllib.load(file)["permissions"]
    assert set(permissions) == {"files", "network", "clipboard"}
    for why in permissions.values():
        assert 0 < len(why) <= 64
        assert why[-1].isalnum()
    assert "backend" not in " ".join(permissions.values())
    assert "report" in permissions["clipboard"]  # Copy Report


def test_blender_has_no_complaints_about_the_extension(addon: ModuleType) -> None:
    import addon_utils

    if not hasattr(addon_utils, "_extensions_warnings_get"):
        pytest.skip("this Blender does not look for such things")
    assert not addon_utils._extensions_warnings_get()
