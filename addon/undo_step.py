"""An undo step for what a timer, or an operator that waited for a job, has done to the scene."""

import bpy


def push(message: str) -> None:
    """Let the user undo what was done since the last step, under this name."""
    windows = bpy.context.window_manager.windows
    window = bpy.context.window or (windows[0] if windows else None)
    with bpy.context.temp_override(window=window):
        if bpy.ops.ed.undo_push.poll():
            bpy.ops.ed.undo_push(message=message)
