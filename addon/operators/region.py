"""Step 3: the sphere around what is to be reconstructed."""

from typing import ClassVar

import bpy
import numpy as np
from bpy.props import FloatProperty, FloatVectorProperty

from .. import region
from ..mesh_import import select_alone
from ..scenes import reason_against_changes
from .on_result import Status
from .polling import speaks_nothing_against


class FEWVIEW_OT_add_region(bpy.types.Operator):
    """Add a sphere that says what to reconstruct: move and scale it in the viewport"""

    bl_idname = "fewview.add_region"
    bl_label = "Add Region"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    centre: FloatVectorProperty(
        name="Center", description="In the world", subtype="TRANSLATION", options={"SKIP_SAVE"}
    )
    radius: FloatProperty(
        name="Radius",
        description="Where this is 0, place and size are guessed",
        subtype="DISTANCE",
        min=0.0,
        options={"SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        reason = reason_against_changes(context.scene)
        if not reason and region.region_or_none(context.scene) is not None:
            reason = "There is a region already: scale it, or fit it"
        return speaks_nothing_against(cls, reason)

    def execute(self, context: bpy.types.Context) -> Status:
        sphere, source = region.guess(context.scene)
        if self.radius > 0:
            sphere, source = (np.array(self.centre, np.float64), self.radius), "the given place"
        empty = region.place_region(context.scene, sphere)
        select_alone(context.scene, empty)
        self.report({"INFO"}, f"Placed the region at {source}")
        return {"FINISHED"}


class FEWVIEW_OT_fit_region(bpy.types.Operator):
    """Fit the region to the points that the photographs have in common, without their background"""

    bl_idname = "fewview.fit_region"
    bl_label = "Fit Region"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return speaks_nothing_against(cls, reason_against_changes(context.scene))

    def execute(self, context: bpy.types.Context) -> Status:
        try:
            sphere, source = region.fitted(context.scene)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        select_alone(context.scene, region.place_region(context.scene, sphere))
        self.report({"INFO"}, f"Fitted the region to {source}")
        return {"FINISHED"}


class FEWVIEW_OT_remove_region(bpy.types.Operator):
    """Remove the region: it is then found automatically"""

    bl_idname = "fewview.remove_region"
    bl_label = "Remove Region"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if context.scene.fewview.region is None:
            cls.poll_message_set("There is no region")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> Status:
        region.remove_region(context.scene)
        return {"FINISHED"}


CLASSES = (FEWVIEW_OT_add_region, FEWVIEW_OT_fit_region, FEWVIEW_OT_remove_region)
