"""Whether an operator can run now, and what to tell where it cannot."""

from typing import Any


def speaks_nothing_against(cls: Any, reason: str) -> bool:
    """For `poll`: whether the reason is empty; else Blender shows it at the greyed button."""
    if reason:
        cls.poll_message_set(reason)
    return not reason
