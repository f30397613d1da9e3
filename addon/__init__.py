"""The add-on: collects photographs or renders views, has the backend make a mesh, brings it into the scene.

Importing this package needs no Blender; `register` does.
"""

from contextlib import ExitStack
from types import ModuleType

_registered = ExitStack()
"""What `unregister` takes back, last first."""


def _modules() -> tuple[ModuleType, ...]:
    """Those with something to register, in an order in which each finds what it refers to."""
    from . import command_line, handlers, panels, preferences, properties
    from .operators import (
        cameras,
        environment,
        images,
        novel_views,
        points,
        reconstruct,
        region,
        result,
        views,
    )

    operators = (environment, images, views, cameras, region, reconstruct, result, novel_views, points)
    return (preferences, properties, *operators, panels, command_line, handlers)


def register() -> None:
    """Make the add-on known to Blender; where a part fails, nothing stays behind."""
    with ExitStack() as undo:
        for module in _modules():
            _register_classes(module, undo)
            if hasattr(module, "register"):
                module.register()
                undo.callback(module.unregister)
        _registered.push(undo.pop_all())


def unregister() -> None:
    """Take everything back, in the opposite order."""
    _registered.close()


def _register_classes(module: ModuleType, undo: ExitStack) -> None:
    import bpy

    for cls in getattr(module, "CLASSES", ()):
        bpy.utils.register_class(cls)
        undo.callback(bpy.utils.unregister_class, cls)
