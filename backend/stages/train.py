"""The signed distance field: started from points and silhouettes, refined by volume rendering.

Level by level on finer grids: first the smoothest field that agrees with the stereo points (first
order), with free space and with the level before (a linear problem); then gradient steps on rays
through the photographs. Rays are searched in the field itself, so that samples lie on the surface's
two sides and empty space costs nothing.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Float32, Int
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from ..maths import losses
from ..maths.evidence import off_silhouette, point_distances, seen_through
from ..maths.geometry import Pinhole, pinhole_in_object, ray_directions
from ..maths.grid import interpolate, laplacian_at, locate, node_positions, refined, spacing, splat
from ..maths.rays import Crossing, first_crossing, sphere_entry
from ..maths.smooth_fit import fit_smooth
from ..maths.volume import blending_weights, log_transmittance, log_transparency
from ..scene import Decision, Progress, Region, SurfacePoints, View
from .field import SurfaceField
from .stereo import StereoResult


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """How fine and how long."""

    levels: tuple[int, ...] = (32, 64, 128)
    """Nodes along each axis of the grids, coarse to fine."""
    steps: tuple[int, ...] = (0, 0, 200)
    """Gradient steps at each level."""
    rays: int = 1024
    """Rays of each step."""
    edges: int = 9
    """Edges of the intervals on each ray."""
    point_queries: int = 4096
    smoothness: float = 0.1
    """Weight of the squared Laplacian in the linear fit."""


@dataclass(frozen=True, kw_only=True)
class Surface:
    """The field at its finest level; object frame."""

    distance: Float32[np.ndarray, "nodes nodes nodes"]
    """Signed, object units, on nodes over [-1, 1]^3; > 0 outside."""
    decisions: tuple[Decision, ...] = ()


@dataclass(frozen=True, kw_only=True)
class _Scene:
    """The views and points as tensors."""

    cameras: list[Pinhole]
    images: list[Float[Tensor, "3 height width"]]
    masks: list[Float[Tensor, "height width"] | None]
    outlines: list[Float[Tensor, "height width"] | None]
    """Signed distance to the mask's outline in pixels, > 0 off the subject."""
    depths: list[Float[Tensor, "height width"]]
    positions: Float[Tensor, "points 3"]
    normals: Float[Tensor, "points 3"]
    colours: Float[Tensor, "points 3"]
    confidence: Float[Tensor, "points"]


def fit_surface(
    views: tuple[View, ...],
    region: Region,
    stereo: StereoResult,
    config: TrainConfig,
    *,
    device: torch.device,
    generator: torch.Generator,
    progress: Progress,
) -> Surface:
    """The distance field that agrees with points, silhouettes and photographs."""
    scene = _scene(views, region, stereo, device)
    distance = _sphere_like(scene, config.levels[0])
    total = sum(config.steps) + 10 * len(config.levels)
    done = 0
    for level, (nodes, steps) in enumerate(zip(config.levels, config.steps, strict=True)):
        progress(done / total, f"fitting points on a grid of {nodes}^3")
        with torch.no_grad():
            distance = _fit_level(scene, refined(distance, nodes), config, trust=0.0 if level == 0 else 1.0)
        done += 10
        if steps:
            tell = _within(progress, done / total, (done + steps) / total)
            distance = _refine(scene, distance, steps, config, generator, tell)
            done += steps
    return Surface(distance=distance.cpu().numpy())


def _within(progress: Progress, first: float, last: float) -> Progress:
    return lambda fraction, text: progress(first + (last - first) * fraction, text)


