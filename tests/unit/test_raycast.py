"""Rays against meshes: a slow reference, the analytic sphere, and laws of visibility."""

import time
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
import trimesh

from backend.maths.geometry import pinhole_in_object, pixel_centres, ray_directions
from backend.maths.raycast import (
    RayCaster,
    camera_rays,
    intersect_planes,
    render_mesh,
    visible_from,
)
from backend.scene import Camera, Region, SurfaceMesh, transform_points


def camera_at(position: np.ndarray, *, focal_px: float = 80.0, width: int = 64, height: int = 48) -> Camera:
    """A camera that looks at the origin with its image upright about +z."""
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0.0, 0.1, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3], camera_from_world[:3, 3] = rotation, -rotation @ position
    return Camera(
        camera_from_world=camera_from_world,
        fx_px=focal_px,
        fy_px=focal_px * 1.1,
        cx_px=width / 2 + 1.5,
        cy_px=height / 2 - 2.25,
        width=width,
        height=height,
    )


def sphere_mesh(
    subdivisions: int = 4, radius: float = 1.0, centre: tuple[float, ...] = (0, 0, 0)
) -> SurfaceMesh:
    ball = trimesh.creation.icosphere(subdivisions)
    unit = np.asarray(ball.vertices, np.float64)
    return SurfaceMesh(
        vertices=unit * radius + np.array(centre),
        faces=np.asarray(ball.faces, np.int64),
        normals=unit.astype(np.float32),
        colours_srgb=np.round((unit + 1) * 127.5).astype(np.uint8),
        support=((unit[:, 2] + 1) / 2).astype(np.float32),
    )


def first_hit_one_by_one(
    triangles: np.ndarray, origin: np.ndarray, direction: np.ndarray
) -> tuple[float, int, np.ndarray]:
    """The definition: solve origin + t d = a + u (b - a) + v (c - a) for every triangle, keep the nearest."""
    best: tuple[float, int, np.ndarray] = (np.inf, -1, np.zeros(3))
    for index, (a, b, c) in enumerate(triangles):
        matrix = np.stack([-direction, b - a, c - a], axis=1)
        if abs(np.linalg.det(matrix)) < 1e-12:
            continue
        t, u, v = np.linalg.solve(matrix, origin - a)
        if t > 0 and u >= 0 and v >= 0 and u + v <= 1 and t < best[0]:
            best = (t, index, np.array([1 - u - v, u, v]))
    return best


@pytest.mark.parametrize(("scale", "shift"), [(1.0, 0.0), (1e-3, 5.0), (400.0, -4e8)])
def test_first_hits_match_the_definition(scale: float, shift: float) -> None:
    """A soup of triangles, in units and at places where single precision alone would fail."""
    rng = np.random.default_rng(1)
    vertices = rng.normal(size=(60, 3)) * scale + shift
    faces = rng.permutation(60).reshape(20, 3)
    origins = rng.normal(size=(200, 3)) * 2 * scale + shift
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = RayCaster(vertices, faces).cast(origins, directions)
    expected = [first_hit_one_by_one(vertices[faces], o, d) for o, d in zip(origins, directions, strict=True)]
    assert 20 < sum(index >= 0 for _, index, _ in expected) < 180
    np.testing.assert_array_equal(hits.face, [index for _, index, _ in expected])
    np.testing.assert_allclose(hits.distance, [t for t, _, _ in expected], rtol=1e-6)
    np.testing.assert_allclose(hits.barycentric, [w for _, _, w in expected], atol=1e-5)


def test_hit_points_are_where_the_ray_says() -> None:
    """Law: origin + distance * direction equals the corners weighted by the barycentric coordinates."""
    mesh, camera = sphere_mesh(3, radius=2.0, centre=(10.0, -7.0, 3.0)), camera_at(np.array([0.0, -9.0, 2.0]))
    origins, directions = camera_rays(camera)
    origins = origins + np.array([10.0, -7.0, 3.0])
    hits = RayCaster(mesh.vertices, mesh.faces).cast(origins, directions)
    at = hits.hit
    assert at.sum() > 300
    by_corners = np.einsum("hk,hkd->hd", hits.barycentric[at], mesh.vertices[mesh.faces[hits.face[at]]])
    np.testing.assert_allclose(origins[at] + hits.distance[at, None] * directions[at], by_corners, atol=1e-7)
    assert np.isinf(hits.distance[~at]).all()


