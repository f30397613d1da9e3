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
from jaxtyping import Bool, Float, Float32, Float64, Int, Shaped
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from ..errors import ErrorCode, ReconstructionError
from ..maths import losses
from ..maths.evidence import off_silhouette, point_distances, seen_through
from ..maths.geometry import Pinhole, pinhole_in_object, project, ray_directions
from ..maths.grid import Corners, laplacian_at, locate, node_positions, read, refined, spacing, splat
from ..maths.rays import first_crossing, sphere_entry
from ..maths.smooth_fit import fit_smooth
from ..maths.volume import blending_weights, log_transmittance, log_transparency
from ..scene import Decision, Progress, Region, View
from .field import SurfaceField
from .stereo import DepthMap, StereoResult

COARSEST = 48
"""Nodes along each axis of the grid that finds the surface's extent."""
ROUNDS = 5
"""How often the linear fit asks anew which inequalities are broken."""
SURE = 0.4
"""Confidence of a depth that carves: two photographs that agree to 0.8, or three to 0.53."""
CARVE = 4.0
"""Weight of free space where the field breaks it, beside measurements of about 1."""
PRIOR = 1e-3
"""Weight of the level before, at 32 nodes, beside measurements of about 1."""
LEAST_RADIUS = 0.3
"""Of the ball behind the surface, in half widths of the subject."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """How fine and how long."""

    levels: tuple[int, ...] = (32, 64, 128)
    """Nodes along each axis of the grids, coarse to fine."""
    steps: tuple[int, ...] = (0, 0, 100)
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
    """The field at its finest level."""

    distance: Float32[np.ndarray, "nodes nodes nodes"]
    """Signed, on nodes over the cube [-1, 1]^3 of the grid frame and in its units; > 0 outside."""
    grid_from_world: Float64[np.ndarray, "4 4"]
    """A similarity: the cube is laid tightly around the surface."""
    decisions: tuple[Decision, ...] = ()


@dataclass(frozen=True, kw_only=True)
class _Scene:
    """The views and points as tensors."""

    cameras: list[Pinhole]
    images: list[Float[Tensor, "3 height width"]]
    masks: list[Float[Tensor, "height width"] | None]
    outlines: list[Float[Tensor, "height width"] | None]
    """Signed distance to the mask's outline in pixels, > 0 off the subject."""
    backdrops: list[Float[Tensor, "height width"] | None]
    """The same for an empty backdrop where there is no mask: > 0 on it; what is not on it may be anything."""
    certain: list[Float[Tensor, "height width"] | None]
    """The same, < 0 where the subject surely is."""
    depths: list[Float[Tensor, "height width"]]
    positions: Float[Tensor, "points 3"]
    normals: Float[Tensor, "points 3"]
    colours: Float[Tensor, "points 3"]
    confidence: Float[Tensor, "points"]
    region_centre: Float[Tensor, "3"]
    region_radius: float


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
    progress(0.0, "finding the extent of the surface")
    with torch.no_grad():
        scene = _scene(views, region, region, stereo, device)
        distance = _fit_level(
            scene, torch.maximum(_ball(scene, COARSEST), _free_distance(scene, COARSEST)), config
        )
        frame = _tight_frame(distance, region)
        scene = _scene(views, region, frame, stereo, device)
        distance = torch.maximum(_ball(scene, config.levels[0]), _free_distance(scene, config.levels[0]))
    total = sum(config.steps) + 10 * len(config.levels)
    done = 0
    for nodes, steps in zip(config.levels, config.steps, strict=True):
        progress(done / total, f"fitting points on a grid of {nodes}^3")
        with torch.no_grad():
            distance = _fit_level(scene, refined(distance, nodes), config)
        done += 10
        if steps:
            tell = _within(progress, done / total, (done + steps) / total)
            distance = _refine(scene, distance, steps, config, generator, tell)
            done += steps
    return Surface(
        distance=distance.cpu().numpy(),
        grid_from_world=frame.object_from_world,
        decisions=_decisions(scene, frame, config),
    )


def _decisions(scene: _Scene, frame: Region, config: TrainConfig) -> tuple[Decision, ...]:
    """What was modelled and what was left out, with the measurement behind it."""
    masks = sum(outline is not None for outline in scene.outlines)
    backdrops = sum(backdrop is not None for backdrop in scene.backdrops)
    angle_deg = _widest_angle_deg(scene)
    cell = spacing(config.levels[-1]) * frame.radius_world
    made = [
        Decision(
            what="grid",
            choice=f"{config.levels[-1]} nodes along each side of a cube around the surface",
            because=f"the preset; a cell is {cell:.3g} wide in the cameras' units",
        ),
        Decision(
            what="silhouettes",
            choice="used" if masks or backdrops else "left out",
            because=f"{masks} photographs have masks, {backdrops} an even backdrop",
        ),
        Decision(
            what="depth of the unseen side",
            choice="as deep as wide" if angle_deg > 90 else "continued from the measured curvature",
            because=f"the photographs are taken from sides up to {angle_deg:.0f} degrees apart",
        ),
        Decision(what="background", choice="left out", because="rays that miss the subject are not rendered"),
        Decision(
            what="refinement by rendering",
            choice=f"{sum(config.steps)} steps" if sum(config.steps) else "left out",
            because="the preset",
        ),
    ]
    return tuple(made)