def _scene(views: tuple[View, ...], region: Region, stereo: StereoResult, device: torch.device) -> _Scene:
    points = stereo.points
    return _Scene(
        cameras=[pinhole_in_object(view.camera, region, device) for view in views],
        images=[torch.tensor(view.image_srgb, device=device).permute(2, 0, 1) for view in views],
        masks=[None if v.mask is None else torch.tensor(v.mask, device=device) for v in views],
        outlines=[None if v.mask is None else torch.tensor(_outline(v.mask), device=device) for v in views],
        depths=[torch.tensor(map_.depth, device=device) for map_ in stereo.depth_maps],
        positions=torch.tensor(points.positions, device=device),
        normals=torch.tensor(points.normals, device=device),
        colours=torch.tensor(points.colours_srgb, device=device),
        confidence=torch.tensor(points.confidence, device=device),
    )


def _outline(mask: Float32[np.ndarray, "height width"]) -> Float32[np.ndarray, "height width"]:
    """Signed distance in pixels to where the mask crosses one half; > 0 off the subject."""
    on = mask > 0.5
    if on.all() or not on.any():
        return np.where(on, -1e4, 1e4).astype(np.float32)
    signed: Float32[np.ndarray, "height width"] = distance_transform_edt(~on) - distance_transform_edt(on)
    # the transform counts from pixel centre to pixel centre; the outline lies half a pixel between them
    return (signed - 0.5 * np.sign(signed)).astype(np.float32)


# --- the linear fit --------------------------------------------------------------------------------------


def best_sphere(
    positions: Float[Tensor, "points 3"], normals: Float[Tensor, "points 3"], weight: Float[Tensor, "points"]
) -> tuple[Float[Tensor, "3"], Float[Tensor, ""]]:
    """Centre and radius of the sphere with p = centre + radius n in the least squares sense.

    For points all around it is the object's size; for points on one side, what their normals' turning says.
    """
    share = (weight / weight.sum())[:, None]
    mean_p, mean_n = (share * positions).sum(dim=0), (share * normals).sum(dim=0)
    spread = (share * (normals - mean_n).square()).sum()
    together = (share * (positions - mean_p) * (normals - mean_n)).sum()
    radius = (together / spread.clamp(min=1e-6)).clamp(0.2, 0.7)
    return mean_p - radius * mean_n, radius


def _sphere_like(scene: _Scene, nodes: int) -> Float[Tensor, "nodes nodes nodes"]:
    """The start: what is known of nothing is a ball."""
    centre, radius = best_sphere(scene.positions, scene.normals, scene.confidence)
    return (node_positions(nodes, scene.positions.device) - centre).norm(dim=-1) - radius


def _fit_level(
    scene: _Scene, before: Float[Tensor, "nodes nodes nodes"], config: TrainConfig, *, trust: float
) -> Float[Tensor, "nodes nodes nodes"]:
    """The smoothest field near the points' planes, positive in free space, else like the level before.

    Free space is an inequality: it pulls only where the field says otherwise, which takes a few rounds.
    """
    nodes = before.shape[0]
    h = spacing(nodes)
    measured = point_distances(scene.positions, scene.normals, scene.confidence, nodes)
    measured_weight = measured.weight.clamp(max=4.0)
    outside = _free_distance(scene, nodes)
    through = _seen_through_any(scene, nodes, 3 * h)
    distance = before
    for _ in range(3):
        target, weight = before.clone(), torch.full_like(before, 1e-3 * (32 / nodes) ** 2)
        carved = distance < outside
        target[carved], weight[carved] = outside[carved], 0.5
        carved = through & (distance < 2 * h)
        target[carved], weight[carved] = 2 * h, 0.2
        total = weight + measured_weight
        target = (weight * target + measured_weight * measured.distance) / total
        distance = fit_smooth(target, total, distance, smoothness=config.smoothness, steps=30)
    return distance


def _free_distance(scene: _Scene, nodes: int) -> Float[Tensor, "nodes nodes nodes"]:
    """A lower bound of the distance: > 0 off any silhouette and outside the region, else no bound."""
    bound = node_positions(nodes, scene.positions.device).norm(dim=-1) - 0.97
    for camera, outline in zip(scene.cameras, scene.outlines, strict=True):
        if outline is not None:
            bound = torch.maximum(bound, off_silhouette(camera, outline, nodes))
    return torch.where(bound > 0, bound, -math.inf)


