"""Shapes built from Blender's primitives and modifiers; every function gives a new object at the origin.

Lengths in metres, Z up, front towards -y. Parts that touch are fused by a voxel remesh, so that
the truth is one closed surface without hidden walls inside.
"""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import bmesh
import bpy
import numpy as np
from mathutils import Matrix, Vector

Point = tuple[float, float, float]


def monkey() -> Any:
    """Suzanne's head, 2.7 m from ear to ear, subdivided and closed."""
    return _smoothed(
        _object("monkey", lambda mesh: bmesh.ops.create_monkey(mesh)), subdivision=3, voxel=0.012
    )


def bust() -> Any:
    """Suzanne's head on a neck and a rounded base."""

    def fill(mesh: Any) -> None:
        bmesh.ops.create_monkey(mesh)
        _ball(mesh, (0, 0.25, -1.0), radii=(0.42, 0.42, 0.85))
        _ball(mesh, (0, 0.2, -1.75), radii=(0.85, 0.75, 0.22))

    return _smoothed(_object("bust", fill), subdivision=3, voxel=0.014, smoothing=6)


def chair() -> Any:
    """A chair of thin rods: legs, stretchers, a slatted seat and back; rods of 17 mm radius."""
    front, back, side = -0.22, 0.22, 0.21
    rods: list[tuple[Point, Point]] = [
        ((x, y, 0.0), (x, y, 0.45 if y < 0 else 0.98)) for x in (-side, side) for y in (front, back)
    ]
    rods += [((x, front, 0.15), (x, back, 0.15)) for x in (-side, side)]
    rods += [((-side, y, 0.22), (side, y, 0.22)) for y in (front, back)]
    rods += [((x, front, 0.45), (x, back, 0.45)) for x in np.linspace(-side, side, 7)]
    rods += [((-side, y, 0.45), (side, y, 0.45)) for y in (front, back)]
    rods += [((-side, back, z), (side, back, z)) for z in (0.66, 0.96)]
    rods += [((x, back, 0.66), (x, back, 0.96)) for x in np.linspace(-side, side, 6)[1:-1]]

    def fill(mesh: Any) -> None:
        for start, end in rods:
            _rod(mesh, start, end, radius=0.017)
            for joint in (start, end):
                _ball(mesh, joint, radii=(0.019, 0.019, 0.019))

    return _smoothed(_object("chair", fill), subdivision=0, voxel=0.004)


def double_torus() -> Any:
    """Two fused rings standing upright: genus 2."""

    def fill(mesh: Any) -> None:
        for x in (-0.72, 0.72):
            _torus(
                mesh, Matrix.Translation((x, 0, 0)) @ Matrix.Rotation(np.pi / 2, 4, "X"), radii=(0.62, 0.26)
            )

    return _smoothed(_object("double torus", fill), subdivision=0, voxel=0.02, smoothing=12)


def calf() -> Any:
    """A rounded animal of spheres: body, four legs, head, ears, tail."""
    balls: list[tuple[Point, Point]] = [
        ((0, 0.35, 0.75), (0.44, 0.62, 0.42)),
        ((0, -0.2, 0.85), (0.38, 0.42, 0.38)),
        ((0, -0.62, 1.2), (0.3, 0.34, 0.29)),
        ((0, -0.88, 1.1), (0.2, 0.2, 0.17)),
        ((0, -0.42, 1.0), (0.25, 0.3, 0.3)),
        ((0, 0.98, 0.78), (0.07, 0.2, 0.07)),
    ]
    balls += [((x, y, 0.3), (0.15, 0.16, 0.34)) for x in (-0.24, 0.24) for y in (-0.2, 0.68)]
    balls += [((x, -0.52, 1.46), (0.12, 0.07, 0.14)) for x in (-0.24, 0.24)]

    def fill(mesh: Any) -> None:
        for centre, radii in balls:
            _ball(mesh, centre, radii=radii)

    return _smoothed(_object("calf", fill), subdivision=0, voxel=0.012, smoothing=25)


def house() -> Any:
    """A house of flat faces, 2.6 m wide: walls, a hipped roof with eaves, a chimney, a door in front."""
    boxes: list[tuple[Point, Point]] = [
        ((0, 0, 0.4), (1.4, 1.0, 0.8)),
        ((0.4, 0.1, 1.15), (0.16, 0.16, 0.5)),
        ((0, -0.52, 0.22), (0.26, 0.14, 0.44)),
    ]
    square = Matrix.Rotation(np.pi / 4, 4, "Z")
    roof = Matrix.Translation((0, 0, 1.05)) @ Matrix.Diagonal((1.15, 0.85, 1, 1)) @ square

    def fill(mesh: Any) -> None:
        for centre, size in boxes:
            place = Matrix.Translation(centre) @ Matrix.Diagonal((*size, 1.0))
            bmesh.ops.create_cube(mesh, size=1.0, matrix=place)
        bmesh.ops.create_cone(
            mesh, cap_ends=True, segments=4, radius1=1.15, radius2=0.0, depth=0.6, matrix=roof
        )

    return _smoothed(_object("house", fill), subdivision=0, voxel=0.01, smoothing=1)


