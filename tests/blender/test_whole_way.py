"""From a scene written as text over rendered views to the mesh on top of the original, as users start it."""

import json
import os
from pathlib import Path

import pytest

bpy = pytest.importorskip("bpy", reason="needs Blender's Python, where `import bpy` works")

pytestmark = [
    pytest.mark.blender,
    pytest.mark.slow,
    pytest.mark.skipif(
        "FEWVIEW_PYTHON" not in os.environ, reason="FEWVIEW_PYTHON names no Python with the backend"
    ),
]


def test_the_mesh_lies_on_the_original(
    extension: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from blender_scenes.reconstruct_scene import main

    words = "--scene monkey --views 6 --layout arc --samples 16 --preset fast"
    saved = tmp_path / "scene.blend"
    assert main([*words.split(), "--output", str(tmp_path), "--save", str(saved)]) == 0
    summary = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert summary["median_percent"] < 0.5
    assert summary["triangles"] > 10_000
    assert saved.is_file()
    result = bpy.context.scene.fewview.result
    assert result.name == summary["mesh"]
    assert "support" in result.data.attributes
    assert len([made for made in bpy.context.scene.objects if made.type == "CAMERA"]) >= 6
