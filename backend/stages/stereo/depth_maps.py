"""Depth maps in the making: swept where images are small, then refined and grown, finer and finer."""

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from ...maths.correlation import window_mean, window_sum
from ...maths.geometry import Pinhole, inside, pixel_centres, project, sample_image, seen_places
from ...maths.inverse_depth import (
    distance_from_edges_px,
    fit_planes,
    lowest_with_neighbours,
    piece_sizes,
)
from ...maths.median import median_3x3
from ...scene import Progress, within
from .config import StereoConfig
from .cross_check import cross_check
from .depths_of_others import unconfirmed, with_depths_of
from .patch_agreement import agreement
from .plane_sweep import (
    UPRIGHT,
    Lean,
    Map,
    better_of,
    inverse_depth_range,
    step_of_one_pixel,
    subject_of,
    sweep,
    swept_again,
)
from .windows import Window, views_between

_LEAST_FOR_A_PLANE = 12
"""Seeds in a window that make its plane worth continuing."""
_AS_GOOD = 0.03
"""Of the correlation: texture that repeats agrees as well behind the region as where it is."""
_UNCONFIRMED = 0.25
"""What a view's agreement counts past one between that sees the place as well and has not found it."""
_LARGEST_STEP_PX = 2.0
"""Of the match, from a pixel to the next, on one surface: a limit of its gradient (Burt & Julesz 1980).

A patch that reaches over a jump is matched by the edge there, and what lies behind gets the depth of what
stands before it. The subject's outline is such an edge, and another place of the surface in every view.
"""


@dataclass(frozen=True, kw_only=True)
class Measured:
    """A depth map at one size, and what of it is a measurement."""

    map: Map
    votes: Float[Tensor, "height width"]
    """How many views agree, the own one counted, perhaps a quarter for another; 0: not measured."""
    sharpness: Float[Tensor, "height width"]
    """How much the agreement of patches drops one pixel of disparity off, to either side."""
    from_edge_px: Float[Tensor, "height width"]
    """Distance to the nearest pixel off the subject or beside a jump of the map; 0 there."""
    trust: Float[Tensor, "height width"]
    """Share of its confidence that is left to it: 1 at the first size."""


def depth_maps(
    pyramids: list[list[Window]], nearby: list[list[int]], config: StereoConfig, progress: Progress
) -> list[list[Measured]]:
    """For each view its maps at the sizes of its pyramid, fine to coarse.

    A coarse map tells only what no finer one does: where texture is weak, patches must be large.
    All views go through a size together, because what two of them agree on is where maps grow from.
    `nearby` names for each view those it is compared with, but for such as show nothing of the region: where
    points lie behind a camera their matches would run through its picture without end.
    """
    showing = [bool(pyramid[0].subject.any()) for pyramid in pyramids]
    nearby = [[other for other in near if showing[other]] for near in nearby]
    top = max(len(pyramid) for pyramid in pyramids) - 1
    maps: list[Map] = []
    by_size: list[list[Measured]] = []
    for level in range(top, -1, -1):
        windows = [pyramid[min(level, len(pyramid) - 1)] for pyramid in pyramids]
        sources = [[windows[n] for n in near] for near in nearby]
        # a size has four times the pixels of the one before: half of the time is the last one's
        tell = within(progress, 0.0 if level == top else 0.5 ** (level + 1), 0.5**level)
        for index, (window, near) in enumerate(zip(windows, sources, strict=True)):
            tell(0.3 * index / len(windows), f"depth of photograph {index + 1}")
            if level == top:
                maps.append(sweep(window, near, config))
            elif maps[index].window is not window:
                maps[index] = _enlarged(maps[index], window)
            # how well patches agree where photographs are smaller says nothing of how they do here
            maps[index] = _refined(maps[index], near, 1.0, config)
            maps[index] = _improved(maps[index], near, [0.5], config)
        if leans := _leans(level, top, config):
            maps = _swept_again(maps, sources, nearby, leans, config, within(tell, 0.3, 0.5))
            if config.lean:
                maps = _told_by_others(maps, sources, nearby, config)
        rounds = config.growth_rounds[min(level, 2)]
        maps = _grown_together(maps, sources, nearby, rounds, config, within(tell, 0.5, 1.0))
        sharp = [
            _improved(map_, near, [0.25, 0.125], config) for map_, near in zip(maps, sources, strict=True)
        ]
        votes = _votes(sharp, nearby, config)
        by_size.insert(0, [_measured(*one, config) for one in zip(sharp, votes, sources, strict=True)])
    return [_each_once(list(sizes), config) for sizes in zip(*by_size, strict=True)]