def vase() -> Any:
    """A closed vase, 0.3 m high: a turned profile."""
    heights = np.linspace(0.0, 0.3, 40)
    radii = 0.07 + 0.035 * np.sin(heights / 0.3 * 2 * np.pi - 0.6)

    def fill(mesh: Any) -> None:
        around = np.linspace(0, 2 * np.pi, 64, endpoint=False)
        rings = [
            [mesh.verts.new((r * np.cos(a), r * np.sin(a), z)) for a in around]
            for r, z in zip(radii, heights, strict=True)
        ]
        for below, above in pairwise(rings):
            for i in range(64):
                j = (i + 1) % 64
                mesh.faces.new((below[i], below[j], above[j], above[i]))
        mesh.faces.new(rings[0][::-1])
        mesh.faces.new(rings[-1])

    return _smoothed(_object("vase", fill), subdivision=0, voxel=0.003)


def block(size: tuple[float, float, float], *, bevel: float) -> Callable[[], Any]:
    """A box with rounded edges that stands on z = 0."""

    def build() -> Any:
        place = Matrix.Translation((0, 0, size[2] / 2)) @ Matrix.Diagonal((*size, 1.0))
        made = _object("block", lambda mesh: bmesh.ops.create_cube(mesh, size=1.0, matrix=place))
        rounding = made.modifiers.new("rounding", "BEVEL")
        rounding.width, rounding.segments = bevel, 5
        return made

    return build


def imported(path: Path, *, turn_deg: float) -> tuple[Any, ...]:
    """The meshes of an OBJ, PLY, STL, GLB or glTF file with the materials it brings, Z up.

    They are turned about the vertical through the origin, counter-clockwise seen from above.

    Raises ValueError for another kind of file or one without a mesh.
    """
    readers = {
        ".obj": bpy.ops.wm.obj_import,
        ".ply": bpy.ops.wm.ply_import,
        ".stl": bpy.ops.wm.stl_import,
        ".glb": bpy.ops.import_scene.gltf,
        ".gltf": bpy.ops.import_scene.gltf,
    }
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ValueError(f"{path.name} is none of the mesh files that can be read: {', '.join(readers)}")
    before = set(bpy.data.objects)
    reader(filepath=str(path))
    new = [made for made in bpy.data.objects if made not in before]
    meshes = tuple(made for made in new if made.type == "MESH")
    if not meshes:
        raise ValueError(f"{path.name} holds no mesh")
    turn = Matrix.Rotation(np.deg2rad(turn_deg), 4, "Z")
    for root in (made for made in new if made.parent is None):
        root.matrix_world = turn @ root.matrix_world
    return meshes


def _object(name: str, fill: Callable[[Any], object]) -> Any:
    """A smooth-shaded mesh object of what `fill` puts into a bmesh, linked to the scene."""
    building = bmesh.new()
    fill(building)
    mesh = bpy.data.meshes.new(name)
    building.to_mesh(mesh)
    building.free()
    mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), bool))
    made = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(made)
    return made


def _smoothed(made: Any, *, subdivision: int, voxel: float, smoothing: int = 3) -> Any:
    """The object with modifiers that round it, fuse its parts and smooth the voxels' steps away."""
    if subdivision:
        rounding = made.modifiers.new("rounding", "SUBSURF")
        rounding.levels = rounding.render_levels = subdivision
    fusing = made.modifiers.new("fusing", "REMESH")
    fusing.mode, fusing.voxel_size, fusing.use_smooth_shade = "VOXEL", voxel, True
    relaxing = made.modifiers.new("relaxing", "SMOOTH")
    relaxing.factor, relaxing.iterations = 0.5, smoothing
    return made


def _ball(mesh: Any, centre: Point, *, radii: Point) -> None:
    """Adds an ellipsoid along the axes."""
    place = Matrix.Translation(centre) @ Matrix.Diagonal((*radii, 1.0))
    bmesh.ops.create_uvsphere(mesh, u_segments=32, v_segments=20, radius=1.0, matrix=place)


def _rod(mesh: Any, start: Point, end: Point, *, radius: float) -> None:
    """Adds a closed cylinder between two points."""
    axis = Vector(end) - Vector(start)
    place = (
        Matrix.Translation((Vector(start) + Vector(end)) / 2)
        @ axis.to_track_quat("Z", "Y").to_matrix().to_4x4()
    )
    bmesh.ops.create_cone(
        mesh, cap_ends=True, segments=24, radius1=radius, radius2=radius, depth=axis.length, matrix=place
    )


def _torus(mesh: Any, place: Matrix, *, radii: tuple[float, float]) -> None:
    """Adds a ring around the z axis of `place`; radii of the ring and of its tube."""
    large, small = (
        np.linspace(0, 2 * np.pi, 96, endpoint=False),
        np.linspace(0, 2 * np.pi, 40, endpoint=False),
    )
    ring = radii[0] + radii[1] * np.cos(small)
    grid = [
        [
            mesh.verts.new(place @ Vector((r * np.cos(a), r * np.sin(a), z)))
            for r, z in zip(ring, radii[1] * np.sin(small), strict=True)
        ]
        for a in large
    ]
    for i, this in enumerate(grid):
        after = grid[(i + 1) % len(grid)]
        for j in range(len(this)):
            k = (j + 1) % len(this)
            mesh.faces.new((this[j], after[j], after[k], this[k]))
