"""How words and buttons look in the sidebar."""

import textwrap

import bpy

from .state_lines import StepState

_MAIN_SCALE = 1.5
_PIXELS_PER_LETTER = 7.0
_MOST_LETTERS = 1000
"""Of what a program says: the sidebar is drawn many times a second, and its buttons are below."""


def draw_button(
    layout: bpy.types.UILayout, operator: str, *, icon: str, text: str, main: bool = True
) -> None:
    """A button; the one to press next is larger."""
    row = layout.row()
    row.scale_y = _MAIN_SCALE if main else 1.0
    row.operator(operator, icon=icon, text=text)


def draw_state(layout: bpy.types.UILayout, state: StepState) -> None:
    """The state of a step, in a line."""
    layout.label(text=state.text, icon=state.icon)


def draw_text(
    layout: bpy.types.UILayout, context: bpy.types.Context, text: str, *, icon: str = "NONE"
) -> None:
    """A sentence in as many lines as the sidebar is narrow; nothing for an empty one."""
    scale = context.preferences.system.ui_scale or 1.0  # 0 without a window
    width = context.region.width if context.region is not None else 300
    letters = max(int(width / (_PIXELS_PER_LETTER * scale)) - (8 if icon != "NONE" else 5), 16)
    column = layout.column(align=True)
    column.scale_y = 0.8
    for number, line in enumerate(textwrap.wrap(brief(text), letters)):
        column.label(text=line, icon=icon if number == 0 else ("BLANK1" if icon != "NONE" else "NONE"))


def brief(text: str) -> str:
    """The text, or its beginning where it is without end."""
    return text if len(text) <= _MOST_LETTERS else f"{text[:_MOST_LETTERS]}..."
