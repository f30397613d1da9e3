"""The light of every scene, fixed to the world and not to the camera."""

from typing import Any

import bpy
import numpy as np
from mathutils import Matrix, Vector
from numpy.typing import NDArray


def light_scene(*, centre: NDArray[np.float64], radius: float) -> None:
    """A sky brighter above, a soft sun and a large lamp, placed about the subject.

    A white surface that faces the sun comes out at 0.9 of full scale or less, so nothing burns out.
    """
    world = bpy.data.worlds.new("sky")
    if world.node_tree is None:  # before Blender 5.0 a new world has no nodes
        world.use_nodes = True
    bpy.context.scene.world = world
    _paint_sky(world.node_tree)
    sun = _lamp("sun", "SUN")
    sun.data.energy, sun.data.angle = 2.6, np.deg2rad(12.0)
    sun.rotation_euler = Vector((0.5, -0.65, 0.75)).to_track_quat("Z", "Y").to_euler()
    lamp = _lamp("lamp", "AREA")
    offset = Vector((-2.6, -2.4, 2.2)) * radius
    lamp.data.shape, lamp.data.size = "SQUARE", 2.0 * radius
    # Power for a fixed brightness at the centre: it falls with the square of the distance.
    lamp.data.energy = 2.2 * offset.length_squared
    lamp.matrix_world = (
        Matrix.Translation(Vector(centre) + offset) @ offset.to_track_quat("Z", "Y").to_matrix().to_4x4()
    )


def _lamp(name: str, kind: str) -> Any:
    made = bpy.data.objects.new(name, bpy.data.lights.new(name, kind))
    bpy.context.scene.collection.objects.link(made)
    return made


def _paint_sky(tree: Any) -> None:
    """From a dim ground over a bright horizon to a soft blue zenith."""
    place = tree.nodes.new("ShaderNodeTexCoord")
    split = tree.nodes.new("ShaderNodeSeparateXYZ")
    height = tree.nodes.new("ShaderNodeMapRange")
    height.inputs["From Min"].default_value = -1.0
    ramp = tree.nodes.new("ShaderNodeValToRGB")
    ramp.color_ramp.elements.new(0.5)
    colours = ((0.0, (0.22, 0.2, 0.18)), (0.5, (0.5, 0.5, 0.5)), (1.0, (0.5, 0.56, 0.68)))
    for element, (position, colour) in zip(ramp.color_ramp.elements, colours, strict=True):
        element.position, element.color = position, (*colour, 1.0)
    background = next(node for node in tree.nodes if node.type == "BACKGROUND")
    background.inputs["Strength"].default_value = 0.6
    tree.links.new(place.outputs["Generated"], split.inputs[0])
    tree.links.new(split.outputs["Z"], height.inputs["Value"])
    tree.links.new(height.outputs[0], ramp.inputs[0])
    tree.links.new(ramp.outputs["Color"], background.inputs["Color"])