def test_rays_at_edges_do_not_leak() -> None:
    """Of rays aimed exactly at the middles of edges from inside a closed mesh, none escapes.

    At vertices single precision lets a few pass (0.3 % with `robust`, 25 % without).
    """
    mesh = sphere_mesh(5)
    edges = np.concatenate([mesh.faces[:, list(pair)] for pair in pairwise((0, 1, 2, 0))])
    for targets, tolerated in ((mesh.vertices[edges].mean(1), 0.0), (mesh.vertices, 0.01)):
        directions = targets / np.linalg.norm(targets, axis=1, keepdims=True)
        hits = RayCaster(mesh.vertices, mesh.faces).cast(np.zeros_like(directions), directions)
        assert (~hits.hit).mean() <= tolerated


def test_hits_on_the_border_stay_within_the_triangle_and_in_plane_rays_are_finite() -> None:
    triangle = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]] * 2)
    origins = np.array([[0.5, -1e-7, 2.0], [-3.0, 0.0, 0.0]])
    directions = np.array([[0.0, 0, -1], [1, 0, 0]])
    distance, weights = intersect_planes(triangle, origins, directions)
    np.testing.assert_allclose(distance, [2.0, 3.0])
    np.testing.assert_allclose(weights, [[0.5, 0.5, 0.0], [1.0, 0.0, 0.0]], atol=1e-6)
    assert weights.min() >= 0.0


def test_an_empty_mesh_is_missed() -> None:
    empty = RayCaster(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    ray = np.array([[0.0, 0.0, 1.0]])
    assert empty.cast(ray, ray).face.tolist() == [-1]
    assert not empty.blocked(ray, ray, np.array([9.0])).any()
    ball = sphere_mesh(1)
    none = np.zeros((0, 3))
    assert RayCaster(ball.vertices, ball.faces).cast(none, none).hit.shape == (0,)
    assert RayCaster(ball.vertices, ball.faces).blocked(none, none, np.zeros(0)).shape == (0,)


def test_camera_rays_project_back_to_their_pixel_centres() -> None:
    camera = camera_at(np.array([1.0, -4.0, 2.0]))
    origins, directions = camera_rays(camera)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, rtol=1e-12)
    points = (origins + 3.7 * directions) @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[
        :3, 3
    ]
    pixels = points @ camera.intrinsics.T
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    np.testing.assert_allclose(
        pixels[:, :2] / pixels[:, 2:], np.stack([columns, rows], -1).reshape(-1, 2), atol=1e-9
    )


def test_the_rays_that_fitting_uses_are_the_same() -> None:
    """Both definitions of a pixel's ray: numpy in the world frame here, torch in the object frame there."""
    camera = camera_at(np.array([1.0, -4.0, 2.0]))
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])
    region = Region(object_from_world=np.diag([0.25, 0.25, 0.25, 1.0]) @ turn)
    pinhole = pinhole_in_object(camera, region, torch.device("cpu"))
    theirs = ray_directions(pinhole, pixel_centres(camera.width, camera.height, torch.device("cpu")))
    theirs = torch.nn.functional.normalize(theirs, dim=-1).reshape(-1, 3).numpy()
    origins, directions = camera_rays(camera)
    np.testing.assert_allclose(theirs, directions @ turn[:3, :3].T, atol=1e-6)
    np.testing.assert_allclose(
        pinhole.position.numpy(), transform_points(region.object_from_world, origins[0]), atol=1e-6
    )


def test_a_rendered_sphere_is_the_analytic_one() -> None:
    """Silhouette, depth, normals, colour and support of a fine sphere, against ray-sphere intersection."""
    camera = camera_at(np.array([0.5, -4.0, 1.0]), focal_px=150.0, width=160, height=120)
    image = render_mesh(sphere_mesh(6), camera)
    origins, directions = camera_rays(camera)
    nearest = -(origins * directions).sum(1)
    miss = np.linalg.norm(origins + nearest[:, None] * directions, axis=1)
    coverage, inner = (miss < 1.0).reshape(120, 160), (miss < 0.98).reshape(120, 160)
    assert 0.1 < coverage.mean() < 0.5
    assert (image.coverage != coverage).mean() < 0.002
    distance = nearest - np.sqrt(np.clip(1 - miss**2, 0, None))
    points = (origins + distance[:, None] * directions).reshape(120, 160, 3)
    depth = points @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
    np.testing.assert_allclose(image.depth[inner], depth[inner], atol=2e-3)
    np.testing.assert_allclose(image.normal_world[inner], points[inner], atol=5e-3)
    np.testing.assert_allclose(image.colour_srgb[inner], (points[inner] + 1) / 2, atol=6e-3)
    np.testing.assert_allclose(image.support[inner], (points[inner, 2] + 1) / 2, atol=4e-3)
    assert np.isinf(image.depth[~image.coverage]).all()
    assert not image.colour_srgb[~image.coverage].any()


