"""What the sidebar says above the steps: what runs, how it ended, and whether anything can run."""

import bpy

from . import jobs
from .drawing import brief, draw_button, draw_text
from .environment import State
from .operators.environment import backend_state
from .progress import seconds_left, stage_words, time_words
from .state_lines import READY

_SILENCE_S = 30.0


def draw_environment(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Whether there is a Python that can reconstruct, and how to get one."""
    state, text = backend_state(context)
    if state is State.READY:
        layout.label(text="Ready to reconstruct", icon=READY)
        draw_text(layout, context, text)
        return
    if state is State.UNKNOWN:
        layout.label(text="Not checked yet", icon="INFO")
        draw_button(layout, "fewview.check_backend", icon="CHECKMARK", text="Check Setup")
        return
    layout.label(text="Set up FewView once", icon="INFO")
    draw_text(layout, context, text)
    draw_text(layout, context, "It computes in a Python of its own, which is downloaded for it")
    draw_button(layout, "fewview.install_backend", icon="IMPORT", text="Set Up FewView")
    if not bpy.app.online_access:
        draw_text(layout, context, "Allow Online Access in Preferences > System first", icon="ERROR")
        show = layout.operator("screen.userpref_show", text="Open Preferences", icon="PREFERENCES")
        show.section = "SYSTEM"
    row = layout.row(align=True)
    row.operator("fewview.check_backend")
    row.operator("fewview.copy_install_lines", icon="COPYDOWN")


def draw_running(layout: bpy.types.UILayout, context: bpy.types.Context, job: jobs.RunningJob) -> None:
    """Stage, bar, time left, and how to stop it."""
    left = seconds_left(job.share, job.elapsed_s)
    layout.label(text=job.title, icon="TIME")
    words = brief(stage_words(job.stage)) if job.stage else "Starting"
    layout.progress(factor=job.share, text=f"{words}  {job.share:.0%}", type="BAR")
    row = layout.row()
    row.label(text=brief(job.text))
    if job.cancelling:
        layout.label(text="Stopping...")
    elif left is not None:
        layout.label(text=f"About {time_words(left)} left")
    if job.silent_s > _SILENCE_S:
        draw_text(layout, context, f"No sign of life for {time_words(job.silent_s)}")
    for text in job.warnings[-2:]:
        draw_text(layout, context, text, icon="ERROR")
    row = layout.row(align=True)
    row.operator("fewview.cancel", icon="CANCEL")
    row.operator("fewview.show_log", icon="TEXT")


def draw_ended(layout: bpy.types.UILayout, context: bpy.types.Context, end: jobs.EndedJob) -> None:
    """What went wrong, or what the user should know."""
    row = layout.row()
    if end.cancelled:
        row.label(text=f"{end.title} was cancelled", icon="CANCEL")
    elif end.failure is not None:
        row.label(text=f"{end.title} failed", icon="ERROR")
    else:
        row.label(text=f"{end.title} is done", icon="INFO")
    row.operator("fewview.dismiss", icon="X", text="", emboss=False)
    if end.failure is not None and not end.cancelled:
        draw_text(layout, context, end.failure.text.partition("\n")[0])
    if end.failure is not None:
        draw_text(layout, context, end.failure.remedy, icon="FORWARD")
    for text in end.notes:
        draw_text(layout, context, text)
    for text in end.warnings[:3]:
        draw_text(layout, context, text, icon="ERROR")
    if end.failure is not None and not end.cancelled:
        row = layout.row(align=True)
        row.operator("fewview.show_log", icon="TEXT")
        row.operator("fewview.copy_report", icon="COPYDOWN")
