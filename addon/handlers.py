"""What happens to a running job when Blender loads another file or quits."""

import atexit

import bpy
from bpy.app.handlers import persistent

from . import jobs


@persistent
def _before_load(*_: object) -> None:
    """The job belongs to the scene that is left: its result waits on disk."""
    jobs.detach("Another file was opened meanwhile: find the result with Import Past Job")


def register() -> None:
    """Watch for files and the end."""
    bpy.app.handlers.load_pre.append(_before_load)
    atexit.register(jobs.stop)


def unregister() -> None:
    """End the running job and watch no more."""
    jobs.stop()
    atexit.unregister(jobs.stop)
    bpy.app.handlers.load_pre.remove(_before_load)
