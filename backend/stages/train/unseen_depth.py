"""How deep the subject is where no photograph shows it: found by trying."""

from dataclasses import replace

from ...scene import Decision
from ..measurements import Measurements
from .linear_fit import LinearConfig, fit_level, start
from .silhouettes import least_distance, missing, silhouette_rays, uncontradicted
from .unseen_side import (
    DEEPEST,
    depth_is_bounded,
    explained_radius,
    is_all_around,
    seen_depth,
    widest_view_angle_deg,
)

_NODES = 48
_ROUNDS = 6
"""Of each trial."""
_MENDED = 0.035
"""Share of the rays through the subject that may be missed so: the pull of silhouettes mends as many. A
deeper ball than needed is worse than that, most of all for what is not seen."""
_GROWTH = 1.2
"""From one trial to the next."""
_MARGIN = 1.4
"""How much deeper than the least that silhouettes ask for."""


def depth_behind(scene: Measurements, config: LinearConfig) -> tuple[float, Decision]:
    """Radius of the ball behind, in half widths of the subject, and what decided it."""
    if config.ball is not None:
        return config.ball, _decision(config.ball, "the preset")
    explained, seen = explained_radius(scene), seen_depth(scene)
    met = _met_radius(scene, explained, config)
    radius = max(met, seen)
    angle_deg = widest_view_angle_deg(scene)
    because = f"the photographs are taken from sides up to {angle_deg:.0f} degrees apart"
    if met == radius > explained:
        because += f"; with the {explained:.2f} that measured points ask for, silhouettes were missed"
    elif radius > explained:
        because += "; so deep is what was measured, and no less is assumed of the other side"
    elif not is_all_around(scene):
        because += "; so turn the normals of the measured points"
    return radius, _decision(radius, because)


def _decision(radius: float, because: str) -> Decision:
    choice = f"a ball of {radius:.2f} half widths of the subject behind what was measured"
    return Decision(what="depth of the unseen side", choice=choice, because=because)


def _met_radius(scene: Measurements, explained: float, config: LinearConfig) -> float:
    """The radius from `explained` on with which silhouettes are met of their own accord.

    Rays through the subject that miss a surface fitted without them say that it goes on, farther back. Where
    silhouettes bound the depth there is nothing to find out.
    """
    if depth_is_bounded(scene) == 1:
        return explained
    rays = uncontradicted(silhouette_rays(scene, _NODES), least_distance(scene, _NODES))
    if not len(rays.origins):
        return explained
    alone = replace(config, silhouettes=0.0)

    def num_missed(radius: float) -> int:
        trial = fit_level(scene, start(scene, radius, _NODES), radius, _ROUNDS, alone)
        return int(missing(rays, trial).sum())

    unavoidable = num_missed(DEEPEST)
    if num_missed(explained) - unavoidable <= _MENDED * len(rays.origins):
        return explained
    radius, tolerated = _GROWTH * explained, 1.1 * unavoidable + 3
    while radius < DEEPEST and num_missed(radius) > tolerated:
        radius *= _GROWTH
    return min(_MARGIN * radius, DEEPEST)