def _each_once(sizes: list[Measured], config: StereoConfig) -> list[Measured]:
    """Without what a finer size has measured already, and what is left trusted less.

    Least where the finest size had texture enough and yet measured nothing: there is an edge then, or
    something that hides, and a large patch sees past it as little as a small one.
    """
    once, known, halvings = [sizes[0]], sizes[0].votes > 0, 0
    textured = sizes[0].map.window.textured.float()
    for coarse in sizes[1:]:
        if coarse.map.window is once[-1].map.window:
            continue  # the pyramid of another view is higher
        height, width = coarse.votes.shape
        known = F.max_pool2d(known[None, : 2 * height, : 2 * width].float(), 2)[0] > 0
        textured = F.avg_pool2d(textured[None, : 2 * height, : 2 * width], 2)[0]
        halvings += 1
        plain, missed = config.trust_of_half_size**halvings, config.trust_if_textured**halvings
        trust = torch.where(textured > 0.5, missed, plain)
        once.append(replace(coarse, votes=torch.where(known, 0.0, coarse.votes), trust=trust))
        known = known | (coarse.votes > 0)
    return once


def _leans(level: int, top: int, config: StereoConfig) -> list[Lean]:
    """Of the planes that are tried again at a size.

    Those that lean one size before the first, if there is one, for an eighth of the time: there patches see
    twice as much of a face.
    """
    leans = [UPRIGHT] if level == 0 and config.sweep_again else []
    if config.lean and level == min(top, 1):
        leans += [(config.lean, 0.0), (-config.lean, 0.0), (0.0, config.lean), (0.0, -config.lean)]
    return leans


def _swept_again(
    maps: list[Map],
    sources: list[list[Window]],
    nearby: list[list[int]],
    leans: list[Lean],
    config: StereoConfig,
    progress: Progress,
) -> list[Map]:
    """All depths tried again where views agree on nothing."""
    subjects = [subject_of(map_.window) for map_ in maps]
    measured = [votes > 0 for votes in _votes(maps, nearby, config)]
    again = []
    for index, near in enumerate(sources):
        progress(index / len(maps), f"depth of photograph {index + 1}")
        others = [one for i, one in enumerate(subjects) if one is not None and i != index]
        swept = swept_again(maps[index], measured[index], near, others, config, leans)
        again.append(_improved(swept, near, [0.5], config))
    return again


def _told_by_others(
    maps: list[Map], sources: list[list[Window]], nearby: list[list[int]], config: StereoConfig
) -> list[Map]:
    """What other views found tried where views agree on nothing."""
    measured = [votes > 0 for votes in _votes(maps, nearby, config)]
    places = [unconfirmed(map_, known, config) for map_, known in zip(maps, measured, strict=True)]
    told = [
        with_depths_of(maps[index], measured[index], [places[k] for k in near], views, config)
        for index, (near, views) in enumerate(zip(nearby, sources, strict=True))
    ]
    return [_improved(map_, near, [0.5], config) for map_, near in zip(told, sources, strict=True)]


def _grown_together(
    maps: list[Map],
    sources: list[list[Window]],
    nearby: list[list[int]],
    rounds: int,
    config: StereoConfig,
    progress: Progress,
) -> list[Map]:
    """Rounds of growth over all views."""
    for round_ in range(rounds):
        votes = _votes(maps, nearby, config)
        for index, near in enumerate(sources):
            progress((round_ + index / len(maps)) / rounds, f"depth of photograph {index + 1}")
            if near:
                seeds = (votes[index] > 0) & (maps[index].score > config.growth_correlation)
                maps[index] = _grown(maps[index], seeds, near, config)
    return maps


