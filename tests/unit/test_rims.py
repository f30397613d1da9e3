"""Rims of an ellipsoid, of which outline, touching points and normals are known in closed form.

x = MIDDLE + SHAPE u turns the unit ball of u into the ellipsoid and keeps what touches touching.
"""

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from backend.maths.geometry import Pinhole, pixel_centres, project, ray_directions
from backend.maths.grid import locate, node_positions, spacing, value_and_gradient
from backend.scene import transform_points
from backend.stages.measurements import Measurements, measurements
from backend.stages.stereo.multi_view_stereo import unmatched
from backend.stages.train.linear_fit import LinearConfig, fit_level, start
from backend.stages.train.rims import rim_points, rim_rays
from tests.synthetic_scene import (
    DISTANCE,
    SIZE,
    photographed,
    ring_cameras,
    surface_distance,
    true_normals,
    true_region,
)

CPU = torch.device("cpu")
NODES = 41
CELL = spacing(NODES)
WIDTH, HEIGHT = 300, 220
UP = torch.tensor([0.0, 0.0, 1.0])
MIDDLE = torch.tensor([0.05, -0.1, 0.08])
TURN = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(3)))[0]
SHAPE = TURN @ torch.diag(torch.tensor([0.5, 0.4, 0.3]))

Points = Float[Tensor, "points 3"]
Picture = Float[Tensor, "height width"]