def _within(progress: Progress, first: float, last: float) -> Progress:
    return lambda fraction, text: progress(first + (last - first) * fraction, text)


def _scene(
    views: tuple[View, ...], region: Region, frame: Region, stereo: StereoResult, device: torch.device
) -> _Scene:
    """Everything measured, carried from the region's object frame to another frame."""
    points = stereo.points
    frame_from_object = frame.object_from_world @ region.world_from_object
    scale = region.radius_world / frame.radius_world
    middle = torch.tensor(frame_from_object[:3, 3], dtype=torch.float32, device=device)
    images = [torch.tensor(view.image_srgb, device=device).permute(2, 0, 1) for view in views]
    outlines = [_outline_or_none(view.mask, device) for view in views]
    empty = [None if m.empty is None else ~m.empty for m in stereo.depth_maps]
    subject = [_outline_or_none(m.subject, device) for m in stereo.depth_maps]
    return _Scene(
        cameras=[pinhole_in_object(view.camera, frame, device) for view in views],
        images=images,
        backdrops=[_outline_or_none(known, device) for known in empty],
        certain=[on if o is None else o for o, on in zip(outlines, subject, strict=True)],
        masks=[None if v.mask is None else torch.tensor(v.mask, device=device) for v in views],
        outlines=outlines,
        depths=[_sure_depth(map_, scale, device) for map_ in stereo.depth_maps],
        positions=torch.tensor(points.positions, device=device) * scale + middle,
        normals=torch.tensor(points.normals, device=device),
        colours=torch.tensor(points.colours_srgb, device=device),
        confidence=torch.tensor(points.confidence, device=device),
        region_centre=middle,
        region_radius=scale,
    )


def _sure_depth(map_: DepthMap, scale: float, device: torch.device) -> Float[Tensor, "height width"]:
    """Depths sure enough to call what lies before them empty; 0 elsewhere."""
    return torch.tensor(np.where(map_.confidence > SURE, map_.depth * scale, 0), device=device)


def _tight_frame(distance: Float[Tensor, "nodes nodes nodes"], region: Region) -> Region:
    """The cube around the inside of a coarse field, as the unit cube of a frame of its own.

    Raises ReconstructionError(NO_SURFACE) if there is no inside.
    """
    inside = torch.nonzero(distance < 0).float() * spacing(COARSEST) - 1
    if not len(inside):
        raise ReconstructionError(
            ErrorCode.NO_SURFACE,
            "No surface was found in the region.",
            "Check that the photographs show the same thing, and that masks, if any, are white on it.",
        )
    low, high = inside.amin(dim=0), inside.amax(dim=0)
    half = float((high - low).max()) / 2 + 2.5 * spacing(COARSEST)
    frame_from_object = np.eye(4)
    frame_from_object[:3, :3] /= half
    frame_from_object[:3, 3] = -((low + high) / 2).cpu().double().numpy() / half
    return Region(object_from_world=frame_from_object @ region.object_from_world)


def _outline_or_none(
    mask: Shaped[np.ndarray, "height width"] | None, device: torch.device
) -> Float[Tensor, "height width"] | None:
    return None if mask is None else torch.tensor(_outline(mask.astype(np.float32)), device=device)


def _outline(mask: Float32[np.ndarray, "height width"]) -> Float32[np.ndarray, "height width"]:
    """Signed distance in pixels to where the mask crosses one half; > 0 off the subject."""
    on = mask > 0.5
    if on.all() or not on.any():
        return np.where(on, -1e4, 1e4).astype(np.float32)
    signed: Float32[np.ndarray, "height width"] = distance_transform_edt(~on) - distance_transform_edt(on)
    # the transform counts from pixel centre to pixel centre; the outline lies half a pixel between them
    between: Float32[np.ndarray, "height width"] = (signed - 0.5 * np.sign(signed)).astype(np.float32)
    return between


# --- the linear fit --------------------------------------------------------------------------------------


def _ball(scene: _Scene, nodes: int) -> Float[Tensor, "nodes nodes nodes"]:
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
    bounded = min(max((_widest_angle_deg(scene) - 50) / 40, 0.0), 1.0)
    radius = explained + bounded * (widest - explained)
    apart = node_positions(nodes, scene.positions.device) - (mean_p - radius * mean_n)
    return (apart.square().sum(dim=-1) - radius * radius) / (2 * radius)


def _widest_angle_deg(scene: _Scene) -> float:
    """Largest angle between two cameras, seen from the region's middle."""
    directions = F.normalize(torch.stack([c.position for c in scene.cameras]) - scene.region_centre, dim=-1)
    return math.degrees(math.acos(float((directions @ directions.T).min().clamp(-1, 1))))