def _grown(
    current: Map, seeds: Bool[Tensor, "height width"], sources: list[Window], config: StereoConfig
) -> Map:
    """Off the seeds, the planes of the seeds beside them where the patches agree better so.

    A sweep over planes that face the camera misses surface that turns away from it, and what it puts there
    is too far off to be refined; but such surface goes on from where its neighbour ends. Propagation of
    slanted planes as in PatchMatch Stereo (Bleyer, Rhemann & Rother 2011), from pixels that are sure alone.
    """
    window, reach = current.window, config.growth_reach_px
    near, far = inverse_depth_range(window.camera)
    radius = config.patch_radius + 1
    planes = fit_planes(current.inverse_depth, seeds * current.score.clamp(min=0) ** 2, radius)
    known = window_sum(seeds.float(), radius) >= _LEAST_FOR_A_PLANE
    planes_beside, known_beside = [], []
    for du, dv in ((0, 0), (reach, 0), (-reach, 0), (0, reach), (0, -reach)):
        value, slope_u, slope_v = _moved(planes, du, dv)
        continued = (value - du * slope_u - dv * slope_v).clamp(far, near)
        known_beside.append(_moved(known, du, dv))
        planes_beside.append(torch.where(known_beside[-1], continued, current.inverse_depth))
    hypotheses = torch.stack(planes_beside)
    asked = window.subject & torch.stack(known_beside).any(dim=0) & ~seeds
    score, index = agreement(window, sources, hypotheses, asked).max(dim=0)
    better = asked & (score > current.score)
    chosen = hypotheses.gather(0, index[None])[0]
    grown = replace(
        current,
        inverse_depth=torch.where(better, chosen, current.inverse_depth),
        score=torch.where(better, score, current.score),
    )
    return _improved(grown, sources, [0.5], config)


def _moved(
    values: Shaped[Tensor, "*batch height width"], du: int, dv: int
) -> Shaped[Tensor, "*batch height width"]:
    """What is du columns to the right and dv rows below each pixel; images are taken as endless."""
    return values.roll((-dv, -du), dims=(-2, -1))


def _improved(current: Map, sources: list[Window], steps_px: list[float], config: StereoConfig) -> Map:
    """Refined by steps of each width, but where patches agreed better before: what is narrow is not flat."""
    for step_px in steps_px:
        current = better_of(current, _refined(current, sources, step_px, config))
    return current


def _refined(current: Map, sources: list[Window], step_px: float, config: StereoConfig) -> Map:
    """The best of five hypotheses, steps of that width apart, around planes fitted to the map so far."""
    if not sources:
        return current
    window = current.window
    near, far = inverse_depth_range(window.camera)
    offsets = torch.arange(-2, 3, device=window.grey.device)[:, None, None]
    middle = _smoothed(current, config.patch_radius)
    step = step_px * step_of_one_pixel(window, sources, middle)
    score = agreement(window, sources, (middle + offsets * step).clamp(far, near), window.subject)
    best = score.max(dim=0).values
    index, offset = lowest_with_neighbours(1 - score.permute(1, 2, 0))
    better = (middle + (index - 2 + offset) * step).clamp(far, near)
    # what no source sees is not moved
    return replace(current, inverse_depth=torch.where(best > -1, better, middle), score=best)


def _sharpness(
    current: Map, step: Float[Tensor, "height width"], sources: list[Window], config: StereoConfig
) -> Float[Tensor, "height width"]:
    """How much less the patches agree a step to either side.

    Next to nothing where an edge runs along the epipolar line, however well the patches agree.
    """
    beside = torch.stack([current.inverse_depth - step, current.inverse_depth, current.inverse_depth + step])
    scores = agreement(current.window, sources, beside, current.window.subject)
    return scores[1] - 0.5 * (scores[0] + scores[2])


def _smoothed(current: Map, radius: int) -> Float[Tensor, "height width"]:
    """Planes fitted to the better half of every neighbourhood; holes are filled from around."""
    median = median_3x3(current.inverse_depth)
    weight = current.score.clamp(min=0.01) ** 2 * current.window.subject
    spread = window_mean((current.inverse_depth - median).abs(), current.window.subject.float(), radius)
    spread = spread.clamp(min=torch.finfo(spread.dtype).tiny)
    weight = weight * torch.exp(-(((current.inverse_depth - median) / (2 * spread)) ** 2))
    value = fit_planes(median, weight, radius)[0]
    return torch.where(window_sum(weight, radius) > 1e-3, value, median)


