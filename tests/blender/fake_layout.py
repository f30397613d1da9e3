"""A layout that draws nothing: it notes what a panel asks for, and refuses what Blender would not know."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import bpy

PARTS = frozenset({"row", "column", "box", "split", "column_flow", "grid_flow"})
"""Calls that give a layout inside of this one."""
SETTINGS: Mapping[str, object] = {
    "scale_x": 1.0,
    "scale_y": 1.0,
    "enabled": True,
    "active": True,
    "alert": False,
    "alignment": "EXPAND",
    "use_property_split": False,
    "use_property_decorate": True,
    "operator_context": "INVOKE_DEFAULT",
}


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """One thing in a panel."""

    kind: str
    """The layout's call: label, prop, operator ..."""
    what: str
    """Name of the property or operator; empty for others."""
    text: str
    icon: str
    scale_y: float
    enabled: bool
    values: Mapping[str, Any] = field(default_factory=dict)
    """Other arguments."""
    button: Any = None
    """Arguments that the panel gives to the operator."""


class FakeLayout:
    """Stands in for bpy.types.UILayout; layouts inside share what is noted."""

    def __init__(self, parent: "FakeLayout | None" = None) -> None:
        shared: list[Drawn] = [] if parent is None else parent.drawn
        for name, value in {**SETTINGS, "drawn": shared, "parent": parent}.items():
            object.__setattr__(self, name, value)

    def __setattr__(self, name: str, value: object) -> None:
        """Only what a layout has, and of the right kind."""
        known = name in SETTINGS and name in bpy.types.UILayout.bl_rna.properties
        assert known, f"a layout has no {name}"
        wanted = type(SETTINGS[name])
        assert type(value) in ({float, int} if wanted is float else {wanted}), f"{name} = {value!r}"
        object.__setattr__(self, name, value)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        """A call of the layout's."""
        function = bpy.types.UILayout.bl_rna.functions.get(name)
        assert function is not None, f"a layout has no {name}"
        return lambda *args, **values: self._call(name, args, values)

    def texts(self) -> list[str]:
        """All words, in order."""
        return [drawn.text for drawn in self.drawn if drawn.text]

    def operators(self) -> dict[str, Drawn]:
        """The buttons by the names of their operators; of several the first."""
        return {drawn.what: drawn for drawn in reversed(self.drawn) if drawn.kind == "operator"}

    def props(self) -> set[str]:
        """Names of the properties that are shown."""
        return {drawn.what for drawn in self.drawn if drawn.kind == "prop"}

    def main(self) -> list[str]:
        """Names of the operators whose buttons are larger than usual."""
        return [drawn.what for drawn in self.drawn if drawn.kind == "operator" and drawn.scale_y > 1.0]

    def _call(self, name: str, args: tuple[Any, ...], values: dict[str, Any]) -> Any:
        parameters = bpy.types.UILayout.bl_rna.functions[name].parameters
        given = [key for key in parameters.keys() if not parameters[key].is_output]  # noqa: SIM118
        # Of the calls we make, those that take data and a name may have them without keywords.
        values = {**dict(zip(given, args, strict=False)), **values}
        assert len(args) <= len(given), f"{name} takes no {len(args)} arguments"
        unknown = set(values) - set(given)
        assert not unknown, f"{name} has no {', '.join(unknown)}"
        for key in ("text", "placeholder"):
            assert isinstance(values.get(key, ""), str), f"{key} of {name} is {values[key]!r}"
        icons = bpy.types.UILayout.bl_rna.functions["label"].parameters["icon"].enum_items
        assert values.get("icon", "NONE") in icons, f"there is no icon {values['icon']}"
        if name in PARTS:
            return FakeLayout(self)
        button = _checked(name, values)
        self._note(name, values, button)
        return button

    def _note(self, name: str, values: dict[str, Any], button: Any) -> None:
        chain: list[FakeLayout] = [self]
        while chain[-1].parent is not None:
            chain.append(chain[-1].parent)
        scale = 1.0
        for layout in chain:
            scale *= layout.scale_y
        self.drawn.append(
            Drawn(
                kind=name,
                what=str(values.get("property" if name == "prop" else "operator", "")),
                text=values.get("text", ""),
                icon=values.get("icon", "NONE"),
                scale_y=scale,
                enabled=all(layout.enabled for layout in chain),
                values=values,
                button=button,
            )
        )


class Button:
    """What `operator` gives back: takes arguments that the operator has."""

    def __init__(self, operator: str) -> None:
        object.__setattr__(self, "_operator", operator)

    def __setattr__(self, name: str, value: object) -> None:
        operator = self._operator
        assert name in operator_type(operator).properties, f"{operator} has no argument {name}"
        object.__setattr__(self, name, value)


def operator_type(operator: str) -> Any:
    """The RNA type of an operator. Raises AssertionError where it is not registered."""
    category, _, name = operator.partition(".")
    try:
        return getattr(getattr(bpy.ops, category), name).get_rna_type()
    except KeyError as error:
        raise AssertionError(f"{operator} is not registered") from error


def draw(panel: type[bpy.types.Panel], context: bpy.types.Context | None = None) -> FakeLayout | None:
    """What the panel draws; None where it is hidden."""
    context = bpy.context if context is None else context
    if hasattr(panel, "poll") and not panel.poll(context):
        return None
    layout = FakeLayout()
    drawn = SimpleNamespace(layout=layout)
    if hasattr(panel, "state"):
        drawn.state = lambda context: panel.state(drawn, context)
    panel.draw(drawn, context)
    return layout


def draw_header(panel: type[bpy.types.Panel], context: bpy.types.Context | None = None) -> FakeLayout:
    """What the panel draws at the right of its title."""
    layout = FakeLayout()
    drawn = SimpleNamespace(layout=layout)
    drawn.state = lambda context: panel.state(drawn, context)
    panel.draw_header_preset(drawn, bpy.context if context is None else context)
    return layout


def _checked(name: str, values: dict[str, Any]) -> Any:
    """Refuse data, properties, lists and operators that are not there; a button for an operator."""
    if name == "prop":
        data, key = values["data"], values["property"]
        assert data is not None, f"{key} of nothing"
        assert key in data.bl_rna.properties, f"{data.bl_rna.identifier} has no property {key}"
    if name == "template_list":
        assert hasattr(bpy.types, values["listtype_name"]), values["listtype_name"]
        assert values["propname"] in values["dataptr"].bl_rna.properties
        assert values["active_propname"] in values["active_dataptr"].bl_rna.properties
    if name == "progress":
        assert 0.0 <= values["factor"] <= 1.0
    if name == "operator":
        operator_type(values["operator"])
        return Button(values["operator"])
    return None
