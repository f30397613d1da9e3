"""What is simulated in a scene, and what a copy of the file needs to have it too.

A file that is saved holds the point caches of its own objects that are in memory. A cache on disk belongs to
the name of the file, and what linked and overridden objects, simulation zones, and rigid bodies that are not
baked do is in Blender's memory alone: a copy has it when it has played the frames.
"""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import bpy

from .kept_settings import Change


def is_in_file_alone(scene: bpy.types.Scene, last_frame: int) -> bool:
    """Whether the context's scene must be saved to have what was simulated or baked before this frame."""
    begun = any(first < last_frame and is_in_file for first, is_in_file in _simulations(scene))
    return begun or bool(bake_folders(scene))


def frames_to_play(scene: bpy.types.Scene, last_frame: int) -> range:
    """The frames, in order, of what the file of the context's scene does not hold; none if it holds all."""
    firsts = (first for first, is_in_file in _simulations(scene) if first < last_frame and not is_in_file)
    return range(min(firsts, default=last_frame + 1), last_frame + 1)


def bake_folders(scene: bpy.types.Scene) -> list[Change]:
    """The folders of what Geometry Nodes of local objects have baked to a disk, as absolute paths.

    `bpy.data.libraries.write` leaves them out; Blender before 5.0 saves them as they are, wherever that is.
    """
    owners: list[tuple[Any, str]] = []
    for modifier in (modifier for made in _objects(scene) if not made.library for modifier in made.modifiers):
        if modifier.type == "NODES":
            owners += [(modifier, "bake_directory"), *((bake, "directory") for bake in modifier.bakes)]
    return [(owner, name, bpy.path.abspath(path)) for owner, name in owners if (path := getattr(owner, name))]


def leave_disk(scene: bpy.types.Scene) -> None:
    """Have the caches on disk of the context's scene in memory, without a frame: their files are missing."""
    for owner, cache in _point_caches(scene):
        if owner.library is None and cache.use_disk_cache:
            cache.use_disk_cache = False
            if cache.is_baked:
                with bpy.context.temp_override(point_cache=cache):
                    bpy.ops.ptcache.free_bake()
    file = Path(bpy.data.filepath)
    with suppress(OSError):  # where Blender has looked for frames; there are none
        file.with_name(f"blendcache_{file.stem}").rmdir()


def _simulations(scene: bpy.types.Scene) -> Iterator[tuple[int, bool]]:
    """First frame of each, and whether a file that is saved holds it.

    Without those of linked objects whose own file, or a cache beside it, has them. Whether a zone is baked
    cannot be asked for; then its frames are read when they are played.
    """
    for owner, cache in _point_caches(scene):
        if owner.library is None or not (cache.is_baked or cache.use_disk_cache):
            is_own = owner.library is None and owner.override_library is None
            is_kept = cache.is_baked if owner == scene else is_own
            yield cache.frame_start, is_kept and not cache.use_disk_cache
    for modifier in (modifier for made in _objects(scene) for modifier in made.modifiers):
        for bake in modifier.bakes if modifier.type == "NODES" else ():
            if bake.node is not None and bake.node.type == "SIMULATION_OUTPUT":
                yield bake.frame_start if bake.use_custom_simulation_frame_range else scene.frame_start, False


def _point_caches(scene: bpy.types.Scene) -> Iterator[tuple[bpy.types.ID, bpy.types.PointCache]]:
    """With the object each belongs to, or the scene."""
    if scene.rigidbody_world is not None and scene.rigidbody_world.point_cache is not None:
        yield scene, scene.rigidbody_world.point_cache
    for made in _objects(scene):
        for modifier in made.modifiers:
            if hasattr(modifier, "point_cache"):  # cloth and soft bodies
                yield made, modifier.point_cache
            canvas = getattr(modifier, "canvas_settings", None)
            for surface in () if canvas is None else canvas.canvas_surfaces:
                yield made, surface.point_cache
        for system in made.particle_systems:
            if system.settings.type != "HAIR" or system.use_hair_dynamics:
                yield made, system.point_cache


def _objects(scene: bpy.types.Scene) -> set[bpy.types.Object]:
    """The scene's, and all that they are computed from: what collections and nodes show need not be in it."""
    used = (block.original for block in bpy.context.evaluated_depsgraph_get().ids)
    return {*scene.objects, *(block for block in used if isinstance(block, bpy.types.Object))}
