"""What surfaces look like: one description, one shader.

Lengths are relative to the radius of the thing, so that a texture has the same fineness in the
picture whatever the size of the model.
"""

from dataclasses import dataclass
from typing import Any

import bpy

Colour = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Patches of some colours, with grain over them, on a principled shader."""

    colours_linear: tuple[Colour, ...]
    """Two or more blend into patches; one alone is plain."""
    patches_per_radius: float = 2.5
    patch_softness: float = 0.3
    """Share of the way from one colour to the next that is a gradient, 0 to 1."""
    grain_per_radius: float = 16.0
    grain: float = 0.0
    """Contrast of the fine noise: 0 none, 1 from almost black to beyond the patch's colour."""
    roughness: float = 0.8
    coat: float = 0.0
    """Weight of a clear, glossy coat, 0 to 1."""


FINE = Surface(
    colours_linear=((0.55, 0.22, 0.08), (0.62, 0.45, 0.2), (0.16, 0.36, 0.34), (0.6, 0.56, 0.46)), grain=1.0
)
GLOSSY = Surface(colours_linear=FINE.colours_linear, grain=1.0, roughness=0.35, coat=1.0)
PLAIN = Surface(colours_linear=((0.55, 0.53, 0.5),), roughness=0.9)
SPOTS = Surface(
    colours_linear=((0.62, 0.5, 0.34), (0.25, 0.1, 0.045)),
    patches_per_radius=1.6,
    patch_softness=0.25,
    roughness=0.6,
)
WOOD = Surface(
    colours_linear=((0.3, 0.16, 0.07), (0.42, 0.25, 0.12), (0.34, 0.19, 0.09)),
    patches_per_radius=6.0,
    grain=0.6,
    grain_per_radius=40.0,
    roughness=0.5,
)

SURFACES = {"fine": FINE, "glossy": GLOSSY, "plain": PLAIN, "spots": SPOTS}
"""Surfaces that can be put on any model by name."""


def make_material(surface: Surface, *, radius: float, seed: int) -> Any:
    """A new material; the seed moves the noise, so that no two things look alike."""
    material = bpy.data.materials.new("surface")
    if material.node_tree is None:  # before Blender 5.0 a new material has no nodes
        material.use_nodes = True
    tree = material.node_tree
    shader = next(node for node in tree.nodes if node.type == "BSDF_PRINCIPLED")
    shader.inputs["Roughness"].default_value = surface.roughness
    shader.inputs["Coat Weight"].default_value = surface.coat
    shader.inputs["Base Color"].default_value = (*surface.colours_linear[0], 1.0)
    if len(surface.colours_linear) > 1:
        patches = _noise(tree, scale=surface.patches_per_radius / radius, detail=1.0, seed=seed)
        colour = _colour_ramp(tree, patches, surface)
        if surface.grain > 0:
            # Five octaves from about 20 pixels down to one, in a picture of 800x600 of the whole thing.
            noise = _noise(tree, scale=surface.grain_per_radius / radius, detail=4.0, seed=seed + 1)
            colour = _multiplied(tree, colour, noise, contrast=surface.grain)
        tree.links.new(colour, shader.inputs["Base Color"])
    return material


def _noise(tree: Any, *, scale: float, detail: float, seed: int) -> Any:
    """Socket of a 4D noise over the object's own coordinates, about 0.3 to 0.7; the seed is its 4th axis."""
    place = tree.nodes.new("ShaderNodeTexCoord")
    noise = tree.nodes.new("ShaderNodeTexNoise")
    noise.noise_dimensions = "4D"
    noise.inputs["W"].default_value = 17.3 * seed
    noise.inputs["Scale"].default_value = scale
    noise.inputs["Detail"].default_value = detail
    noise.inputs["Roughness"].default_value = 0.8
    tree.links.new(place.outputs["Object"], noise.inputs["Vector"])
    return noise.outputs[0]


def _colour_ramp(tree: Any, noise: Any, surface: Surface) -> Any:
    """Socket of the patches' colour: the noise's middle range is cut into one band a colour."""
    node = tree.nodes.new("ShaderNodeValToRGB")
    ramp = node.color_ramp
    low, high = 0.36, 0.64
    band = (high - low) / len(surface.colours_linear)
    stops = []
    for index, colour in enumerate(surface.colours_linear):
        half_flat = band / 2 * (1.0 - surface.patch_softness)
        middle = low + band * (index + 0.5)
        stops += [(middle - half_flat, colour), (middle + half_flat, colour)]
    while len(ramp.elements) < len(stops):
        ramp.elements.new(1.0)
    for element, (position, colour) in zip(ramp.elements, stops, strict=True):
        element.position = position
        element.color = (*colour, 1.0)
    tree.links.new(noise, node.inputs[0])
    return node.outputs["Color"]


def _multiplied(tree: Any, colour: Any, noise: Any, *, contrast: float) -> Any:
    """Socket of the colour times a grey factor around 0.85 that follows the noise."""
    factor = tree.nodes.new("ShaderNodeMapRange")
    for name, value in {
        "From Min": 0.36,
        "From Max": 0.64,
        "To Min": 0.85 - 0.7 * contrast,
        "To Max": 0.85 + 0.5 * contrast,
    }.items():
        factor.inputs[name].default_value = value
    tree.links.new(noise, factor.inputs["Value"])
    product = tree.nodes.new("ShaderNodeVectorMath")
    product.operation = "MULTIPLY"
    tree.links.new(colour, product.inputs[0])
    tree.links.new(factor.outputs[0], product.inputs[1])
    return product.outputs[0]
