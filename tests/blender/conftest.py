"""The add-on as its users have it: built into a zip, installed and enabled, in a Blender of its own."""

import importlib
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import pytest

sys.path.insert(0, str(Path(__file__).parent))  # for build_extension
EXTENSION = "bl_ext.user_default.fewview"

# The tests must neither see nor change the settings of the person who runs them. Blender reads this when it
# starts: as a module that is later, as a program it has happened already.
if "bpy" not in sys.modules:
    _resources = tempfile.TemporaryDirectory(prefix="fewview-blender-")
    os.environ["BLENDER_USER_RESOURCES"] = _resources.name
elif "BLENDER_USER_RESOURCES" not in os.environ:
    pytest.exit("set BLENDER_USER_RESOURCES to an empty folder, as `make test-blender` does", returncode=2)


@pytest.fixture(scope="session")
def extension_zip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The extension, built by Blender's own tool."""
    pytest.importorskip("bpy", reason="needs Blender's Python, where `import bpy` works")
    from build_extension import build_extension

    return build_extension(tmp_path_factory.mktemp("zip"))


@pytest.fixture(scope="session")
def extension(extension_zip: Path) -> Iterator[str]:
    """The package name of the installed and enabled extension."""
    import addon_utils
    import bpy

    bpy.ops.extensions.package_install_files(
        filepath=str(extension_zip), repo="user_default", enable_on_install=True, overwrite=True
    )
    assert EXTENSION in bpy.context.preferences.addons
    yield EXTENSION
    addon_utils.disable(EXTENSION)  # Blender 4.2 dies at exit where a class of ours is left


@pytest.fixture
def scene(extension: str) -> object:
    """An empty scene with the add-on's settings."""
    import addon_utils
    import bpy

    if extension not in bpy.context.preferences.addons:  # factory settings, read by another test
        addon_utils.enable(extension, default_set=True)

    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    return bpy.context.scene


@pytest.fixture
def addon(scene: object, extension: str) -> ModuleType:
    """The installed add-on's package `addon`, in an empty scene."""
    return importlib.import_module(f"{extension}.addon")


@pytest.fixture
def part(addon: ModuleType) -> Iterator[Callable[[str], ModuleType]]:
    """The installed add-on's modules by name; no job runs before the test or after it."""

    def module(name: str) -> ModuleType:
        return importlib.import_module(f"{addon.__name__}.{name}")

    jobs = module("jobs")
    jobs.stop()
    jobs.forget()
    yield module
    jobs.stop()
    jobs.forget()
