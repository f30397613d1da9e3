"""Arguments of operators that stand for settings of the scene where they are left out."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bpy

from .properties import FEWVIEW_PG_settings


def absolute(path: str) -> str:
    """The path that a user gave, as another program needs it: without // for the .blend's folder."""
    return str(Path(bpy.path.abspath(path)).absolute())


def argument(setting: str) -> Any:
    """A property for an operator, defined as the scene's setting is.

    It is not remembered from one call to the next: what is left out is the scene's, not the last call's.
    """
    deferred = FEWVIEW_PG_settings.__annotations__[setting]
    options = deferred.keywords.get("options", ())
    return deferred.function(**{**deferred.keywords, "options": {"SKIP_SAVE", *options}})


def fill_in(
    operator: bpy.types.Operator, settings: FEWVIEW_PG_settings, settings_of_arguments: Mapping[str, str]
) -> None:
    """Give the arguments that were left out the scene's settings, by the names of both."""
    for name, setting in settings_of_arguments.items():
        if not operator.properties.is_property_set(name):
            setattr(operator, name, getattr(settings, setting))
