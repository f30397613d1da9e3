"""Step 5: how far the mesh is from the object that was rendered."""

from typing import Any, ClassVar

import bpy
from bpy.props import StringProperty

from .. import colours
from ..error_map import measure_steps
from ..properties import settings_of
from ..scenes import object_or_none
from .on_result import OnResult, Status, refused, result_of

_TICK_S = 0.01


class FEWVIEW_OT_measure_error(OnResult, bpy.types.Operator):
    """Measure how far the mesh is from the object that was rendered, and show it in colors"""

    bl_idname = "fewview.measure_error"
    bl_label = "Measure Error"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    truth: StringProperty(
        name="Original",
        description="Object to compare with, or several with commas; the scene's where this is empty",
        options={"SKIP_SAVE"},
    )

    def execute(self, context: bpy.types.Context) -> Status:
        try:
            steps = self._steps(context)
            while True:
                next(steps)
        except StopIteration as end:
            return self._finished(context, end)
        except ValueError as error:
            return refused(self, error)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Status:
        if bpy.app.background:
            return self.execute(context)
        try:
            self._measuring = self._steps(context)
        except ValueError as error:
            return refused(self, error)
        self._timer = context.window_manager.event_timer_add(_TICK_S, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> Status:
        if event.type == "ESC":
            return self._ended(context, {"CANCELLED"})
        if event.type != "TIMER":
            return {"RUNNING_MODAL"}
        try:
            done = next(self._measuring)
        except StopIteration as end:
            return self._ended(context, self._finished(context, end))
        except ValueError as error:
            return self._ended(context, refused(self, error))
        context.workspace.status_text_set(f"Measuring the error: {done:.0%}  (Esc to cancel)")
        return {"RUNNING_MODAL"}

    def _steps(self, context: bpy.types.Context) -> Any:
        result = result_of(context, self.object_name)
        return measure_steps(result.session_uid, [made.session_uid for made in self._truths(context)])

    def _truths(self, context: bpy.types.Context) -> list[bpy.types.Object]:
        target = settings_of(context).target
        if not self.truth:
            return [] if target is None else [target]
        whole = object_or_none(context.scene, self.truth)  # its name may have a comma
        names = [self.truth] if whole else [name.strip() for name in self.truth.split(",")]
        found = {name: object_or_none(context.scene, name) for name in names}
        if missing := [name for name, made in found.items() if made is None]:
            raise ValueError(f"There is no object {', '.join(missing)} in this scene")
        return [made for made in found.values() if made is not None]

    def _finished(self, context: bpy.types.Context, end: StopIteration) -> Status:
        self.report({"INFO"}, end.value.text)
        colours.show_in_viewports(result_of(context, self.object_name).data)
        return {"FINISHED"}

    def _ended(self, context: bpy.types.Context, status: Status) -> Status:
        context.window_manager.event_timer_remove(self._timer)
        context.workspace.status_text_set(None)
        return status
