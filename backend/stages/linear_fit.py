"""The linear part of the fit: the smoothest field that agrees with points, silhouettes and free space."""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from ..maths.evidence import (
    PointDistances,
    half_cell_px,
    merged_points,
    off_silhouette,
    point_distances,
    seen_through,
)
from ..maths.geometry import Pinhole, project, ray_directions
from ..maths.grid import Corners, locate, node_positions, read, spacing, splat
from ..maths.rays import first_crossing, sphere_entry
from ..maths.smooth_fit import fit_smooth
from .measurements import Measurements
from .rims import RimRays, rim_points, rim_rays

LEAST_RADIUS = 0.3
"""Of the ball behind the surface, in half widths of the subject."""
_FADE = 0.7
"""Share of its pull that a missed ray keeps in the next round: rays that are hit by then let go."""
_RIM_REACH = 0.2
"""How far from a measured point a rim is sure, in units of the grid's frame, if depth is not bounded."""


@dataclass(frozen=True, kw_only=True)
class LinearConfig:
    """Weights beside that of measurements, which is about 1."""

    smoothness: float = 0.1
    """Of the squared Laplacian."""
    free_space: float = 4.0
    """Off silhouettes, where the field says otherwise."""
    seen_through: float = 0.2
    """In front of what was measured, where the field says otherwise."""
    silhouettes: float = 0.2
    """On rays through the subject that miss the field."""
    rims: float = 0.2
    """Where rays through the outline touch the field, if silhouettes bound the depth; else less."""
    prior: float = 1e-3
    """Of the level before, at 32 nodes; more than 0."""


def start(scene: Measurements, nodes: int) -> Float[Tensor, "nodes nodes nodes"]:
    """A field to begin with: the ball behind the surface, cut by what is free."""
    return torch.maximum(_ball_behind(scene, nodes), _free_distance(scene, nodes))


def _ball_behind(scene: Measurements, nodes: int) -> Float[Tensor, "nodes nodes nodes"]:
    """All that is known of backs: (|x - c|^2 - r^2) / 2r of the ball that explains the measured points.

    Least squares of p = c + r n over points and normals: for points all around it is the object's size,
    for points on one side what the turning of their normals says. Where the photographs are taken from
    sides far enough apart for silhouettes to bound the depth, it is as large as the subject is wide.
    """
    weight = (scene.confidence / scene.confidence.sum())[:, None]
    mean_p, mean_n = (weight * scene.positions).sum(dim=0), (weight * scene.normals).sum(dim=0)
    spread = (weight * (scene.normals - mean_n).square()).sum()
    together = (weight * (scene.positions - mean_p) * (scene.normals - mean_n)).sum()
    widest = _half_width(scene, mean_p)
    explained = float((together / spread.clamp(min=1e-6)).clamp(LEAST_RADIUS * widest, widest))
    radius = explained + _depth_is_bounded(scene) * (widest - explained)
    apart = node_positions(nodes, scene.positions.device) - (mean_p - radius * mean_n)
    return (apart.square().sum(dim=-1) - radius * radius) / (2 * radius)


def widest_angle_deg(scene: Measurements) -> float:
    """Largest angle between two cameras, seen from the region's middle."""
    directions = F.normalize(torch.stack([c.position for c in scene.cameras]) - scene.region_centre, dim=-1)
    return math.degrees(math.acos(float((directions @ directions.T).min().clamp(-1, 1))))


def _depth_is_bounded(scene: Measurements) -> float:
    """Whether silhouettes bound the depth: 0 if the photographs are taken from one side, 1 if from many."""
    return min(max((widest_angle_deg(scene) - 50) / 40, 0.0), 1.0)


def _half_width(scene: Measurements, at: Float[Tensor, "3"]) -> float:
    """Largest half extent of the subject across the views, at the distance of a point of it."""
    widths = []
    for camera, outline in zip(scene.cameras, scene.outlines, strict=True):
        if outline is not None:
            rows, columns = torch.nonzero(outline < 0, as_tuple=True)
            middle_r, middle_c = (rows.max() + rows.min()) / 2, (columns.max() + columns.min()) / 2
            reach_px = torch.hypot(rows - middle_r, columns - middle_c).max()
            depth = project(camera, at)[1]
            widths.append(float(reach_px * depth / camera.intrinsics[0, 0]))
    return max(widths) if widths else 0.6 * scene.region_radius


