"""A ball that hides part of another one: the true depths of both are known, and a bridge between them."""

import math
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from backend.maths.geometry import Pinhole, pixel_centres, ray_directions, unproject
from backend.maths.grid import node_positions, read, spacing
from backend.stages.measurements import Measurements
from backend.stages.train.inner_outlines import FarSide, decision, far_sides
from backend.stages.train.linear_fit import LinearConfig, fit_level

NODES = 64
SIZE = 160
NEAR, NEAR_RADIUS = torch.tensor([0.35, 0.12, 0.0]), 0.3
FAR, FAR_RADIUS = torch.tensor([-0.3, -0.25, 0.0]), 0.45
BRIDGE = 0.5
"""How far a smooth union of the two reaches across the gap."""

Picture = Float[Tensor, "height width"]
Field = Float[Tensor, "nodes nodes nodes"]


def camera() -> Pinhole:
    """Three units away, along -x."""
    camera_from_object = torch.eye(4)
    camera_from_object[:3, :3] = torch.tensor([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]])
    camera_from_object[2, 3] = 3.0
    intrinsics = torch.tensor([[280.0, 0, SIZE / 2], [0, 280, SIZE / 2], [0, 0, 1]])
    return Pinhole(intrinsics=intrinsics, camera_from_object=camera_from_object, width=SIZE, height=SIZE)


def depth_of(middle: Float[Tensor, "3"], radius: float) -> Picture:
    """Of a ball; infinite where it is missed."""
    rays = ray_directions(camera(), pixel_centres(SIZE, SIZE, torch.device("cpu")))
    apart = camera().position - middle
    a, b, c = (rays * rays).sum(-1), (rays * apart).sum(-1), (apart * apart).sum() - radius**2
    root = b * b - a * c
    return torch.where(root > 0, (-b - root.clamp(min=0).sqrt()) / a, torch.inf)


def depths() -> tuple[Picture, Picture]:
    """Of the nearer and of the farther ball."""
    return depth_of(NEAR, NEAR_RADIUS), depth_of(FAR, FAR_RADIUS)


def true_depth() -> Picture:
    return torch.minimum(*depths())


def balls() -> tuple[Field, Field]:
    nodes = node_positions(NODES, torch.device("cpu"))
    return (nodes - NEAR).norm(dim=-1) - NEAR_RADIUS, (nodes - FAR).norm(dim=-1) - FAR_RADIUS


def bridged() -> Field:
    """A smooth union (Quilez' polynomial minimum), inside in the gap between the two as well."""
    one, other = balls()
    share = (0.5 + 0.5 * (other - one) / BRIDGE).clamp(0, 1)
    return other + share * (one - other) - BRIDGE * share * (1 - share)


def scene(*, contrast: float = 0.4) -> Measurements:
    """Measured in the middle of either ball, not around the line between them; its outline is known."""
    near, far = depths()
    on_near, on_far = near < far, far < near
    image = (0.3 * (on_near | on_far) + contrast * on_near).float()
    depth = true_depth()
    rows, columns = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    line = torch.nonzero(on_far & F.max_pool2d(on_near[None].float(), 5, 1, 2)[0].bool())
    apart = torch.cdist(torch.stack([rows, columns], -1).reshape(-1, 2).float(), line.float()).amin(1)
    facing = _facing(on_near, on_far, depth)
    known = (on_near | on_far) & (apart.reshape(SIZE, SIZE) > 25) & (facing > 0.5)
    inside = on_near | on_far
    outline = torch.where(inside, -5.0, 5.0)
    pixels = pixel_centres(SIZE, SIZE, torch.device("cpu"))[known]
    positions = unproject(camera(), pixels, depth[known])
    middle = torch.where(on_near[known][:, None], NEAR, FAR)
    return Measurements(
        cameras=[camera()],
        images=[image.expand(3, -1, -1)],
        masks=[None],
        outlines=[outline],
        backdrops=[None],
        certain=[outline],
        depths=[torch.where(known, depth, 0.0)],
        confidences=[0.8 * known],
        positions=positions,
        normals=F.normalize(positions - middle, dim=-1),
        colours=torch.zeros_like(positions),
        confidence=torch.full((len(positions),), 0.8),
        view_index=torch.zeros(len(positions), dtype=torch.long),
        region_centre=torch.zeros(3),
        region_radius=1.0,
    )


def _facing(on_near: Tensor, on_far: Tensor, depth: Picture) -> Picture:
    """Cosine between the surface's normal and the way to the camera."""
    safe = torch.where(depth.isfinite(), depth, 1.0)
    points = unproject(camera(), pixel_centres(SIZE, SIZE, torch.device("cpu")), safe)
    normals = F.normalize(points - torch.where(on_near[..., None], NEAR, FAR), dim=-1)
    to_camera = F.normalize(camera().position - points, dim=-1)
    return torch.where(on_near | on_far, (normals * to_camera).sum(-1), 0.0)


