"""The scenes, as data: what stands where and what it is made of."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mathutils import Matrix

from . import shapes
from .surfaces import FINE, GLOSSY, PLAIN, SPOTS, SURFACES, WOOD, Surface, make_material
from .truth import bounding_sphere, true_mesh

OWN_SURFACE = "own"


@dataclass(frozen=True, kw_only=True)
class Item:
    """One thing in a scene."""

    shape: Callable[[], Any]
    surface: Surface
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_deg: float = 0.0
    """About the vertical, counter-clockwise seen from above."""


@dataclass(frozen=True, kw_only=True)
class Scene:
    """The things to be reconstructed and, where there are any, those around them."""

    name: str
    subjects: tuple[Item, ...]
    surroundings: tuple[Item, ...] = ()
    """None: the backdrop is empty and the pictures get an alpha channel."""
    seed: int = 0
    framing: float = 1.0
    """Size of what the pictures hold, in sizes of the subjects."""


@dataclass(frozen=True, kw_only=True)
class BuiltScene:
    """Blender's objects of a scene."""

    subjects: tuple[Any, ...]
    surroundings: tuple[Any, ...]
    framing: float


def _single(shape: Callable[[], Any], surface: Surface) -> Callable[[str, int], Scene]:
    """A scene of one thing against nothing."""
    return lambda name, seed: Scene(name=name, subjects=(Item(shape=shape, surface=surface),), seed=seed)


def _table(name: str, seed: int) -> Scene:
    """A vase and a block on a table, in a room with boxes standing about; the seed arranges the boxes."""
    brick = Surface(
        colours_linear=((0.1, 0.25, 0.42), (0.5, 0.4, 0.1), (0.45, 0.12, 0.08)),
        patches_per_radius=1.8,
        grain=0.8,
    )
    subjects = (
        Item(shape=shapes.vase, surface=FINE, position_m=(-0.13, 0.02, 0.0)),
        Item(
            shape=shapes.block((0.16, 0.11, 0.2), bevel=0.012),
            surface=brick,
            position_m=(0.11, -0.03, 0.0),
            turn_deg=25.0,
        ),
    )
    top = Item(shape=shapes.block((1.3, 0.9, 0.04), bevel=0.01), surface=WOOD, position_m=(0, 0, -0.04))
    floor = Surface(colours_linear=((0.3, 0.28, 0.26), (0.42, 0.4, 0.36)), patches_per_radius=12, grain=0.6)
    ground = Item(shape=shapes.block((16, 16, 0.1), bevel=0.01), surface=floor, position_m=(0, 0, -0.85))
    return Scene(
        name=name,
        subjects=subjects,
        surroundings=(top, ground, *_boxes_around(seed)),
        seed=seed,
        framing=1.5,
    )


def _boxes_around(seed: int, *, count: int = 22) -> tuple[Item, ...]:
    """Coloured boxes on the floor in a ring around the table, clear of the cameras."""
    rng = np.random.default_rng(seed)
    items = []
    for step in range(count):
        angle = 2 * np.pi * (step + rng.uniform(-0.2, 0.2)) / count
        distance = rng.uniform(3.2, 4.6)
        width, depth, height = rng.uniform((0.4, 0.4, 0.6), (0.9, 0.7, 2.2))
        tint = tuple(float(c) for c in rng.uniform(0.1, 0.55, 3))
        shade = tuple(float(c) for c in rng.uniform(0.1, 0.55, 3))
        items.append(
            Item(
                shape=shapes.block((width, depth, height), bevel=0.02),
                surface=Surface(colours_linear=(tint, shade), grain=0.7),  # type: ignore[arg-type]
                position_m=(distance * np.cos(angle), distance * np.sin(angle), -0.75),
                turn_deg=float(np.rad2deg(angle)),
            )
        )
    return tuple(items)


SCENES: dict[str, Callable[[str, int], Scene]] = {
    "monkey": _single(shapes.monkey, FINE),
    "glossy": _single(shapes.monkey, GLOSSY),
    "plaster": _single(shapes.bust, PLAIN),
    "thin": _single(shapes.chair, FINE),
    "genus2": _single(shapes.double_torus, FINE),
    "spots": _single(shapes.calf, SPOTS),
    "house": _single(shapes.house, SPOTS),
    "table": _table,
}


def build_scene(scene: Scene) -> BuiltScene:
    """Puts the scene's things into Blender's current scene, which should be empty."""
    return BuiltScene(
        subjects=tuple(_build_item(item, scene.seed + i) for i, item in enumerate(scene.subjects)),
        surroundings=tuple(
            _build_item(item, scene.seed + 100 + i) for i, item in enumerate(scene.surroundings)
        ),
        framing=scene.framing,
    )


def build_from_file(path: Path, *, turn_deg: float = 0.0, surface_name: str, seed: int) -> BuiltScene:
    """A mesh file as a scene, with the file's own look or one of `SURFACES`."""
    objects = shapes.imported(path, turn_deg=turn_deg)
    if surface_name != OWN_SURFACE:
        for made in objects:
            _paint(made, SURFACES[surface_name], seed)
    return BuiltScene(subjects=objects, surroundings=(), framing=1.0)


def _build_item(item: Item, seed: int) -> Any:
    made = item.shape()
    made.matrix_world = Matrix.Translation(item.position_m) @ Matrix.Rotation(
        np.deg2rad(item.turn_deg), 4, "Z"
    )
    _paint(made, item.surface, seed)
    return made


def _paint(made: Any, surface: Surface, seed: int) -> None:
    """Replaces the object's materials. The shader works in the object's own coordinates, so unscale."""
    _, radius = bounding_sphere(true_mesh((made,)))
    scale = max(made.matrix_world.to_scale())
    made.data.materials.clear()
    made.data.materials.append(make_material(surface, radius=radius / scale, seed=seed))
