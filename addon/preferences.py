"""The add-on's preferences: which Python reconstructs, and where jobs go."""

from types import SimpleNamespace

import bpy
from bpy.props import EnumProperty, StringProperty

from .. import __package__ as EXTENSION

_DEFAULTS = SimpleNamespace(backend_python="", environment_folder="", torch_build="cpu", output="~/FewView")


class FEWVIEW_AP_preferences(bpy.types.AddonPreferences):
    """Preferences of FewView"""

    bl_idname = EXTENSION

    backend_python: StringProperty(
        name="Python",
        description="Python to compute with; the one that Set Up FewView made where this is empty",
        subtype="FILE_PATH",
    )
    environment_folder: StringProperty(
        name="Environment Folder",
        description="Where Set Up FewView puts its Python; a folder of its own where this is empty",
        subtype="DIR_PATH",
    )
    torch_build: EnumProperty(
        name="Compute On",
        items=[
            ("cpu", "CPU", "The smallest download; no GPU is needed"),
            ("default", "Standard", "The usual build; on Linux with CUDA, on a Mac with MPS"),
            ("cuda", "CUDA", "For a GPU by NVIDIA; the largest download"),
        ],
    )
    output: StringProperty(
        name="Output",
        description="Folder for the jobs of .blend files that are not saved yet",
        subtype="DIR_PATH",
        default=_DEFAULTS.output,
    )

    def draw(self, context: bpy.types.Context) -> None:
        """The page in Edit > Preferences > Add-ons."""
        from .environment import State
        from .job_boxes import draw_environment
        from .operators.environment import backend_state

        layout = self.layout
        layout.use_property_split = True
        draw_environment(layout, context)
        layout.prop(self, "backend_python")
        layout.prop(self, "environment_folder")
        layout.prop(self, "torch_build")
        row = layout.row(align=True)
        if backend_state(context)[0] is not State.NOT_READY:  # else the button above is the one to press
            row.operator("fewview.install_backend", icon="IMPORT", text="Set Up FewView")
        row.operator("fewview.remove_backend", icon="TRASH")
        layout.prop(self, "output")


CLASSES = (FEWVIEW_AP_preferences,)


def preferences_of(context: bpy.types.Context) -> FEWVIEW_AP_preferences | SimpleNamespace:
    """The preferences of this add-on; their defaults where Blender has none.

    It has none where the add-on was enabled for this session alone, as `blender --addons` does.
    """
    found = context.preferences.addons.get(EXTENSION)
    return _DEFAULTS if found is None else found.preferences
