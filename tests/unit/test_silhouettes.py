"""Capsules before cameras: where silhouettes let them be, which rays miss a field, and how deep they are."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from backend.maths.geometry import Pinhole, pixel_centres, ray_directions
from backend.maths.grid import node_positions, read, spacing
from backend.maths.rays import first_crossing
from backend.maths.smooth_fit import fit_smooth
from backend.stages.measurements import Measurements
from backend.stages.train import linear_fit, unseen_depth
from backend.stages.train.linear_fit import LinearConfig
from backend.stages.train.silhouettes import inside_along, least_distance, middles, missing, silhouette_rays
from backend.stages.train.unseen_depth import depth_behind
from backend.stages.train.unseen_side import DEEPEST, ball_behind, explained_radius, seen_depth

CPU = torch.device("cpu")
SIZE = 160
RADIUS = 0.25
Points = Float[Tensor, "points 3"]


def capsule(points: Float[Tensor, "*batch 3"], back: float) -> Float[Tensor, "*batch"]:
    """Signed distance of a capsule along x, from x = 0.4 backwards to `back`."""
    axis = torch.zeros_like(points)
    axis[..., 0] = points[..., 0].clamp(back, 0.4)
    distance: Tensor = (points - axis).norm(dim=-1) - RADIUS
    return distance


def camera_from(azimuth_deg: float, *, height: float = 0.3) -> Pinhole:
    """Four units before the capsule's front, a little above."""
    azimuth = math.radians(azimuth_deg)
    position = 4 * F.normalize(torch.tensor([math.cos(azimuth), math.sin(azimuth), height]), dim=0)
    forward = -F.normalize(position, dim=0)
    right = F.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0])), dim=0)
    camera_from_object = torch.eye(4)
    camera_from_object[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    camera_from_object[:3, 3] = -camera_from_object[:3, :3] @ position
    intrinsics = torch.tensor([[300.0, 0, SIZE / 2], [0, 300.0, SIZE / 2], [0, 0, 1]])
    return Pinhole(intrinsics=intrinsics, camera_from_object=camera_from_object, width=SIZE, height=SIZE)


def outline(camera: Pinhole, back: float) -> Float[Tensor, "height width"]:
    """Signed distance to the capsule's outline in pixels, > 0 off it."""
    directions = F.normalize(ray_directions(camera, pixel_centres(SIZE, SIZE, CPU)), dim=-1).reshape(-1, 3)
    origins = camera.position.expand_as(directions)
    start = torch.full_like(directions[:, 0], 2.0)
    crossing = first_crossing(lambda x: capsule(x, back), origins, directions, start, reach=4.0, steps=200)
    on = crossing.hit.reshape(SIZE, SIZE).numpy()
    signed = distance_transform_edt(~on) - distance_transform_edt(on)
    return torch.tensor(signed - 0.5 * np.sign(signed), dtype=torch.float32)


def seen(azimuths_deg: list[float], back: float, *, measured_from: float = 0.4) -> Measurements:
    """The capsule's silhouettes, and points of it whose x is more than so much."""
    u = F.normalize(torch.randn(4000, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    positions = u * RADIUS
    positions[:, 0] += torch.where(u[:, 0] > 0, 0.4, 0.4 + 2 * u[:, 0] * (0.4 - back))
    chosen = (positions[:, 0] > measured_from) & (positions[:, 0] > back)
    # beside the caps the surface is a tube
    normals = torch.where(u[:, :1] > 0, u, F.normalize(u * torch.tensor([0.0, 1.0, 1.0]), dim=-1))
    axis = torch.zeros_like(positions)
    axis[:, 0] = positions[:, 0].clamp(max=0.4)
    positions = axis + RADIUS * normals
    cameras = [camera_from(azimuth) for azimuth in azimuths_deg]
    edges = [outline(camera, back) for camera in cameras]
    count = int(chosen.sum())
    return Measurements(
        cameras=cameras,
        images=[torch.zeros(3, SIZE, SIZE)] * len(cameras),
        masks=[None] * len(cameras),
        outlines=list(edges),
        backdrops=[None] * len(cameras),
        certain=list(edges),
        depths=[torch.zeros(SIZE, SIZE)] * len(cameras),
        confidences=[torch.zeros(SIZE, SIZE)] * len(cameras),
        positions=positions[chosen],
        normals=normals[chosen],
        colours=torch.zeros(count, 3),
        confidence=torch.ones(count),
        view_index=torch.zeros(count, dtype=torch.long),
        region_centre=torch.zeros(3),
        region_radius=1.0,
    )


NODES = 48


def test_nothing_is_bounded_away_from_the_body() -> None:
    scene = seen([-20.0, 0.0, 20.0], -0.5)
    bound = least_distance(scene, NODES)
    distance = capsule(node_positions(NODES, CPU), -0.5)
    assert (bound <= distance.clamp(min=0) + spacing(NODES)).all()
    assert (bound > 0).float().mean() > 0.8


def test_the_middle_of_a_ray_lies_where_no_silhouette_forbids_it() -> None:
    scene = seen([-20.0, 0.0, 20.0], -0.5)
    middle, depth = middles(silhouette_rays(scene, NODES), least_distance(scene, NODES))
    on = sum(int((edge < 0).sum()) for edge in scene.outlines if edge is not None)
    assert len(middle) > 0.1 * on
    for camera, edge in zip(scene.cameras, scene.outlines, strict=True):
        assert edge is not None
        homogeneous = middle @ camera.camera_from_object[:3, :3].T + camera.camera_from_object[:3, 3]
        pixels = (homogeneous @ camera.intrinsics.T)[:, :2] / homogeneous[:, 2:]
        column, row = pixels.long().clamp(0, SIZE - 1).T
        assert (edge[row, column] < 2.5).all(), "a cell is about three pixels"
    assert (depth > 0).all()
    assert (depth <= spacing(NODES)).all()


@pytest.mark.parametrize("thinner", [0.0, 0.1, 0.3], ids=["the same", "thinner", "gone"])
def test_what_an_earlier_field_knew_changes_nothing(thinner: float) -> None:
    scene = seen([-20.0, 0.0, 20.0], -0.5)
    rays = silhouette_rays(scene, NODES)
    field = capsule(node_positions(NODES, CPU), -0.5)
    before = inside_along(rays, field, torch.full_like(rays.entry, torch.inf))
    along = inside_along(rays, field + thinner, before)
    assert (along.isinf() == missing(rays, field + thinner)).float().mean() > 0.995, "but those that graze"
    met = along.isfinite()
    value = read(field + thinner, rays.origins[met] + along[met, None] * rays.directions[met])
    assert (value < 0.5 * spacing(NODES)).all()


def test_a_ray_that_another_photograph_contradicts_is_left_out() -> None:
    scene = seen([-20.0, 20.0], -0.5)
    rays = silhouette_rays(scene, NODES)
    assert len(middles(rays, least_distance(scene, NODES))[0]) > 0.95 * len(rays.origins) > 200
    nothing = torch.full((SIZE, SIZE), 50.0)
    nothing[:4, :4] = -1
    scene.outlines[1] = scene.certain[1] = nothing
    rays = silhouette_rays(scene, NODES)
    assert len(middles(rays, least_distance(scene, NODES))[0]) < 0.02 * len(rays.origins)


def test_no_ray_misses_the_body_itself_and_all_miss_what_is_not_there() -> None:
    scene = seen([-20.0, 0.0, 20.0], -0.5)
    rays = silhouette_rays(scene, NODES)
    distance = capsule(node_positions(NODES, CPU), -0.5)
    assert missing(rays, distance).float().mean() < 0.01
    assert missing(rays, distance.abs() + 0.01).all()


def test_a_mask_with_nothing_above_one_half_tells_no_width() -> None:
    """Its photograph is passed over, and where all are such the region tells."""
    scene = seen([-20.0, 0.0, 20.0], -0.5)
    nothing = torch.full((SIZE, SIZE), 50.0)
    scene.outlines[1] = nothing
    one = explained_radius(scene)
    assert math.isfinite(one)
    scene.outlines[:] = [nothing] * 3
    assert math.isfinite(explained_radius(scene))
    assert ball_behind(scene, 0.3, NODES).isfinite().all()


def test_no_ray_leaps_over_a_small_ball() -> None:
    """(|x - c|^2 - r^2) / 2r grows with |x|^2 / 2r: a step of its value would end far behind the ball."""
    scene = seen([-20.0, 0.0, 20.0], 0.3)
    rays = silhouette_rays(scene, NODES)
    ball = ball_behind(scene, 0.3, NODES)
    positions = node_positions(NODES, CPU)[ball < 0]
    towards = F.normalize(positions.mean(dim=0) - rays.origins, dim=-1)
    through = (towards * rays.directions).sum(dim=-1) > math.cos(0.01)
    assert ball.max() > 5
    assert through.sum() > 5
    assert not missing(rays, ball)[through].any()


@pytest.mark.parametrize("measured_from", [0.4, 0.3])
def test_the_ball_behind_grows_with_what_only_silhouettes_show(measured_from: float) -> None:
    """Of a long body only the front is measured: its sides show in the outer photographs."""
    azimuths = [-20.0, 0.0, 20.0]
    (short, why_short), (long, why_long) = (
        depth_behind(seen(azimuths, back, measured_from=measured_from), LinearConfig())
        for back in (0.2, -0.9)
    )
    assert short == pytest.approx(explained_radius(seen(azimuths, 0.2, measured_from=measured_from)))
    assert 1.5 * short < long <= DEEPEST
    assert "silhouettes were missed" not in why_short.because
    assert "silhouettes were missed" in why_long.because


def reaching(azimuths_deg: list[float], depth: float) -> Measurements:
    """The capsule's silhouettes; what was measured looks along x, and reaches so far along it."""
    scene = seen(azimuths_deg, -0.5)
    along = torch.linspace(0.0, depth, 1001)[:, None] * torch.eye(3)[0]
    normals = torch.eye(3)[:1].expand_as(along)
    return replace(
        scene,
        positions=along,
        normals=normals,
        colours=along,
        confidence=along[:, 0] + 1,
        view_index=torch.zeros(len(along), dtype=torch.long),
    )


def test_the_other_side_is_as_deep_as_what_was_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of 0.96 of the depth, in widths of a capsule; where silhouettes bound the depth they tell."""
    azimuths = [-20.0, 0.0, 20.0]
    for depth in (0.1, 0.3):
        half_widths = seen_depth(reaching(azimuths, depth)) / (0.48 * depth)
        assert 1 / half_widths == pytest.approx(0.5, rel=0.2), "from 20 degrees, half as wide as it is long"
    assert seen_depth(reaching(azimuths, 0.3)) == pytest.approx(
        3 * seen_depth(reaching(azimuths, 0.1)), rel=0.3
    )
    assert seen_depth(reaching([-50.0, 0.0, 50.0], 0.3)) == 0.0
    monkeypatch.setattr(unseen_depth, "_met_radius", lambda _scene, explained, _config: explained)
    radius, why = depth_behind(reaching(azimuths, 0.5), LinearConfig())
    assert radius == seen_depth(reaching(azimuths, 0.5)) > explained_radius(reaching(azimuths, 0.5))
    assert "so deep is what was measured" in why.because
    nothing = torch.zeros((0, 3))
    none = {"positions": nothing, "normals": nothing, "colours": nothing, "confidence": nothing[:, 0]}
    none["view_index"] = nothing[:, 0].long()
    without = replace(reaching(azimuths, 0.3), **none)
    assert seen_depth(without) == 0.0


def test_half_around_the_points_tell_the_radius_and_all_around_it_is_the_widest() -> None:
    """Of a capsule seen from its end, which is a quarter of a unit wide and bends within that."""
    half = explained_radius(seen([-60.0, -20.0, 20.0, 60.0], -0.5))
    assert half < 0.8
    assert half == pytest.approx(explained_radius(seen([-50.0, 0.0, 50.0], -0.5)), rel=0.05)
    azimuths = [60.0 * i for i in range(6)]
    ring = seen(azimuths, -0.5)
    assert half < explained_radius(ring) < 1.0, "from 17 degrees above: what is beneath is not seen"
    ring.cameras[:] = [camera_from(azimuth, height=0.0) for azimuth in azimuths]
    assert explained_radius(ring) == 1.0


def test_without_silhouettes_nothing_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = seen([-20.0, 0.0, 20.0], -0.9)
    scene.outlines[:] = scene.certain[:] = [None] * 3

    def tried(*_: object) -> None:
        pytest.fail("a field was fitted")

    monkeypatch.setattr(unseen_depth, "fit_level", tried)
    assert depth_behind(scene, LinearConfig())[0] == explained_radius(scene)
    assert depth_behind(seen([-20.0, 0.0, 20.0], -0.9), LinearConfig(ball=0.3))[0] == 0.3


def test_rounds_end_where_the_surface_comes_to_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, rounds = seen([-20.0, 0.0, 20.0], 0.2, measured_from=-1.0), []

    def counted(*args: Any, **kwargs: Any) -> Tensor:
        rounds.append(1)
        return fit_smooth(*args, **kwargs)

    def fitted(settled: float) -> tuple[Tensor, int]:
        rounds.clear()
        config, radius = LinearConfig(settled=settled), explained_radius(scene)
        start = linear_fit.start(scene, radius, NODES)
        return linear_fit.fit_level(scene, start, radius, 20, config), len(rounds)

    monkeypatch.setattr(linear_fit, "fit_smooth", counted)
    (asked, all_rounds), (rested, fewer) = fitted(0.0), fitted(LinearConfig().settled)
    assert all_rounds == 20
    assert 2 <= fewer <= 16
    near = asked.abs() < spacing(NODES)
    assert (rested - asked)[near].abs().mean() < 0.1 * spacing(NODES)
