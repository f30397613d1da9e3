"""Colours of the mesh's vertices from the photographs, and whether these were exposed alike."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from ...maths.exposure import disagreement, evened, log_exposures
from ...maths.nearest import nearest_tree
from ...maths.sampling import colours_at
from ...maths.srgb import linear_from_srgb
from ...scene import Camera, Decision, View

_WHAT = "exposure of each photograph"
_LEAST_STOPS = 0.05
"""Photographs that differ by less show no seam: 1.6 % of full brightness at mid grey."""
_LARGEST_SHARE_LEFT = 0.9
"""Of the disagreement between photographs: where more is left, it was not exposure that made it."""
_NEITHER_BLACK_NOR_WHITE = (0.04, 0.96)
"""sRGB values that tell of exposure."""
_MOST_VERTICES = 20_000
"""That exposures are found from, evenly over all: medians over more are the same."""
_SURE_SHARE = 0.1
"""Weight of a vertex in a photograph from which on it tells of exposure: seen at 55 degrees, or not all on
the subject."""


@dataclass(frozen=True, kw_only=True)
class VertexColours:
    """What the photographs say of the vertices."""

    colours_srgb: UInt8[np.ndarray, "vertices 3"]
    log_exposures: Float64[np.ndarray, "views 3"]
    """Natural logarithms that each photograph's channels were corrected by; 0 where they were left."""
    decision: Decision


def colour_vertices(
    vertices: Float64[np.ndarray, "vertices 3"],
    normals: Float64[np.ndarray, "vertices 3"],
    seen: Bool[np.ndarray, "vertices views"],
    views: tuple[View, ...],
    *,
    exposures_evened: bool = True,
) -> VertexColours:
    """Mean of the photographs that see a vertex, those that see it frontally first; others from around.

    Photographs of other exposure or white balance are brought to the mean of all first, if there are such and
    it is asked for.
    """
    srgb = np.zeros((len(views), len(vertices), 3))
    share = np.zeros((len(views), len(vertices)))
    for index, view in enumerate(views):
        mine = np.flatnonzero(seen[:, index])
        sampled = colours_at(view, vertices[mine])
        frontal = frontal_share(vertices[mine], normals[mine], view.camera)
        share[index, mine] = frontal * on_subject(sampled[:, 3])
        srgb[index, mine] = sampled[:, :3]
    exposures, decision = _exposures(srgb, share) if exposures_evened else _not_asked(len(views))
    srgb = evened(srgb, exposures)
    weight = share.sum(axis=0)
    known = weight > 0
    colours = (share[..., None] * srgb).sum(axis=0) / np.where(known, weight, 1.0)[:, None]
    if known.any() and not known.all():
        distance, nearest = nearest_tree(vertices[known]).query(vertices[~known], k=min(16, int(known.sum())))
        near = 1 / (np.atleast_2d(distance.T).T + 1e-3 * np.ptp(vertices, axis=0).max())
        mixed = (near[..., None] * colours[known][np.atleast_2d(nearest.T).T]).sum(axis=1)
        colours[~known] = mixed / near.sum(axis=1, keepdims=True)
    rounded = np.clip(colours * 255 + 0.5, 0, 255).astype(np.uint8)
    return VertexColours(colours_srgb=rounded, log_exposures=exposures, decision=decision)


def on_subject(mask: Float64[np.ndarray, "*places"]) -> Float64[np.ndarray, "*places"]:
    """How much a pixel counts by its mask: half off the subject, it has half the backdrop's colour."""
    return np.where(mask > 0.5, mask**4, 0.0)


def frontal_share(
    vertices: Float64[np.ndarray, "vertices 3"], normals: Float64[np.ndarray, "vertices 3"], camera: Camera
) -> Float64[np.ndarray, "vertices"]:
    """How much a camera's photograph counts where it sees a vertex: the fourth power of the cosine."""
    towards = camera.position - vertices
    facing = (towards * normals).sum(axis=1) / np.linalg.norm(towards, axis=1)
    return np.asarray(np.clip(facing, 1e-3, 1) ** 4)


def _not_asked(num_views: int) -> tuple[Float64[np.ndarray, "views 3"], Decision]:
    """As `_exposures` where the preset leaves it out."""
    return np.zeros((num_views, 3)), Decision(what=_WHAT, choice="left as it is", because="the preset")


def _exposures(
    srgb: Float64[np.ndarray, "views vertices 3"], share: Float64[np.ndarray, "views vertices"]
) -> tuple[Float64[np.ndarray, "views 3"], Decision]:
    """Natural logarithms to correct each photograph by, for each channel; zeros if it is not worth it."""
    black, white = _NEITHER_BLACK_NOR_WHITE
    stride = max(1, -(-srgb.shape[1] // _MOST_VERTICES))
    srgb, share = srgb[:, ::stride], share[:, ::stride]
    shown = (share > _SURE_SHARE) & ((srgb > black) & (srgb < white)).all(axis=2)
    log_light = np.log(linear_from_srgb(np.maximum(srgb, black)))
    channels = range(3)
    found = np.stack([log_exposures(log_light[..., c], shown) for c in channels], axis=1)
    stops = float(np.abs(found).max()) / math.log(2)
    says = f"photographs differ from their mean by up to {stops:.2f} stops"
    if stops < _LEAST_STOPS:
        return np.zeros_like(found), Decision(what=_WHAT, choice="left as it is", because=says)
    before = max(disagreement(log_light[..., c], shown) for c in channels)
    after = max(disagreement(log_light[..., c] - found[:, c, None], shown) for c in channels)
    says += (
        f"; without that, two of them differ by {math.expm1(after):.1%} instead of {math.expm1(before):.1%}"
    )
    if after > _LARGEST_SHARE_LEFT * before:
        return np.zeros_like(found), Decision(what=_WHAT, choice="left as it is", because=says)
    return found, Decision(what=_WHAT, choice="brought to the mean of all", because=says)
