"""Where some photographs have masks and others have none: what the bare ones measured around the subject.

It is the subject's only where masks have it: its own surface lies on every mask that shows its place. What
surrounds the subject would else become surface wherever no photograph with a mask shows that place.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64

from ...maths.beside_mask import FEWEST_MASKS, from_mask_px, on_and_beside_mask
from ...maths.geometry import pinhole_in_object, seen_places
from ...scene import Camera, Decision, Region, StereoResult, View, transform_points


def only_on_masks(stereo: StereoResult, views: tuple[View, ...], region: Region) -> StereoResult:
    """Of what views without masks measured, that which lies on the masks of the others, with a decision.

    As it is where all views have masks, or fewer than two. The views' cameras are those of the depth maps.
    """
    bare = np.array([view.mask is None for view in views])
    if not bare.any() or (~bare).sum() < FEWEST_MASKS:
        return stereo
    masked = [(view.camera, from_mask_px(view.mask)) for view in views if view.mask is not None]
    points = stereo.points
    kept = ~bare[points.view_index]
    kept[~kept] = _on_masks(points.positions[~kept], masked, region)
    maps = list(stereo.depth_maps)
    for index in np.flatnonzero(bare):
        camera = pinhole_in_object(views[index].camera, region, torch.device("cpu"))
        places = seen_places(camera, torch.from_numpy(maps[index].depth)).numpy()
        on = np.zeros(places.shape[:2], np.bool_)
        known = maps[index].depth > 0
        on[known] = _on_masks(places[known], masked, region)
        maps[index] = maps[index].measured_where(on)
    decision = Decision(
        what="photographs without masks",
        choice=f"{int((~kept).sum())} of {len(kept)} points left out",
        because=f"they do not lie on the masks of the {len(masked)} others",
    )
    return replace(
        stereo,
        points=points.chosen(kept),
        depth_maps=tuple(maps),
        decisions=(*stereo.decisions, decision),
    )


def _on_masks(
    positions: Float[np.ndarray, "points 3"],
    masked: Sequence[tuple[Camera, Float64[np.ndarray, "_ _"]]],
    region: Region,
) -> Bool[np.ndarray, "points"]:
    """Whether places, object frame, lie on all masks that show them, and on two at least.

    `masked` are cameras with the distances from their masks.
    """
    places = transform_points(region.world_from_object, positions.astype(np.float64))
    on, beside = np.stack([on_and_beside_mask(*one, places) for one in masked], axis=1)
    return np.asarray((on.sum(axis=0) >= FEWEST_MASKS) & ~beside.any(axis=0))
