"""Photographs that agree on next to nothing: where they have masks, outlines alone give the shape.

Photographs a fifth of a circle apart share no patch that looks alike, and chrome or glass shows none twice.
Their silhouettes still bound the subject: what is left is its visual hull, made smooth.
"""

from dataclasses import replace

import numpy as np

from ...errors import ErrorCode, ReconstructionError
from ...scene import Decision, Region, StereoResult, SurfacePoints, View

FEWEST_POINTS = 100
"""With fewer, what agreed did so by chance."""
FEWEST_OUTLINES = 3
"""Two leave a box."""
_MOST_OF_EDGE = 0.5
"""Of a picture's edge that may show the subject: more is a mask of what is around it."""
_OTHER_REGION = (
    "Give a larger region in the frame of the cameras, or leave it out. Where it does hold the subject: "
)


def check_enough(points: SurfacePoints, views: tuple[View, ...], region: Region) -> None:
    """Raises ReconstructionError(NO_SURFACE) where neither points nor outlines tell the shape."""
    told = sum(map(_shows_outline, views)) >= FEWEST_OUTLINES
    if told or len(points.positions) >= FEWEST_POINTS:
        return
    masked = any(view.mask is not None for view in views)
    about_masks = " Check that the masks are white on the subject and belong to these photographs."
    raise ReconstructionError(
        ErrorCode.NO_SURFACE,
        f"{_agreement(region)} only {len(points.positions)} points of the surface.",
        f"{_OTHER_REGION * region.given}"
        "Take photographs that overlap by more than half, sharp and evenly lit; shiny, transparent "
        "or plain surfaces need masks, or some texture such as dust or chalk."
        f"{about_masks * masked}",
    )


def _agreement(region: Region) -> str:
    """The beginning of a sentence that ends in how little it is: a region of the user's may be to blame."""
    if not region.given:
        return "The photographs agree on"
    where = ", ".join(f"{value:g}" for value in region.centre_world)
    sphere = f"of radius {region.radius_world:g} around ({where})"
    return f"In the region that was given, {sphere}, the photographs agree on"


def _shows_outline(view: View) -> bool:
    """Whether there is a mask, and of something that the picture shows whole, mostly."""
    if view.mask is None:
        return False
    edge = np.ones(view.mask.shape, np.bool_)
    edge[1:-1, 1:-1] = False
    return bool((view.mask[edge] > 0.5).mean() <= _MOST_OF_EDGE)


def no_points() -> SurfacePoints:
    """None at all."""
    none, nothing = np.zeros((0, 3), np.float32), np.zeros(0, np.int64)
    return SurfacePoints(
        positions=none,
        normals=none,
        colours_srgb=none,
        confidence=none[:, 0],
        num_views=nothing,
        view_index=nothing,
    )


def outlines_alone(found: StereoResult) -> StereoResult:
    """What stereo found by chance left out; where backdrop and subject are stays known."""
    decision = Decision(
        what="measured points",
        choice="left out: outlines alone give the shape",
        because=f"the photographs agree on only {len(found.points.positions)} points",
    )
    maps = tuple(map_.measured_where(np.zeros_like(map_.depth, np.bool_)) for map_ in found.depth_maps)
    return replace(found, points=no_points(), depth_maps=maps, decisions=(*found.decisions, decision))


def hollows_filled(stereo: StereoResult, region: Region) -> str | None:
    """For a person, where photographs were compared: what the shape lacks, and what helps; else None."""
    if len(stereo.points.positions):
        return None
    return (
        f"{_agreement(region)} next to nothing, so the shape comes from the outlines of the masks alone: "
        f"hollows are filled, and what no outline shows is a guess. {_OTHER_REGION * region.given}"
        "Photographs 10 to 20 degrees apart, or some texture such as dust or chalk, would show more."
    )