def _seen_through_any(scene: _Scene, nodes: int, margin: float) -> Bool[Tensor, "nodes nodes nodes"]:
    free = torch.zeros((nodes, nodes, nodes), dtype=torch.bool, device=scene.positions.device)
    for camera, depth in zip(scene.cameras, scene.depths, strict=True):
        free |= seen_through(camera, depth, margin, nodes)
    return free


# --- refinement by rendering -----------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class _Pixels:
    """Every pixel worth a ray, of all views."""

    view: Int[Tensor, "pixels"]
    where: Float[Tensor, "pixels 2"]
    colour: Float[Tensor, "pixels 3"]
    coverage: Float[Tensor, "pixels"]
    """The mask's value, or nan where there is no mask."""


def _worthy_pixels(scene: _Scene) -> _Pixels:
    """On and just around the subject: where the mask is, or where something was measured."""
    parts = []
    for index, (image, mask, outline, depth) in enumerate(
        zip(scene.images, scene.masks, scene.outlines, scene.depths, strict=True)
    ):
        near = outline < 8 if outline is not None else F.max_pool2d((depth > 0).float()[None], 5, 1, 2)[0] > 0
        rows, columns = torch.nonzero(near, as_tuple=True)
        coverage = mask[rows, columns] if mask is not None else torch.full_like(rows, math.nan, dtype=torch.float32)
        where = torch.stack([columns, rows], dim=-1) + 0.5
        parts.append((torch.full_like(rows, index), where, image[:, rows, columns].T, coverage))
    view, where, colour, coverage = (torch.cat(column) for column in zip(*parts, strict=True))
    return _Pixels(view=view, where=where, colour=colour, coverage=coverage)


def _rays(
    scene: _Scene, pixels: _Pixels, chosen: Int[Tensor, "rays"]
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays 3"]]:
    """Origins and unit directions of chosen pixels."""
    origins = pixels.where.new_empty((len(chosen), 3))
    directions = torch.empty_like(origins)
    view = pixels.view[chosen]
    for index, camera in enumerate(scene.cameras):
        mine = view == index
        origins[mine] = camera.position
        directions[mine] = F.normalize(ray_directions(camera, pixels.where[chosen[mine]]), dim=-1)
    return origins, directions


def _refine(
    scene: _Scene,
    distance: Float[Tensor, "nodes nodes nodes"],
    steps: int,
    config: TrainConfig,
    generator: torch.Generator,
    progress: Progress,
) -> Float[Tensor, "nodes nodes nodes"]:
    field = SurfaceField(distance, band_cells=4, channels=6, view_dependent=True, generator=generator)
    _colour_from_points(field, scene)
    pixels = _worthy_pixels(scene)
    h = spacing(field.nodes)
    optimiser = torch.optim.Adam(
        [
            {"params": [field.distances], "lr": 0.03 * h},
            {"params": [field.features], "lr": 0.05},
            {"params": [field.first, field.first_bias, field.last, field.last_bias], "lr": 0.005},
        ],
        betas=(0.9, 0.99),
        eps=1e-12,
    )
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: 0.1 ** (step / steps))
    for step in range(steps):
        if step % 10 == 0:
            progress(step / steps, f"rendering at {field.nodes}^3, step {step} of {steps}")
            whole = field.whole()
        sharpness = 1 / (h * (1.0 - 0.5 * step / steps))
        loss = _ray_loss(field, whole, scene, pixels, sharpness, config, generator)
        loss = loss + _point_loss(field, scene, config, generator) + _shape_loss(field, generator)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        schedule.step()
    return field.whole()


def _colour_from_points(field: SurfaceField, scene: _Scene) -> None:
    """Start the features' colour logits at the stereo points' colours."""
    weight = scene.confidence[:, None]
    sums = splat(torch.cat([scene.colours * weight, weight], dim=-1), field.locate(scene.positions), field.nodes)
    mean = (scene.colours * weight).sum(dim=0) / weight.sum()
    colour = (sums[:, :3] + 1e-3 * mean) / (sums[:, 3:] + 1e-3)
    with torch.no_grad():
        field.features[:, :3] = torch.logit(colour[field.active].clamp(0.02, 0.98))