def camera_from(azimuth_deg: float, *, aside: float = 0.0, focal_px: float = 200.0) -> Pinhole:
    """Three units from the origin and one up, looking `aside` of it to the right.

    Oblong pixels and a principal point off the middle, as calibrated cameras have them.
    """
    azimuth = math.radians(azimuth_deg)
    position = torch.tensor([math.cos(azimuth) * math.sqrt(8), math.sin(azimuth) * math.sqrt(8), 1.0])
    forward = F.normalize(aside * F.normalize(torch.linalg.cross(-position, UP), dim=0) - position, dim=0)
    right = F.normalize(torch.linalg.cross(forward, UP), dim=0)
    camera_from_object = torch.eye(4)
    camera_from_object[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    camera_from_object[:3, 3] = -camera_from_object[:3, :3] @ position
    intrinsics = torch.tensor([[focal_px, 0, 155], [0, 0.9 * focal_px, 104], [0, 0, 1]])
    return Pinhole(intrinsics=intrinsics, camera_from_object=camera_from_object, width=WIDTH, height=HEIGHT)


# the truth


def in_ball(points: Points) -> Points:
    """u of x."""
    return (points - MIDDLE) @ torch.linalg.inv(SHAPE).T


def normals_at(points: Points) -> Points:
    """Outward unit normals of the ellipsoid through the points that is like the body."""
    return F.normalize(in_ball(points) @ torch.linalg.inv(SHAPE), dim=-1)


def distance_to_first_order(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    u = in_ball(points)
    length = u.norm(dim=-1)
    return (length - 1) * length / (u @ torch.linalg.inv(SHAPE)).norm(dim=-1)


def touching_points(camera: Pinhole, count: int = 4000) -> Points:
    """Of the cone of rays around the body: in the ball's frame a circle."""
    eye = in_ball(camera.position[None])[0]
    towards = F.normalize(eye, dim=0)
    first = F.normalize(torch.linalg.cross(towards, UP), dim=0)
    turn = torch.arange(count)[:, None] * (2 * math.pi / count)
    around = turn.cos() * first + turn.sin() * torch.linalg.cross(towards, first)
    cosine = 1 / eye.norm()
    return MIDDLE + (cosine * towards + (1 - cosine**2).sqrt() * around) @ SHAPE.T


def on_body(camera: Pinhole) -> Bool[Tensor, "height width"]:
    """Pixels whose rays meet the body."""
    directions = ray_directions(camera, pixel_centres(WIDTH, HEIGHT, CPU)) @ torch.linalg.inv(SHAPE).T
    eye = in_ball(camera.position[None])[0].expand_as(directions)
    return torch.linalg.cross(F.normalize(directions, dim=-1), eye).norm(dim=-1) < 1


def exact_edge(camera: Pinhole) -> Picture:
    """Signed distance to the outline in pixels, > 0 off the body."""
    outline = project(camera, touching_points(camera))[0]
    apart, _ = cKDTree(outline.numpy()).query(pixel_centres(WIDTH, HEIGHT, CPU).numpy())
    return torch.where(on_body(camera), -1.0, 1.0) * torch.tensor(apart, dtype=torch.float32)


def field(nodes: int = NODES) -> Float[Tensor, "nodes nodes nodes"]:
    return distance_to_first_order(node_positions(nodes, CPU))


def seen(
    cameras: list[Pinhole],
    edges: list[Picture | None],
    backdrops: list[Picture | None] | None = None,
    measured: Points = MIDDLE[None][:0],
) -> Measurements:
    """Nothing but edges and points, of full confidence."""
    nothing: list[Picture | None] = [None] * len(cameras)
    normals = normals_at(measured)
    return Measurements(
        cameras=cameras,
        images=[torch.zeros(3, HEIGHT, WIDTH)] * len(cameras),
        masks=nothing,
        outlines=edges if backdrops is None else nothing,
        backdrops=nothing if backdrops is None else backdrops,
        certain=edges,
        depths=[torch.zeros(HEIGHT, WIDTH)] * len(cameras),
        confidences=[torch.zeros(HEIGHT, WIDTH)] * len(cameras),
        positions=measured,
        normals=normals,
        colours=normals.abs(),
        confidence=torch.ones(len(measured)),
        view_index=torch.zeros(len(measured), dtype=torch.long),
        region_centre=torch.zeros(3),
        region_radius=1.0,
    )


def apart_from(points: Points, others: Points) -> Float[Tensor, "points"]:
    """Distance of each point from the nearest of the others."""
    return torch.tensor(cKDTree(others.numpy()).query(points.numpy())[0], dtype=torch.float32)


def apart_and_turned(camera: Pinhole, positions: Points, normals: Points) -> tuple[Tensor, Tensor]:
    """From where the rims' rays touch the body: how far, and how many degrees."""
    touching = touching_points(camera)
    _, index = cKDTree(project(camera, touching)[0].numpy()).query(project(camera, positions)[0].numpy())
    of = touching[torch.tensor(index)]
    return (positions - of).norm(dim=-1), angles_deg(normals, normals_at(of))


def angles_deg(normals: Points, others: Points) -> Float[Tensor, "points"]:
    return torch.rad2deg(torch.acos((normals * others).sum(dim=-1).clamp(-1, 1)))


def touched(scene: Measurements, distance: Float[Tensor, "nodes nodes nodes"]) -> tuple[Points, Points]:
    return rim_points(rim_rays(scene, len(distance)), distance)


# where rays touch


@pytest.mark.parametrize("nodes", [21, 41, 81])
@pytest.mark.parametrize(
    "camera", [camera_from(20), camera_from(130, aside=0.3), camera_from(250, focal_px=380)]
)
def test_rims_are_where_rays_touch_the_body(camera: Pinhole, nodes: int) -> None:
    cell = spacing(nodes)
    touching = touching_points(camera)
    positions, normals = touched(seen([camera], [exact_edge(camera)]), field(nodes))
    assert distance_to_first_order(positions).abs().max() < cell**2, "of second order"
    apart, off = apart_and_turned(camera, positions, normals)
    assert apart.max() < cell, "along the ray"
    assert off.median() < 0.1
    assert off.max() < 0.5
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(len(normals)))
    directions = F.normalize(positions - camera.position, dim=-1)
    assert (directions * normals).sum(dim=-1).abs().max() < 1e-5
    assert apart_from(touching, positions).max() < 2 * cell, "all around"


def test_rims_of_masks_lie_on_the_body_but_for_a_pixel() -> None:
    """Of whole pixels, whose steps turn the normals."""
    scene = photographed(ring_cameras(3, WIDTH))
    region = true_region()
    of_masks = measurements(scene.views, region, unmatched(scene.views), CPU)
    nodes_world = transform_points(region.world_from_object, node_positions(64, CPU).double().numpy())
    distance = torch.tensor(surface_distance(nodes_world.reshape(-1, 3))) / region.radius_world
    positions, normals = touched(of_masks, distance.reshape(64, 64, 64).float())
    assert len(positions) > 500
    world = transform_points(region.world_from_object, positions.double().numpy())
    pixel = DISTANCE * SIZE / scene.cameras[0].fx_px
    off = np.abs(surface_distance(world))
    assert np.median(off) < 0.3 * pixel
    assert np.quantile(off, 0.95) < pixel
    assert angles_deg(normals, torch.tensor(true_normals(world)).float()).median() < 5


def test_rims_lie_half_a_cell_apart_or_closer() -> None:
    """An outline is some two pixels wide; never so many that they are a multiple of what the grid needs."""
    camera = camera_from(20, focal_px=380)
    touching = touching_points(camera)
    length = float((touching - touching.roll(1, 0)).norm(dim=-1).sum())
    for nodes in (12, 16, 21, 41):
        count = len(touched(seen([camera], [exact_edge(camera)]), field(nodes))[0])
        assert 0.2 * spacing(nodes) < length / count < 0.6 * spacing(nodes)


def test_each_photograph_gives_its_own_rims() -> None:
    cameras = [camera_from(20), camera_from(130), camera_from(250)]
    edges = [exact_edge(camera) for camera in cameras]
    each = [touched(seen([c], [e]), field()) for c, e in zip(cameras, edges, strict=True)]
    assert min(len(positions) for positions, _ in each) > 50
    both = touched(seen(cameras, [edges[0], None, edges[2]]), field())
    for found, first, last in zip(both, each[0], each[2], strict=True):
        assert (found == torch.cat([first, last])).all()


# where they do not, or nobody knows


def test_where_a_photograph_ends_is_no_outline() -> None:
    """A body cut by the border, and a mask that is off on the outermost pixels all around."""
    camera = camera_from(20, aside=2.2)
    edge = exact_edge(camera)
    assert (edge[:, 0] < 0).any(), "is cut"
    positions, normals = touched(seen([camera], [edge]), field())
    apart, off = apart_and_turned(camera, positions, normals)
    assert len(positions) > 30
    assert apart.max() < CELL
    assert off.max() < 0.5
    frame = torch.full((HEIGHT, WIDTH), -0.5)
    frame[0], frame[-1], frame[:, 0], frame[:, -1] = 0.5, 0.5, 0.5, 0.5
    assert not len(touched(seen([camera_from(20)], [frame]), field() * 0)[0])


def test_a_field_that_rays_do_not_come_near_has_no_rims() -> None:
    """Within six cells: rims are where the body that is so much too large or small is deepest."""
    scene = seen([camera_from(20)], [exact_edge(camera_from(20))])
    as_large = touched(scene, field())[0]
    for more in (5.5 * CELL, -4.5 * CELL):
        moved = (touched(scene, field() + more)[0] - as_large).norm(dim=-1)
        assert moved.median() == 0
        assert moved.max() < 2 * CELL, "where two places are as deep"
    positions, normals = touched(scene, field() + 6.5 * CELL)
    assert positions.shape == normals.shape == (0, 3)


def test_rims_lie_in_the_grid_s_cube() -> None:
    """Of a field that says nothing; beyond the cube it is not known. Rays that miss the cube give none."""
    edge = (torch.arange(WIDTH) - 50.5).expand(HEIGHT, WIDTH)
    positions, _ = touched(seen([camera_from(20)], [edge]), field() * 0)
    assert len(positions) > 30
    assert positions.abs().max() < 1
    assert not len(touched(seen([camera_from(20, aside=-4)], [edge + 40]), field() * 0)[0])


def test_without_outlines_there_are_no_rims() -> None:
    positions, normals = touched(seen([camera_from(20)], [None]), field())
    assert positions.shape == normals.shape == (0, 3)


def test_an_edge_is_an_outline_only_where_it_meets_the_backdrop() -> None:
    """On the right the backdrop begins where the body ends, on the left four pixels off."""
    camera = camera_from(20)
    edge = exact_edge(camera)
    positions, _ = touched(seen([camera], [edge]), field())
    columns = project(camera, positions)[0][:, 0]
    middle = float(columns.mean())
    apart = edge.clone()
    apart[:, : round(middle)] -= 4
    found = touched(seen([camera], [edge], [apart]), field())[0]
    right = project(camera, found)[0][:, 0]
    assert right.min() > middle - 2
    assert len(found) == pytest.approx((columns > middle).sum(), abs=3)
    assert not len(touched(seen([camera], [edge], [edge - 4]), field())[0])


def test_a_wire_of_a_pixel_has_no_rims_a_strip_has_two() -> None:
    """Where two outlines meet, the distance has no slope that tells which way is out."""
    camera = camera_from(20)
    apart = (torch.arange(WIDTH) - 150).abs().float().expand(HEIGHT, WIDTH)
    assert not len(touched(seen([camera], [apart - 0.5]), field() * 0)[0])
    positions, normals = touched(seen([camera], [apart - 4.5]), field() * 0)
    columns = project(camera, positions)[0][:, 0]
    rightwards = normals @ camera.camera_from_object[0, :3]
    left, right = (columns - 146).abs() < 0.01, (columns - 155).abs() < 0.01
    assert left.sum() > 50
    assert right.sum() > 50
    assert (left | right).all()
    assert (rightwards[left] < -0.9).all()
    assert (rightwards[right] > 0.9).all()


@pytest.mark.parametrize("focal_px", [100, 200, 300, 400, 500, 600, 700, 800])
def test_both_sides_of_an_upright_strip_have_rims(focal_px: float) -> None:
    """However many of its pixels are left out between."""
    camera = camera_from(0, focal_px=focal_px)
    edge = ((torch.arange(WIDTH) + 0.5 - 150).abs() - 40).expand(HEIGHT, WIDTH)
    columns = project(camera, touched(seen([camera], [edge]), torch.zeros(32, 32, 32))[0])[0][:, 0]
    left, right = int((columns < 150).sum()), int((columns > 150).sum())
    assert min(left, right) > 0.4 * (left + right)


# in the fit


def fitted(azimuths_deg: list[float], rims: float) -> tuple[Measurements, Tensor]:
    """Of outlines and of the eighth of the body where something could be measured."""
    u = F.normalize(torch.randn(20_000, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    points = MIDDLE + u @ SHAPE.T
    facing = normals_at(points) @ F.normalize(torch.tensor([1.0, 0.2, 0.3]), dim=0)
    cameras = [camera_from(azimuth) for azimuth in azimuths_deg]
    scene = seen(cameras, [exact_edge(c) for c in cameras], measured=points[facing > 0.9])
    return scene, fit_level(scene, start(scene, 1.0, 24), 1.0, 15, LinearConfig(rims=rims))


def distances_and_angles(distance: Tensor, points: Points) -> tuple[Tensor, Tensor]:
    """Of a field's surface from points of the true one: in cells, > 0 where it lies deeper, and degrees."""
    value, gradient = value_and_gradient(distance, locate(points, len(distance)))
    cells = value / gradient.norm(dim=-1) / spacing(len(distance))
    return cells, angles_deg(F.normalize(gradient, dim=-1), normals_at(points))


def test_rims_hold_the_surface_where_nothing_is_measured() -> None:
    """Three sides: silhouettes alone let the flat body sink and swell between; rims hold it."""
    scene, without = fitted([-60, 0, 60], 0.0)
    _, with_rims = fitted([-60, 0, 60], 0.1)
    touching = torch.cat([touching_points(camera, 300) for camera in scene.cameras])
    around = F.normalize(torch.randn(3000, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    everywhere = MIDDLE + around @ SHAPE.T
    for points, cells, degrees in ((touching, 0.07, 5.0), (everywhere, 0.16, 7.0)):
        (before, before_deg), (after, after_deg) = (
            distances_and_angles(f, points) for f in (without, with_rims)
        )
        assert after.abs().mean() < min(cells, 0.7 * before.abs().mean())
        assert after_deg.mean() < min(degrees, 0.9 * before_deg.mean())
        assert before.abs().mean() < 0.3, "cells: silhouettes are met also without rims"


def test_from_one_side_rims_say_little_where_nothing_is_measured_near() -> None:
    """There only the field itself says where a ray touches."""

    def moved_by_rims(azimuths_deg: list[float]) -> float:
        (scene, without), (_, with_rims) = (fitted(azimuths_deg, rims) for rims in (0.0, 0.1))
        touching = torch.cat([touching_points(camera, 300) for camera in scene.cameras])
        far = touching[apart_from(touching, scene.positions) > 0.4]
        assert len(far) > 100
        before, after = (distances_and_angles(f, far)[0] for f in (without, with_rims))
        return float((after - before).abs().mean())

    assert moved_by_rims([-20, 20]) < 0.1 * moved_by_rims([-60, 0, 60])