def fit_level(
    scene: Measurements, before: Float[Tensor, "nodes nodes nodes"], rounds: int, config: LinearConfig
) -> Float[Tensor, "nodes nodes nodes"]:
    """The smoothest field near the points' planes that silhouettes allow, else like the level before.

    Smooth is measured against a ball, whose curvature is free. Free space (f > 0) and silhouettes
    (f < 0 somewhere on each ray) are inequalities: they pull only where the field says otherwise, which
    takes a few rounds.
    """
    nodes = before.shape[0]
    h = spacing(nodes)
    points = merged_points(scene.positions, scene.normals, scene.confidence**3, h / 2)
    measured = point_distances(*points, nodes)
    measured_weight = measured.weight.clamp(max=4.0)
    ball = _ball_behind(scene, nodes)
    outside = _free_distance(scene, nodes)
    through = _seen_through_any(scene, nodes, 3 * h)
    missed = torch.zeros((nodes**3, 2), device=before.device)
    rays, nearest = rim_rays(scene, nodes), cKDTree(points[0].cpu().numpy())
    distance = before
    for _ in range(rounds):
        target, weight = before.clone(), torch.full_like(before, config.prior * (32 / nodes) ** 2)
        carved = distance < outside
        target[carved], weight[carved] = outside[carved], config.free_space
        carved = through & (distance < 2 * h)
        target[carved], weight[carved] = 2 * h, config.seen_through
        missed = _FADE * missed + splat(*_missed_silhouettes(scene, distance), nodes)
        rays_near, depths = missed.reshape(*distance.shape, 2).unbind(-1)
        pull = config.silhouettes * rays_near.clamp(max=1.0) * (outside < 0)
        inside = depths / rays_near.clamp(min=1e-6)
        rims = _rim_distances(scene, rays, distance, nearest, config.rims)
        rim_weight = rims.weight.clamp(max=2.0)
        total = weight + measured_weight + pull + rim_weight
        target = weight * target + measured_weight * measured.distance
        target += rim_weight * rims.distance - pull * inside
        distance = ball + fit_smooth(
            target / total - ball, total, distance - ball, smoothness=config.smoothness, steps=30
        )
    return distance


def _rim_distances(
    scene: Measurements,
    rays: RimRays,
    distance: Float[Tensor, "nodes nodes nodes"],
    measured: cKDTree,
    weight: float,
) -> PointDistances:
    """What the rims say of the nodes around them; less, the farther they are from what was measured.

    There only the field's own guess says where a ray touches, unless silhouettes bound the depth.
    """
    positions, normals = rim_points(rays, distance)
    apart, _ = measured.query(positions.cpu().numpy(), workers=-1)
    apart = torch.tensor(apart, dtype=positions.dtype, device=positions.device)
    doubt = (1 - _depth_is_bounded(scene)) * (1 + (apart / _RIM_REACH).square())
    return point_distances(positions, normals, weight * torch.exp(-doubt), distance.shape[0])


def _missed_silhouettes(
    scene: Measurements, distance: Float[Tensor, "nodes nodes nodes"]
) -> tuple[Float[Tensor, "rays 2"], Corners]:
    """Rays through masks that miss the field's inside, and the places where they come nearest to it.

    For each 1, and how deep inside it should be there: as far as from the outline, but not more than a cell.
    """
    nodes = distance.shape[0]
    places, depths = [scene.positions[:0]], [scene.confidence[:0]]
    for camera, outline in zip(scene.cameras, scene.certain, strict=True):
        if outline is None:
            continue
        step = half_cell_px(camera, nodes)
        rows, columns = torch.nonzero(outline[::step, ::step] < -0.5 * step, as_tuple=True)
        pixels = torch.stack([columns, rows], dim=-1) * step + 0.5
        directions = F.normalize(ray_directions(camera, pixels), dim=-1)
        meets = _meets_region(scene, camera, directions)
        directions, rows, columns = directions[meets], rows[meets], columns[meets]
        origins = camera.position.expand_as(directions)
        crossing = first_crossing(
            lambda x: read(distance, x),
            origins,
            directions,
            sphere_entry(origins / 1.75, directions) * 1.75,
            reach=3.5,
            shortest=0.5 * spacing(nodes),
            steps=48,
        )
        missed = ~crossing.hit
        places.append((origins + crossing.along[:, None] * directions)[missed])
        inside_px = -outline[rows[missed] * step, columns[missed] * step]
        depths.append(inside_px * crossing.along[missed] / camera.intrinsics[0, 0])
    depth = torch.cat(depths).clamp(max=spacing(nodes))
    return torch.stack([torch.ones_like(depth), depth], dim=-1), locate(torch.cat(places), nodes)


def _meets_region(
    scene: Measurements, camera: Pinhole, directions: Float[Tensor, "rays 3"]
) -> Bool[Tensor, "rays"]:
    """Rays that go through the region's inner nine tenths."""
    apart = scene.region_centre - camera.position
    along = directions @ apart
    closest = (apart - along[:, None] * directions).norm(dim=-1)
    meets: Bool[Tensor, "rays"] = (closest < 0.9 * scene.region_radius) & (along > 0)
    return meets


def _free_distance(scene: Measurements, nodes: int) -> Float[Tensor, "nodes nodes nodes"]:
    """A lower bound of the distance: > 0 off any silhouette, before any empty backdrop and outside the
    region; else no bound."""
    points = node_positions(nodes, scene.positions.device)
    bound = (points - scene.region_centre).norm(dim=-1) - 0.97 * scene.region_radius
    bound = torch.maximum(bound, points.abs().amax(dim=-1) - (1 - spacing(nodes)))
    for camera, outline, backdrop in zip(scene.cameras, scene.outlines, scene.backdrops, strict=True):
        edge = outline if outline is not None else backdrop
        if edge is not None:
            bound = torch.maximum(bound, off_silhouette(camera, edge, nodes))
    return torch.where(bound > 0, bound, -math.inf)


def _seen_through_any(scene: Measurements, nodes: int, margin: float) -> Bool[Tensor, "nodes nodes nodes"]:
    free = torch.zeros((nodes, nodes, nodes), dtype=torch.bool, device=scene.positions.device)
    for camera, depth in zip(scene.cameras, scene.depths, strict=True):
        free |= seen_through(camera, depth, margin, nodes)
    return free