@pytest.mark.parametrize(
    ("distance", "aside", "covers"),
    [(4.0, 0.0, "some"), (4.0, 1.5, "some"), (0.2, 0.0, "all"), (4.0, 20.0, "none")],
)
def test_a_picture_shows_what_the_rays_of_all_its_pixels_meet(
    distance: float, aside: float, covers: str
) -> None:
    """From afar, with the ball over the edge, from within, and with it out of the picture."""
    mesh = sphere_mesh(4)
    camera = camera_at(np.array([0.0, -distance, 0.0]))
    moved = camera.camera_from_world.copy()
    moved[0, 3] += aside
    camera = replace(camera, camera_from_world=moved)
    image = render_mesh(mesh, camera)
    hits = RayCaster(mesh.vertices, mesh.faces).cast(*camera_rays(camera))
    np.testing.assert_array_equal(image.coverage.ravel(), hits.hit)
    assert {"none": not hits.hit.any(), "all": hits.hit.all(), "some": 0 < hits.hit.mean() < 1}[covers]
    along = camera_rays(camera)[1] @ camera.camera_from_world[2, :3]
    np.testing.assert_allclose(image.depth.ravel(), hits.distance * along, rtol=1e-6)


def test_a_coarse_white_mesh_is_white_and_its_interpolated_normals_are_unit() -> None:
    mesh = sphere_mesh(1)
    white = replace(mesh, colours_srgb=np.full_like(mesh.colours_srgb, 255))
    image = render_mesh(white, camera_at(np.array([0.5, -4.0, 1.0])))
    np.testing.assert_allclose(image.colour_srgb[image.coverage], 1.0, atol=1e-6)
    lengths = np.linalg.norm(image.normal_world[image.coverage], axis=1)
    np.testing.assert_allclose(lengths, 1.0, atol=1e-6)


def test_a_camera_sees_the_cap_of_a_sphere_in_front_of_its_horizon() -> None:
    """Analytic: from distance D, a point of the unit sphere is facing iff cos(angle) > 1 / D."""
    mesh, away = sphere_mesh(5), 3.0
    camera = camera_at(np.array([0.0, -away, 0.0]), focal_px=40.0)
    seen = visible_from(
        mesh.vertices, mesh.normals.astype(np.float64), [camera], RayCaster(mesh.vertices, mesh.faces)
    )[:, 0]
    cosine = -mesh.vertices[:, 1]
    towards = camera.position - mesh.vertices
    grazing = (towards * mesh.vertices).sum(1) / np.linalg.norm(towards, axis=1)
    assert seen[grazing > 0.06].all()
    assert not seen[cosine < 1 / away].any()


def test_what_is_covered_or_out_of_the_picture_is_not_seen() -> None:
    """A ball hides the middle of a wall; a camera behind the ball sees it; one behind the wall nothing."""
    wall = np.array([[-9.0, 0, -9], [9, 0, -9], [9, 0, 9], [-9, 0, 9]])
    ball = sphere_mesh(3, radius=0.5, centre=(0.0, -2.0, 0.0))
    vertices = np.concatenate([wall, ball.vertices])
    caster = RayCaster(vertices, np.concatenate([[[0, 1, 2], [0, 2, 3]], ball.faces + 4]))
    front, between = camera_at(np.array([0.0, -4.0, 0.0])), camera_at(np.array([0.0, -1.0, 0.0]))
    away = camera_at(np.array([0.0, 4.0, 0.0]))
    points = np.array([[0.0, 0, 0], [1.4, 0, 0.2], [8.0, 0, 0.0]])
    normals = np.tile([0.0, -1.0, 0.0], (3, 1))
    seen = visible_from(points, normals, [front, between, away], caster)
    np.testing.assert_array_equal(seen, [[False, True, False], [True, False, False], [False, False, False]])
    turned = visible_from(points, -normals, [front, between], caster)
    assert not turned.any()


def test_a_picture_of_800x600_takes_well_under_a_second() -> None:
    mesh = sphere_mesh(6)
    camera = camera_at(np.array([0.0, -3.0, 0.0]), focal_px=800.0, width=800, height=600)
    caster = RayCaster(mesh.vertices, mesh.faces)
    start = time.process_time()
    image = render_mesh(mesh, camera, caster=caster)
    assert image.coverage.mean() > 0.5
    assert time.process_time() - start < 2.0, "four times what two slow cores need"
