"""How a result's colours, its support and its error are shown in the viewport and in renders.

A mesh has one colour attribute per way of showing it. Solid mode and the material both follow the active
one: the material's node has no layer name, which means the attribute that is marked for rendering. A texture
takes the place of the mesh's own colours, which are as fine as its vertices, for as long as it has a UV map.
"""

from typing import Literal

import bpy
import numpy as np

from .camera_objects import ROLE
from .heat_map import ERROR, SUPPORT, HeatMap, heat_colours

COLOUR = "Color"
"""Name of the colour attribute that a result comes with."""
Kind = Literal["COLOUR", "SUPPORT", "ERROR"]
"""What a mesh can show."""
_HEAT_MAPS: dict[Kind, HeatMap] = {"SUPPORT": SUPPORT, "ERROR": ERROR}
UV_MAP = "FewView"
"""Name of the UV map of a result's texture."""
_ATTRIBUTE, _TEXTURE = "colours", "texture"
"""Values of `fewview_role`, of the two nodes that a result's colours may come from."""
_MISSING: dict[Kind, str] = {
    "COLOUR": "This mesh has no colors: import the result again",
    "SUPPORT": "This mesh does not know its support: import the result again",
    "ERROR": "The error is not known yet: press Measure Error first",
}


def make_material(
    name: str, mean_linear: tuple[float, float, float], texture: bpy.types.Image | None
) -> bpy.types.Material:
    """A rough material without highlights that shows what `show` says."""
    material = bpy.data.materials.new(name)
    if material.node_tree is None:  # from 5.0 on there is one from the start
        material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    output = nodes.new("ShaderNodeOutputMaterial")
    surface = nodes.new("ShaderNodeBsdfPrincipled")
    colours = nodes.new("ShaderNodeVertexColor")
    colours.layer_name, colours[ROLE] = "", _ATTRIBUTE
    surface.inputs["Roughness"].default_value = 1.0
    surface.inputs["Specular IOR Level"].default_value = 0.0
    links.new(colours.outputs["Color"], surface.inputs["Base Color"])
    links.new(surface.outputs["BSDF"], output.inputs["Surface"])
    surface.location, output.location, colours.location = (0, 0), (300, 0), (-220, 0)
    if texture is not None:
        picture = nodes.new("ShaderNodeTexImage")
        picture.image, picture.extension, picture[ROLE] = texture, "EXTEND", _TEXTURE
        where = nodes.new("ShaderNodeUVMap")
        where.uv_map = UV_MAP
        links.new(where.outputs["UV"], picture.inputs["Vector"])
        picture.location, where.location = (-300, 200), (-500, 200)
        nodes.active = picture  # what solid mode draws
    material.diffuse_color = (*mean_linear, 1.0)
    material.roughness, material.specular_intensity = 1.0, 0.0
    return material


def can_show(mesh: bpy.types.Mesh, kind: Kind) -> bool:
    """Whether the mesh has what `kind` shows."""
    if kind == "COLOUR":
        return _colours_or_none(mesh, COLOUR) is not None
    return _values_or_none(mesh, _HEAT_MAPS[kind]) is not None


def shown(mesh: bpy.types.Mesh) -> Kind | None:
    """What the mesh shows; None for an attribute of the user's own."""
    active = mesh.color_attributes.active_color
    names: dict[str, Kind] = {COLOUR: "COLOUR", **{heat.colours: kind for kind, heat in _HEAT_MAPS.items()}}
    return None if active is None else names.get(active.name)


def legend(mesh: bpy.types.Mesh) -> str:
    """What the colours mean that the mesh shows, in a line; empty for its own colours."""
    kind = shown(mesh)
    return "" if kind is None or kind == "COLOUR" else _HEAT_MAPS[kind].legend


def show(mesh: bpy.types.Mesh, kind: Kind) -> None:
    """Show the mesh's own colours, its support or its error, in the viewport and in renders.

    Raises ValueError, in a sentence for the user, where the mesh has no such values or is being edited.
    """
    if mesh.is_editmode:
        raise ValueError("The mesh is being edited: leave Edit Mode first")
    if not can_show(mesh, kind):
        raise ValueError(_MISSING[kind])
    name = COLOUR if kind == "COLOUR" else _draw(mesh, _HEAT_MAPS[kind])
    index = mesh.color_attributes.find(name)
    mesh.color_attributes.active_color_index = index
    mesh.color_attributes.render_color_index = index
    _choose_node(mesh)
    mesh.update_tag()


def shows_texture(mesh: bpy.types.Mesh) -> bool:
    """Whether what the mesh shows is a texture."""
    return shown(mesh) == "COLOUR" and texture_or_none(mesh) is not None


def texture_or_none(mesh: bpy.types.Mesh) -> bpy.types.Image | None:
    """The picture of a mesh with a UV map for it."""
    if UV_MAP not in mesh.uv_layers:
        return None
    nodes = (_node_or_none(material, _TEXTURE) for material in mesh.materials)
    return next((node.image for node in nodes if node is not None and node.image is not None), None)


def show_in_viewports(mesh: bpy.types.Mesh) -> None:
    """Have solid mode show what the mesh shows, in 3D viewports that do not show something of their own."""
    wanted = "TEXTURE" if shows_texture(mesh) else "VERTEX"
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                shading = area.spaces.active.shading
                if shading.color_type in ("MATERIAL", "VERTEX", "TEXTURE"):
                    shading.color_type = wanted


def _choose_node(mesh: bpy.types.Mesh) -> None:
    """Connect the texture, or the colour attribute, in materials that still have both as they were made."""
    for material in mesh.materials:
        picture, colours = _node_or_none(material, _TEXTURE), _node_or_none(material, _ATTRIBUTE)
        if picture is None or colours is None:
            continue
        wanted, other = (picture, colours) if shows_texture(mesh) else (colours, picture)
        for link in list(material.node_tree.links):
            if link.from_node == other:
                material.node_tree.links.new(wanted.outputs["Color"], link.to_socket)


def _node_or_none(material: bpy.types.Material | None, role: str) -> bpy.types.Node | None:
    """The node of a result's material with this value of `fewview_role`."""
    if material is None or material.node_tree is None:
        return None
    return next((node for node in material.node_tree.nodes if node.get(ROLE) == role), None)


def _draw(mesh: bpy.types.Mesh, heat: HeatMap) -> str:
    """Colour the mesh by an attribute; the name of the colour attribute."""
    found = _values_or_none(mesh, heat)
    assert found is not None
    values = np.empty(len(found.data), np.float32)
    found.data.foreach_get("value", values)
    colours = _colours_or_none(mesh, heat.colours)
    if colours is None:
        colours = mesh.color_attributes.new(heat.colours, "BYTE_COLOR", "POINT")
    colours.data.foreach_set("color_srgb", heat_colours(heat, values).ravel())
    return str(colours.name)


def _values_or_none(mesh: bpy.types.Mesh, heat: HeatMap) -> bpy.types.Attribute | None:
    found = mesh.attributes.get(heat.attribute)
    if found is None or found.data_type != "FLOAT" or found.domain != "POINT":
        return None
    return found


def _colours_or_none(mesh: bpy.types.Mesh, name: str) -> bpy.types.Attribute | None:
    found = mesh.color_attributes.get(name)
    return found if found is not None and found.domain == "POINT" else None
