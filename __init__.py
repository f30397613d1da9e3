"""The extension's door for Blender; the import is lazy so that the backend and the tests never need bpy."""


def register() -> None:
    """Switch the add-on on."""
    from . import addon

    addon.register()


def unregister() -> None:
    """Switch the add-on off."""
    from . import addon

    addon.unregister()