def _enlarged(current: Map, window: Window) -> Map:
    """The map over the next larger window; sampled at the same places of the scene."""
    pixels = pixel_centres(window.camera.width, window.camera.height, window.grey.device)
    small = current.window.camera
    scale = pixels.new_tensor(
        [small.width / (window.camera.width // 2 * 2), small.height / (window.camera.height // 2 * 2)]
    )
    all_ = torch.stack([current.inverse_depth, current.score, current.behind])
    inverse_depth, score, behind = sample_image(all_, (pixels * scale)[None])[0]
    return Map(window=window, inverse_depth=inverse_depth, score=score, behind=behind)


def _measured(
    current: Map, votes: Float[Tensor, "height width"], sources: list[Window], config: StereoConfig
) -> Measured:
    """What views agree on, where it is sharp, beside no jump, and in a connected piece of surface.

    A few pixels alone agree by chance.
    """
    all_of_it = torch.ones_like(votes)
    if not sources:
        nothing = torch.zeros_like(votes)
        return Measured(map=current, votes=nothing, sharpness=nothing, from_edge_px=nothing, trust=all_of_it)
    step = step_of_one_pixel(current.window, sources, current.inverse_depth)
    sharpness = _sharpness(current, step, sources, config)
    largest_step = _LARGEST_STEP_PX * step
    from_edge_px = distance_from_edges_px(current.inverse_depth, current.window.subject, largest_step)
    votes = torch.where((sharpness > 0) & (from_edge_px > 0), votes, 0.0)
    pieces = piece_sizes(votes.cpu().numpy() > 0, current.inverse_depth.cpu().numpy(), largest_jump=0.01)
    large = torch.tensor(pieces, device=votes.device) >= config.min_piece_px
    return Measured(
        map=current,
        votes=torch.where(large, votes, 0.0),
        sharpness=sharpness,
        from_edge_px=from_edge_px,
        trust=all_of_it,
    )


def _votes(
    maps: list[Map], nearby: list[list[int]], config: StereoConfig
) -> list[Float[Tensor, "height width"]]:
    """For each map how many views agree with its depths."""
    return [_votes_of(index, maps, nearby, config) for index in range(len(maps))]


def _votes_of(
    index: int, maps: list[Map], nearby: list[list[int]], config: StereoConfig
) -> Float[Tensor, "height width"]:
    """How many views agree with each pixel's depth (itself counted), 0 where it is not a measurement.

    What two views see, a view between them sees as well. If it is compared, and has found another depth
    there, the two agree by chance; if it has found none, perhaps.
    """
    own = maps[index]
    points = seen_places(own.window.camera, 1 / own.inverse_depth.clamp(min=1e-6))
    compared = [
        other
        for other in range(len(maps))
        if other in nearby[index] or (other != index and index in nearby[other])
    ]
    said = {
        other: cross_check(
            own.window.camera,
            own.inverse_depth,
            maps[other].window.camera,
            torch.stack([maps[other].inverse_depth, maps[other].score]),
            least_score=config.min_correlation - 0.1,
            largest_px=config.max_reprojection_px,
        )
        for other in compared
    }
    cameras = [map_.window.camera for map_ in maps]
    votes = torch.ones_like(own.inverse_depth)
    past = {other: [k for k in views_between(cameras, index, other) if k in said] for other in said}
    sees = {k: _in_sight(cameras[k], points) for k in set().union(*past.values())}
    for other, (agrees, _) in said.items():
        confirmed, denied, seen = (torch.zeros_like(agrees) for _ in range(3))
        for between in past[other]:
            confirmed |= said[between][0]
            denied |= said[between][1]
            seen |= sees[between]
        vote = torch.where(seen & ~confirmed, _UNCONFIRMED, 1.0)
        votes += vote * (agrees & (confirmed | ~denied))
    enough = (own.behind - _AS_GOOD).clamp(min=config.min_correlation)
    good = own.window.subject & (own.score > enough) & (points.norm(dim=-1) < 1.0)
    return torch.where(good & (votes > 1), votes, 0.0)


def _in_sight(camera: Pinhole, points: Float[Tensor, "height width 3"]) -> Bool[Tensor, "height width"]:
    """Whether points are seen within the picture, hidden or not."""
    at, in_front = project(camera, points)
    return inside(at, camera.width, camera.height) & (in_front > 0)
