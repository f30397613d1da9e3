"""Presets with one part changed, as data."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from ..presets import PRESETS, Settings
from ..stages.train.unseen_side import LEAST_RADIUS

_STEPS: Mapping[str, object] = {"train.steps": (0, 0, 100)}
_SHORT: Mapping[str, object] = {"train.steps": 400}
"""Of the network's 2000: then the course of its rates is a fifth as long, not cut off."""
_NEXT_TO_NOTHING = 1e-6
"""For weights of the linear fit that replace the prior's: at 0 a node would have none, and no value."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A preset with one part changed."""

    name: str
    changes: Mapping[str, object] = field(default_factory=dict)
    """Of settings, by their dotted names; more than one where a part has several."""
    preset: str = "balanced"
    with_masks: bool = True
    """Without them the region stays the one that they gave."""
    cameras_doubted: bool = False
    """Whether the cameras, though they are given, are held against the surface."""

    @property
    def settings(self) -> Settings:
        """The preset's with the changes. AttributeError or TypeError where there is no such setting."""
        settings: Any = PRESETS[self.preset]
        for name, value in self.changes.items():
            settings = _changed(settings, name, value)
        made: Settings = settings
        return made


def _changed(settings: Any, name: str, value: object) -> Any:
    first, _, rest = name.partition(".")
    return replace(settings, **{first: _changed(getattr(settings, first), rest, value) if rest else value})


VARIANTS = (
    Variant(name="as it is"),
    # what stereo points are, and what they weigh
    Variant(name="without a second sweep", changes={"stereo.sweep_again": False}),
    Variant(name="without leaning planes", changes={"stereo.lean": 0.0}),
    Variant(name="without growth", changes={"stereo.growth_rounds": (0, 0, 0)}),
    Variant(name="without semi-global matching", changes={"stereo.semi_global": False}),
    Variant(
        name="full size alone",
        changes={"stereo.trust_of_half_size": 0.0, "stereo.trust_if_textured": 0.0},
    ),
    Variant(name="small pieces kept", changes={"stereo.min_piece_px": 0}),
    Variant(name="sharpness ignored", changes={"stereo.full_sharpness": _NEXT_TO_NOTHING}),
    Variant(name="edges ignored", changes={"stereo.edge_doubt": _NEXT_TO_NOTHING}),
    Variant(
        name="confidence itself",
        changes={"train.linear.confidence_power": 1.0, "train.linear.power_if_textured": 1.0},
    ),
    Variant(
        name="all points alike",
        changes={"train.linear.confidence_power": 0.0, "train.linear.power_if_textured": 0.0},
    ),
    Variant(name="textured as plain", changes={"train.linear.power_if_textured": 3.0}),
    Variant(name="sums instead of means", changes={"train.linear.correlated": False}),
    Variant(name="points speak 0.7 cells far", changes={"train.linear.spread_cells": 0.7}),
    Variant(name="points speak 1.4 cells far", changes={"train.linear.spread_cells": 1.4}),
    # silhouettes, free space, and what nobody sees
    Variant(name="without rims", changes={"train.linear.rims": 0.0}),
    Variant(name="without the pull of silhouettes", changes={"train.linear.silhouettes": 0.0}),
    Variant(
        name="without free space off silhouettes",
        changes={"train.linear.free_space": _NEXT_TO_NOTHING},
    ),
    Variant(
        name="without carving by measured depth",
        changes={"train.linear.seen_through": _NEXT_TO_NOTHING},
    ),
    Variant(name="without outlines inside the subject", changes={"train.linear.inner_outlines": False}),
    Variant(name="without flat faces", changes={"train.linear.flat_faces": False}),
    Variant(name="without brightness", changes={"train.linear.brightness": 0.0}),
    Variant(name="what shines taken as matt", changes={"train.linear.may_shine": False}),
    Variant(
        name="without any free space",
        changes={
            "train.linear.free_space": _NEXT_TO_NOTHING,
            "train.linear.seen_through": _NEXT_TO_NOTHING,
        },
    ),
    Variant(
        name="silhouettes not fitted",
        changes={
            "train.linear.rims": 0.0,
            "train.linear.silhouettes": 0.0,
            "train.linear.free_space": _NEXT_TO_NOTHING,
        },
    ),
    Variant(name="masks ignored", with_masks=False),
    Variant(name="the least ball behind", changes={"train.linear.ball": LEAST_RADIUS}),
    # grids and their rounds
    Variant(
        name="the finest grid alone",
        changes={"train.levels": (128,), "train.rounds": (40,), "train.steps": (0,)},
    ),
    Variant(name="all rounds", changes={"train.linear.settled": 0.0}),
    Variant(name="five rounds", changes={"train.rounds": (5, 5, 5)}),
    Variant(name="with 100 steps of rendering", changes=_STEPS),
    Variant(
        name="with 100 steps, Taylor residual at queries alone",
        changes={**_STEPS, "train.render.at_point": 0.0},
    ),
    Variant(
        name="with 100 steps, Taylor residual at points alone",
        changes={**_STEPS, "train.render.at_query": 0.0},
    ),
    # the mesh, and cameras
    Variant(name="floating pieces kept", changes={"mesh.smallest_piece": 0.0}),
    Variant(name="without detail", changes={"train.detail": 0}),
    Variant(name="colours of vertices alone", changes={"mesh.textured": False}),
    Variant(name="exposures not looked at", changes={"mesh.exposures_evened": False}),
    Variant(name="cameras held against the surface", cameras_doubted=True),
    # what `fast` alone has
    Variant(name="fast, as it is", preset="fast"),
    Variant(name="fast, leverage ignored", changes={"stereo.free_leverage": None}, preset="fast"),
    Variant(
        name="fast, without outlines inside the subject",
        changes={"train.linear.inner_outlines": False},
        preset="fast",
    ),
    Variant(name="fast, without brightness", changes={"train.linear.brightness": 0.0}, preset="fast"),
    Variant(name="fast, what shines taken as matt", changes={"train.linear.may_shine": False}, preset="fast"),
    Variant(name="fast at full size", changes={"stereo.first_pixel_size": 1}, preset="fast"),
    # what SparseCraft asks of points
    Variant(name="sparsecraft, 400 steps", changes=_SHORT, preset="sparsecraft"),
    Variant(
        name="sparsecraft, Taylor residual at queries alone",
        changes={**_SHORT, "train.weights.at_point": 0.0},
        preset="sparsecraft",
    ),
    Variant(
        name="sparsecraft, Taylor residual at points alone",
        changes={**_SHORT, "train.weights.at_query": 0.0},
        preset="sparsecraft",
    ),
    Variant(
        name="sparsecraft, without colour at points",
        changes={**_SHORT, "train.weights.point_colours": 0.0},
        preset="sparsecraft",
    ),
    Variant(
        name="sparsecraft, without points",
        changes={**_SHORT, "train.weights.points": 0.0},
        preset="sparsecraft",
    ),
)
