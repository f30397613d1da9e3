"""What the operators have in common that work on a result: which one, and when it can be worked on."""

from typing import Any

import bpy
from bpy.props import StringProperty

from ..result_mesh import result_or_none
from ..scenes import object_or_none

Status = set[str]
RECONSTRUCT_FIRST = "Reconstruct first, or bring a result back from Past Jobs"


def has_result(cls: Any, context: bpy.types.Context) -> bool:
    """For `poll`: there is a result, and no other mode is in the way."""
    if result_or_none(context) is None:
        cls.poll_message_set(RECONSTRUCT_FIRST)
        return False
    if context.mode != "OBJECT":
        cls.poll_message_set("Change to Object Mode first")
        return False
    return True


def result_of(context: bpy.types.Context, name: str) -> bpy.types.Object:
    """The mesh object of this name; without a name the result that is meant. Raises ValueError for others."""
    result = object_or_none(context.scene, name) if name else result_or_none(context)
    if result is None or result.type != "MESH":
        raise ValueError(f"There is no mesh {name} in this scene" if name else RECONSTRUCT_FIRST)
    return result


def refused(operator: bpy.types.Operator, error: Exception) -> Status:
    operator.report({"ERROR"}, str(error))
    return {"CANCELLED"}


class OnResult:
    """What the operators have in common that work on a result."""

    object_name: StringProperty(
        name="Mesh",
        description="Name of the mesh; the selected result, or the one imported last, where this is empty",
        options={"SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return has_result(cls, context)
