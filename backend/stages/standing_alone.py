"""Photographs without masks of something that stands whole before an even backdrop: how far it reaches.

Its outline tells that as a mask does, where triangulated points lie only on what has texture.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float64
from scipy.ndimage import label

from ..maths.backdrop import find_backdrop
from ..maths.raycast import camera_rays
from ..scene import View

_LEAST_SHARE = 0.002
"""Of the picture: less is no subject."""


def standing_alone(views: tuple[View, ...]) -> list[View]:
    """Those that show something whole before an even backdrop, with it as their mask."""
    found = [(view, _whole_before_backdrop(view)) for view in views if view.mask is None]
    return [replace(view, mask=mask.astype(np.float32)) for view, mask in found if mask.mean() > _LEAST_SHARE]


def _whole_before_backdrop(view: View) -> Bool[np.ndarray, "height width"]:
    """What surely stands before the backdrop, without what the picture's border cuts: a table, a stand."""
    colours = torch.tensor(view.image_srgb).permute(2, 0, 1)
    everywhere = torch.ones(colours.shape[1:], dtype=torch.bool)
    backdrop = find_backdrop(colours, everywhere)
    if backdrop is None:
        return np.zeros(colours.shape[1:], np.bool_)
    pieces, _ = label(backdrop.subject.numpy())
    at_border = np.concatenate([pieces[0], pieces[-1], pieces[:, 0], pieces[:, -1]])
    whole: Bool[np.ndarray, "height width"] = ~np.isin(pieces, np.append(at_border, 0))
    return whole


def share_cut_off(views: list[View], centre: Float64[np.ndarray, "3"], radius: float) -> float:
    """Of what a mask shows, in the worst view, the share whose rays pass beside a sphere (world frame)."""
    return max((_passing(view, centre, radius) for view in views), default=0.0)


def _passing(view: View, centre: Float64[np.ndarray, "3"], radius: float) -> float:
    assert view.mask is not None
    _, directions = camera_rays(view.camera)
    to_centre = centre - view.camera.position
    nearest = np.linalg.norm(np.cross(directions, to_centre), axis=-1).reshape(view.mask.shape)
    return float((nearest[view.mask > 0.5] > radius).mean())
