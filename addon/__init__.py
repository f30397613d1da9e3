"""The add-on's side inside Blender: for now it registers and shows nothing."""

import bpy

_CLASSES: tuple[type[bpy.types.bpy_struct], ...] = ()


def register() -> None:
    """Make the add-on's classes known to Blender."""
    for cls in _CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    """Take them back, in the opposite order."""
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