def _ray_loss(
    field: SurfaceField,
    whole: Float[Tensor, "nodes nodes nodes"],
    scene: _Scene,
    pixels: _Pixels,
    sharpness: float,
    config: TrainConfig,
    generator: torch.Generator,
) -> Float[Tensor, ""]:
    """Difference between rendered and photographed colours, and between opacity and masks."""
    chosen = torch.randint(len(pixels.view), (config.rays,), generator=generator).to(pixels.view.device)
    origins, directions = _rays(scene, pixels, chosen)
    with torch.no_grad():
        entry = sphere_entry(origins, directions)
        crossing = first_crossing(lambda x: interpolate(whole, locate(x, field.nodes)), origins, directions, entry)
    h = spacing(field.nodes)
    spread = torch.linspace(-3, 3, config.edges, device=origins.device)
    jitter = torch.rand((config.rays, 1), generator=generator).to(origins.device) - 0.5
    along = crossing.along[:, None] + h * (spread + jitter * (spread[1] - spread[0]))
    points = origins[:, None] + along[..., None] * directions[:, None]
    distances = field.distance(field.locate(points.reshape(-1, 3))).reshape(along.shape)
    log_pass = log_transmittance(distances, sharpness)
    weights = blending_weights(log_pass)

    middles = (points[:, 1:] + points[:, :-1]) / 2
    corners = field.locate(middles.reshape(-1, 3))
    _, gradient = field.distance_and_gradient(corners)
    normal = F.normalize(gradient, dim=-1, eps=1e-3)
    towards = directions[:, None].expand_as(middles).reshape(-1, 3)
    colour = field.colour(corners, normal, towards).reshape(*middles.shape)
    opacity = weights.sum(dim=-1)
    rendered = torch.einsum("ri,ric->rc", weights, colour) / opacity.clamp(min=1e-3)[:, None]
    coverage = pixels.coverage[chosen]
    masked = ~coverage.isnan()
    trust = torch.where(masked, coverage, 1.0) * opacity.detach() * crossing.hit
    difference = losses.charbonnier(rendered - pixels.colour[chosen], 0.02).mean(dim=-1)
    loss = (trust * difference).mean() + 0.1 * losses.eikonal(gradient)
    if masked.any():
        loss = loss + 0.1 * losses.silhouette(log_transparency(log_pass)[masked], coverage[masked])
    return loss


def _point_loss(
    field: SurfaceField, scene: _Scene, config: TrainConfig, generator: torch.Generator
) -> Float[Tensor, ""]:
    """Both Taylor residuals at queries around the points, in cells."""
    device = scene.positions.device
    h = spacing(field.nodes)
    chosen = torch.randint(len(scene.positions), (config.point_queries,), generator=generator).to(device)
    noise = torch.randn((config.point_queries, 3), generator=generator).to(device)
    p = scene.positions[chosen]
    q = p + 0.5 * h * noise
    value, gradient = field.distance_and_gradient(field.locate(q))
    at_query = losses.taylor_at_query(value, gradient, p - q)
    at_point = losses.taylor_at_point(value, scene.normals[chosen], p - q)
    both = losses.charbonnier(at_query / h, 0.5) + losses.charbonnier(at_point / h, 0.5)
    return (scene.confidence[chosen] * both).mean()


def _shape_loss(field: SurfaceField, generator: torch.Generator) -> Float[Tensor, ""]:
    """Squared Laplacian at random nodes near the surface, in cells."""
    chosen = torch.randint(len(field.active), (8192,), generator=generator).to(field.active.device)
    bent = laplacian_at(field.node_values, field.active[chosen], field.nodes)
    return 0.05 * (bent / spacing(field.nodes)).square().mean()