def _half_width(scene: _Scene, at: Float[Tensor, "3"]) -> float:
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


def _fit_level(
    scene: _Scene, before: Float[Tensor, "nodes nodes nodes"], config: TrainConfig
) -> Float[Tensor, "nodes nodes nodes"]:
    """The smoothest field near the points' planes that silhouettes allow, else like the level before.

    Smooth is measured against a ball, whose curvature is free. Free space (f > 0) and silhouettes
    (f < 0 somewhere on each ray) are inequalities: they pull only where the field says otherwise, which
    takes a few rounds.
    """
    nodes = before.shape[0]
    h = spacing(nodes)
    measured = point_distances(scene.positions, scene.normals, scene.confidence**3, nodes)
    measured_weight = measured.weight.clamp(max=4.0)
    ball = _ball(scene, nodes)
    outside = _free_distance(scene, nodes)
    through = _seen_through_any(scene, nodes, 3 * h)
    missed = torch.zeros((nodes**3, 1), device=before.device)
    distance = before
    for _ in range(ROUNDS):
        target, weight = before.clone(), torch.full_like(before, PRIOR * (32 / nodes) ** 2)
        carved = distance < outside
        target[carved], weight[carved] = outside[carved], CARVE
        carved = through & (distance < 2 * h)
        target[carved], weight[carved] = 2 * h, 0.2
        missed += splat(*_missed_silhouettes(scene, distance), nodes)
        pull = 0.2 * missed.reshape(distance.shape).clamp(max=1.0) * (outside < 0)
        total = weight + measured_weight + pull
        target = (weight * target + measured_weight * measured.distance - pull * h) / total
        distance = ball + fit_smooth(
            target - ball, total, distance - ball, smoothness=config.smoothness, steps=30
        )
    return distance


def _missed_silhouettes(
    scene: _Scene, distance: Float[Tensor, "nodes nodes nodes"]
) -> tuple[Float[Tensor, "rays 1"], Corners]:
    """Rays through masks that miss the field's inside: ones, and the places where they come nearest to it."""
    nodes = distance.shape[0]
    places = []
    for camera, outline in zip(scene.cameras, scene.certain, strict=True):
        if outline is None:
            continue
        step = max(1, round(float(spacing(nodes) * camera.intrinsics[0, 0] / camera.position.norm()) / 2))
        rows, columns = torch.nonzero(outline[::step, ::step] < -0.5 * step, as_tuple=True)
        pixels = torch.stack([columns, rows], dim=-1) * step + 0.5
        directions = F.normalize(ray_directions(camera, pixels), dim=-1)
        directions = directions[_meets_region(scene, camera, directions)]
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
    points = torch.cat(places) if places else scene.positions[:0]
    return torch.ones_like(points[:, :1]), locate(points, nodes)


def _meets_region(
    scene: _Scene, camera: Pinhole, directions: Float[Tensor, "rays 3"]
) -> Bool[Tensor, "rays"]:
    """Rays that go through the region's inner nine tenths."""
    apart = scene.region_centre - camera.position
    along = directions @ apart
    closest = (apart - along[:, None] * directions).norm(dim=-1)
    meets: Bool[Tensor, "rays"] = (closest < 0.9 * scene.region_radius) & (along > 0)
    return meets


def _free_distance(scene: _Scene, nodes: int) -> Float[Tensor, "nodes nodes nodes"]:
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
        coverage = (
            mask[rows, columns] if mask is not None else torch.full_like(rows, math.nan, dtype=torch.float32)
        )
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
    field = SurfaceField(distance, band_cells=4, channels=6, view_dependent=False, generator=generator)
    _colour_from_points(field, scene)
    pixels = _worthy_pixels(scene)
    h = spacing(field.nodes)
    optimiser = torch.optim.Adam(
        [
            {"params": [field.distances], "lr": 0.015 * h},
            {"params": [field.features], "lr": 0.02},
            {"params": [field.first, field.first_bias, field.last, field.last_bias], "lr": 0.01},
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
        torch.autograd.backward(loss)
        optimiser.step()
        schedule.step()
    return field.whole()


def _colour_from_points(field: SurfaceField, scene: _Scene) -> None:
    """Start the features' colour logits at the stereo points' colours."""
    weight = scene.confidence[:, None]
    sums = splat(
        torch.cat([scene.colours * weight, weight], dim=-1), field.locate(scene.positions), field.nodes
    )
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
        crossing = first_crossing(lambda x: read(whole, x), origins, directions, entry)
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
    return (scene.confidence[chosen] ** 3 * both).mean()


def _shape_loss(field: SurfaceField, generator: torch.Generator) -> Float[Tensor, ""]:
    """Squared Laplacian at random nodes near the surface, in cells."""
    chosen = torch.randint(len(field.active), (8192,), generator=generator).to(field.active.device)
    bent = laplacian_at(field.node_values, field.active[chosen], field.nodes)
    return 0.5 * (bent / spacing(field.nodes)).square().mean()
