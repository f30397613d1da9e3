"""What is simulated in a scene, and where its frames are: what a copy of the file has of them, and what not.

A file that is saved holds the point caches of its own objects. What rigid bodies, linked and overridden
objects and simulation zones do is in Blender's memory alone unless it is baked: a copy has it when it has
played the frames. A cache on disk belongs to the name of the file.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum, auto
from typing import Any

import bpy

from .kept_settings import Change


class Kept(Enum):
    """Where the frames of a simulation are."""

    IN_FILE = auto()
    ON_DISK = auto()
    IN_MEMORY = auto()


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """Something whose frames follow from those before."""

    name: str
    """Of the object, or the scene."""
    kept: Kept
    first_frame: int


def simulations(scene: bpy.types.Scene, last_frame: int) -> list[Simulation]:
    """Those of the context's scene that have begun before this frame, also in what is only instanced.

    Without those of linked objects whose own file, or a cache beside it, has them.
    """
    found = [*_of_rigid_bodies(scene)]
    for made in _objects(scene):
        found += [*_of_point_caches(made), *_of_zones(scene, made)]
    return [simulation for simulation in found if simulation.first_frame < last_frame]


def bake_folders(scene: bpy.types.Scene) -> list[Change]:
    """The folders of what Geometry Nodes of local objects have baked to a disk, as absolute paths.

    `bpy.data.libraries.write` leaves them out; Blender before 5.0 saves them as they are, wherever that is.
    """
    owners: list[tuple[Any, str]] = []
    for modifier in (modifier for made in _objects(scene) if not made.library for modifier in made.modifiers):
        if modifier.type == "NODES":
            owners += [(modifier, "bake_directory"), *((bake, "directory") for bake in modifier.bakes)]
    return [(owner, name, bpy.path.abspath(path)) for owner, name in owners if (path := getattr(owner, name))]


def _objects(scene: bpy.types.Scene) -> set[bpy.types.Object]:
    """The scene's, and all that they are computed from: what collections and nodes show need not be in it."""
    used = (block.original for block in bpy.context.evaluated_depsgraph_get().ids)
    return {*scene.objects, *(block for block in used if isinstance(block, bpy.types.Object))}


def _of_rigid_bodies(scene: bpy.types.Scene) -> Iterator[Simulation]:
    world = scene.rigidbody_world
    cache = None if world is None else world.point_cache
    if cache is not None and (cache.use_disk_cache or not cache.is_baked):
        kept = Kept.ON_DISK if cache.use_disk_cache else Kept.IN_MEMORY
        yield Simulation(name=scene.name, kept=kept, first_frame=cache.frame_start)


def _of_point_caches(made: bpy.types.Object) -> Iterator[Simulation]:
    for modifier in made.modifiers:
        if hasattr(modifier, "point_cache"):  # cloth and soft bodies
            yield from _of_point_cache(made, modifier.point_cache)
        canvas = getattr(modifier, "canvas_settings", None)
        for surface in () if canvas is None else canvas.canvas_surfaces:
            yield from _of_point_cache(made, surface.point_cache)
    for system in made.particle_systems:
        if system.settings.type != "HAIR" or system.use_hair_dynamics:
            yield from _of_point_cache(made, system.point_cache)


def _of_point_cache(owner: bpy.types.ID, cache: bpy.types.PointCache) -> Iterator[Simulation]:
    if owner.library is not None and (cache.is_baked or cache.use_disk_cache):
        return
    kept = Kept.IN_FILE if owner.library is None and owner.override_library is None else Kept.IN_MEMORY
    if cache.use_disk_cache:
        kept = Kept.ON_DISK
    yield Simulation(name=owner.name, kept=kept, first_frame=cache.frame_start)


def _of_zones(scene: bpy.types.Scene, made: bpy.types.Object) -> Iterator[Simulation]:
    """Whether one is baked cannot be asked for; then its frames are read when they are played."""
    for modifier in made.modifiers:
        for bake in modifier.bakes if modifier.type == "NODES" else ():
            if bake.node is not None and bake.node.type == "SIMULATION_OUTPUT":
                first = bake.frame_start if bake.use_custom_simulation_frame_range else scene.frame_start
                yield Simulation(name=made.name, kept=Kept.IN_MEMORY, first_frame=first)
