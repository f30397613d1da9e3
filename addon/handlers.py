"""What happens to a job and its preview when Blender loads another file, undoes or quits."""

import atexit

import bpy
from bpy.app.handlers import persistent

from . import jobs
from .mesh_import import remove_preview


@persistent
def _after_load(*_: object) -> None:
    """The job belongs to the scene that was left: its result waits on disk.

    Not before the load, which may fail and leave the scene as it is. A file that was saved while a job ran
    holds a preview, which nothing would remove any more.
    """
    jobs.detach("Another file was opened meanwhile.")
    remove_preview()


@persistent
def _after_undo(*_: object) -> None:
    """A step of the user's while a job ran holds its preview as well."""
    if jobs.running() is None:
        remove_preview()


_HANDLERS = (
    (bpy.app.handlers.load_post, _after_load),
    (bpy.app.handlers.undo_post, _after_undo),
    (bpy.app.handlers.redo_post, _after_undo),
)


def register() -> None:
    """Watch for files, undo and the end."""
    for handlers, handler in _HANDLERS:
        handlers.append(handler)
    atexit.register(jobs.close)


def unregister() -> None:
    """End the running job and watch no more."""
    jobs.stop()
    atexit.unregister(jobs.close)
    for handlers, handler in _HANDLERS:
        handlers.remove(handler)