def told(side: FarSide) -> Picture:
    """At the photograph's own size, which small ones keep."""
    assert side.depth.shape == (SIZE, SIZE)
    return side.depth


def test_a_bridge_beside_a_line_is_told_to_be_empty() -> None:
    (side,) = far_sides(scene(), bridged())
    empty, (near, far) = told(side), depths()
    found = empty > 0
    assert found.sum() > 300
    assert (far < near)[found].float().mean() > 0.98, "what is in front stays"
    assert (empty <= true_depth() + 0.02)[found].float().mean() > 0.98, "and so does what is behind"


@pytest.mark.parametrize("contrast", [0.0, 0.002])
def test_without_a_line_nothing_is_told(contrast: float) -> None:
    (side,) = far_sides(scene(contrast=contrast), bridged())
    assert not (told(side) > 0).any()


def test_of_a_field_without_a_bridge_nothing_is_told() -> None:
    (side,) = far_sides(scene(), torch.minimum(*balls()))
    assert (told(side) > 0).sum() < 20


def test_a_photograph_that_does_not_know_its_subject_tells_nothing() -> None:
    assert far_sides(replace(scene(), certain=[None]), bridged()) == []


def test_texture_hides_lines() -> None:
    """Where all neighbours differ as much, walks cross the line as readily as anything else."""
    generator = torch.Generator().manual_seed(1)
    noise = 0.4 * torch.rand(3, SIZE, SIZE, generator=generator)
    textured = replace(scene(contrast=0.1), images=[scene(contrast=0.1).images[0] + noise])
    (side,) = far_sides(textured, bridged())
    assert (told(side) > 0).sum() < 20


def test_a_line_that_stands_out_of_the_texture_is_found() -> None:
    """What neighbours differ by everywhere parts nothing, though it is many times what eight bits tell."""
    generator = torch.Generator().manual_seed(1)
    plain = scene(contrast=0.6)
    noise = 0.1 * torch.rand(3, SIZE, SIZE, generator=generator)
    (side,) = far_sides(replace(plain, images=[plain.images[0] + noise]), bridged())
    found, (near, far) = told(side) > 0, depths()
    assert found.sum() > 300
    assert (far < near)[found].float().mean() > 0.98


def test_a_bulge_where_nothing_was_measured_is_no_bridge() -> None:
    """Walks end on what is around, far behind the bulge, but no line parts one from the other."""
    near, far = depths()
    ball = scene(contrast=0.0)
    middle = torch.tensor([-0.3 + FAR_RADIUS, -0.25, 0.0])
    rows, columns = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    row, column = divmod(int(far.argmin()), SIZE)
    around = torch.hypot((rows - row).float(), (columns - column).float()) > 8
    known = (far < near) & around
    outline = torch.where(far.isfinite(), -5.0, 5.0)
    alone = replace(
        ball,
        outlines=[outline],
        certain=[outline],
        images=[0.3 * far.isfinite().float().expand(3, -1, -1)],
        depths=[torch.where(known, far, 0.0)],
        confidences=[0.8 * known],
    )
    bulge = (node_positions(NODES, torch.device("cpu")) - middle).norm(dim=-1) - 0.15
    (side,) = far_sides(alone, torch.minimum(balls()[1], bulge))
    assert not (told(side) > 0).any()


def test_the_fit_opens_the_gap() -> None:
    """Two cells before what was told, on rays where it was: inside as the bridge is left, outside now."""
    setting, before = scene(), bridged()
    far = far_sides(setting, before)
    empty = told(far[0])
    found = empty > 0
    pixels = pixel_centres(SIZE, SIZE, torch.device("cpu"))[found]
    points = unproject(camera(), pixels, empty[found] - 2 * spacing(NODES))

    def share_inside(*told_of: FarSide) -> float:
        field = fit_level(setting, before, 0.5, 10, LinearConfig(), told_of)
        return float((read(field, points) < 0).float().mean())

    assert share_inside() > 0.3
    assert share_inside(*far) < 0.02


def test_the_report_says_how_many_photographs_told() -> None:
    found = far_sides(scene(), bridged())
    nothing = [replace(found[0], depth=torch.zeros_like(found[0].depth))]
    assert decision([*nothing, *found]).choice == "used"
    assert "in 1 of 2" in decision([*nothing, *found]).because
    assert decision(nothing).choice == "left out"
    assert decision([]).choice == "left out"
    assert math.isfinite(float(found[0].depth.sum()))
