"""Photographs without masks of something that stands whole before an even backdrop: how far it reaches.

Its outline tells that as a mask does, where triangulated points lie only on what has texture.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool

from ..maths.backdrop import find_backdrop
from ..maths.geometry import pinhole_in_object
from ..maths.pieces import whole_pieces
from ..scene import Region, View
from .stereo.windows import sees_region

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
    whole: Bool[np.ndarray, "height width"] = whole_pieces(backdrop.subject.numpy()) > 0
    return whole


def share_cut_off(views: list[View], region: Region) -> float:
    """Of what a mask shows, in the worst view, the share whose rays pass beside the region."""
    return max((_passing(view, region) for view in views), default=0.0)


def _passing(view: View, region: Region) -> float:
    assert view.mask is not None
    meets = sees_region(pinhole_in_object(view.camera, region, torch.device("cpu"))).numpy()
    return float(1 - meets[view.mask > 0.5].mean())
