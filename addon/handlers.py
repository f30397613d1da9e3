"""What happens to a running job when Blender loads another file or quits."""

import atexit

import bpy
from bpy.app.handlers import persistent

from . import jobs
from .mesh_import import remove_preview


@persistent
def _before_load(*_: object) -> None:
    """The job belongs to the scene that is left: its result waits on disk."""
    jobs.detach("Another file was opened meanwhile.")


@persistent
def _after_load(*_: object) -> None:
    """A file that was saved while a job ran holds a preview, which nothing would remove any more."""
    remove_preview()


def register() -> None:
    """Watch for files and the end."""
    bpy.app.handlers.load_pre.append(_before_load)
    bpy.app.handlers.load_post.append(_after_load)
    atexit.register(jobs.close)


def unregister() -> None:
    """End the running job and watch no more."""
    jobs.stop()
    atexit.unregister(jobs.close)
    bpy.app.handlers.load_post.remove(_after_load)
    bpy.app.handlers.load_pre.remove(_before_load)
