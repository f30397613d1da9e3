"""The whole way in one command: a scene from text, its views, and the mesh made from them on top of it.

    blender --background --python blender_scenes/reconstruct_scene.py -- --scene monkey --output DIR

The FewView extension must be installed. Prints one JSON object with the distances of the mesh from the
original, in percent of the original's diagonal; with `--save FILE.blend` the scene is kept.
"""

import argparse
import json
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import addon_utils
import bpy
import numpy as np

if not __package__:  # started by `blender --python`, which knows the file and not the package
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from addon.true_mesh import bounding_sphere, true_mesh
from blender_scenes.lighting import light_scene
from blender_scenes.render_views import own_words
from blender_scenes.scenes import SCENES, build_scene
from blender_scenes.truth import ray_caster

log = logging.getLogger(__name__)


class NotInstalled(RuntimeError):  # noqa: N818 - it says what is the matter
    """The extension is not there."""


def reconstruct_scene(asked: argparse.Namespace) -> dict[str, Any]:
    """Build, render, reconstruct and import; what the mesh is like. The open scene is replaced.

    Raises NotInstalled, and RuntimeError where an operator gives up.
    """
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    enable_extension()
    target = _lit_subject(asked.scene, asked.seed)
    output = str(asked.output.absolute())
    shape = {"resolution_x": asked.width, "resolution_y": asked.height}
    bpy.ops.fewview.generate_views(
        target=target.name,
        arrangement=asked.layout,
        view_count=asked.views,
        arc=np.deg2rad(asked.arc_deg),
        view_seed=asked.seed,
        **shape,
    )
    bpy.ops.fewview.render_views(target=target.name, samples=asked.samples, output=output, **shape)
    bpy.ops.fewview.reconstruct(preset=asked.preset, seed=asked.seed, output=output)
    result = bpy.context.scene.fewview.result
    if asked.save is not None:
        bpy.ops.wm.save_as_mainfile(filepath=str(asked.save.absolute()))
    return {"mesh": result.name, "triangles": len(result.data.polygons), **distances(result, target)}


def enable_extension() -> None:
    """Switch the installed extension on, whatever repository it is in. Raises NotInstalled."""
    if hasattr(bpy.types.Scene, "fewview"):
        return
    for module in addon_utils.modules(refresh=True):
        if module.__name__.startswith("bl_ext.") and module.__name__.endswith(".fewview"):
            bpy.ops.preferences.addon_enable(module=module.__name__)
            return
    raise NotInstalled("the FewView extension is not installed: install its zip in Blender first")


def distances(result: Any, original: Any) -> dict[str, float]:
    """How far the mesh's vertices are from the original's surface, in percent of the original's diagonal."""
    truth = true_mesh((original, *(child for child in original.children_recursive if child.type == "MESH")))
    diagonal = float(np.linalg.norm(np.ptp(truth.vertices, axis=0)))
    tree = ray_caster(truth)
    world = result.matrix_world
    found = [tree.find_nearest(world @ vertex.co)[3] for vertex in result.data.vertices]
    percent = 100 * np.array(found) / diagonal
    return {
        "median_percent": float(np.median(percent)),
        "mean_percent": float(percent.mean()),
        "p90_percent": float(np.quantile(percent, 0.9)),
    }


def _lit_subject(name: str, seed: int) -> Any:
    """The scene's first subject, the others its children, in the light of all scenes."""
    built = build_scene(SCENES[name](name, seed))
    first, *others = built.subjects
    for other in others:
        other.parent = first
        other.matrix_parent_inverse = first.matrix_world.inverted()
    centre, radius = bounding_sphere(true_mesh(built.subjects))
    light_scene(centre=centre, radius=radius)
    return first


def main(words: Sequence[str]) -> int:
    """Exit code 0, or 2 with a sentence on stderr."""
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    parser = argparse.ArgumentParser(prog="reconstruct_scene", description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--scene", choices=tuple(SCENES), default="monkey")
    add("--views", type=int, default=6)
    add("--layout", type=str.upper, choices=("ARC", "RING", "HEMISPHERE"), default="RING")
    add("--arc-deg", type=float, default=120.0)
    add("--width", type=int, default=800)
    add("--height", type=int, default=600)
    add("--samples", type=int, default=32)
    add("--preset", choices=("fast", "balanced", "detailed", "nerf"), default="balanced")
    add("--seed", type=int, default=0)
    add("--output", type=Path, required=True, help="folder in which views and job get their own")
    add("--save", type=Path, metavar="FILE.blend")
    try:
        summary = reconstruct_scene(parser.parse_args(words))
    except (NotInstalled, RuntimeError, ValueError, OSError) as error:
        sys.stderr.write(f"Error: {error}\n")
        return 2
    sys.stdout.write(json.dumps(summary) + "\n")
    sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main(own_words(sys.argv)))
