"""Scenes that can be worked on; they and objects found again, after the user had time to rename or delete."""

from pathlib import Path

import bpy


def reason_against_changes(scene: bpy.types.Scene) -> str:
    """Why nothing can be put into the scene; empty where something can."""
    if scene.library is None:
        return ""
    file = Path(scene.library.filepath).name
    return (
        f"The scene {scene.name} is linked from {file} and takes no new objects: make it local by the chain "
        "beside its name at the top of the window, or append it instead"
    )


def scene_named(name: str) -> bpy.types.Scene:
    """The scene. Raises ValueError where the user has removed or renamed it meanwhile."""
    found = bpy.data.scenes.get(name)
    if found is None:
        raise ValueError(f"the scene {name} is no longer there")
    return found


def scene_name_of(uid: int) -> str:
    """What the scene with this `session_uid` is called by now. Raises ValueError where it was removed."""
    found = next((scene for scene in bpy.data.scenes if scene.session_uid == uid), None)
    if found is None:
        raise ValueError("the scene that the job was started in is no longer there")
    return str(found.name)


def in_scene(scene: bpy.types.Scene, made: bpy.types.Object | None) -> bpy.types.Object | None:
    """The object of a setting; None where it was deleted: the setting keeps it alive, out of the scene."""
    if made is None or any(made.visible_get(view_layer=layer) for layer in scene.view_layers):
        return made  # known at once, while the scene looks through the names of all its objects
    found = scene.objects.get(made.name)
    if found is None or found == made:
        return found
    # Of several with one name, some of them linked from other files, the look-up gives the first.
    return next((other for other in scene.objects if other == made), None)


def has_camera(scene: bpy.types.Scene) -> bool:
    """Whether there is one to render from."""
    return scene.camera is not None or any(made.type == "CAMERA" for made in scene.objects)


def object_or_none(scene: bpy.types.Scene, name: str) -> bpy.types.Object | None:
    """The object of this full name, or else name: of several with one name that of no other file."""
    return next((made for made in scene.objects if made.name_full == name), scene.objects.get(name))


def object_named(scene: bpy.types.Scene, name: str) -> bpy.types.Object:
    """As `object_or_none`. Raises ValueError where there is none."""
    found = object_or_none(scene, name)
    if found is None:
        raise ValueError(f"There is no object {name} in the scene")
    return found
