"""The extension arrives, leaves and arrives again without a trace."""

from types import ModuleType

import pytest

bpy = pytest.importorskip("bpy", reason="needs Blender's Python, where `import bpy` works")

pytestmark = pytest.mark.blender


def test_it_comes_and_goes(addon: ModuleType) -> None:
    assert hasattr(bpy.types.Scene, "fewview")
    assert bpy.context.scene.fewview.preset == "balanced"
    for _ in range(2):
        addon.unregister()
        assert not hasattr(bpy.types.Scene, "fewview")
        addon.register()
        assert hasattr(bpy.types.Scene, "fewview")
