"""From a distance field that is known to the mesh: where it lies, which way it faces, what backs it."""

from dataclasses import replace
from functools import cache

import fast_simplification
import numpy as np
import pytest
import trimesh

from backend.errors import ErrorCode, ReconstructionError
from backend.maths.faces import face_areas
from backend.maths.raycast import render_mesh
from backend.scene import (
    DepthMap,
    Region,
    StereoResult,
    SurfaceMesh,
    SurfacePoints,
    no_progress,
    transform_points,
)
from backend.stages.mesh.extraction import (
    MeshConfig,
    extract_mesh,
    in_seen_pieces,
    level_set,
    only_used,
    simplified,
    support_of,
    vertex_normals,
    without_small_pieces,
)
from backend.stages.surface import Surface
from tests.synthetic_scene import (
    CENTRE,
    OBJECT_UNIT,
    SIZE,
    Scene,
    arc_cameras,
    camera_at,
    diagonal,
    photographed,
    surface_distance,
    texture_srgb,
    true_mesh,
    true_normals,
    true_region,
)

GRID_FROM_WORLD = true_region().object_from_world
NODES = 48
CELL = OBJECT_UNIT * 2 / (NODES - 1)
"""World units."""


def node_positions(nodes: int = NODES) -> np.ndarray:
    """World frame."""
    steps = np.linspace(-1, 1, nodes)
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1)
    return transform_points(np.linalg.inv(GRID_FROM_WORLD), grid.reshape(-1, 3) + 1e-9)


def surface_of(distance_world: np.ndarray) -> Surface:
    nodes = round(len(distance_world) ** (1 / 3))
    values = (distance_world / OBJECT_UNIT).astype(np.float32).reshape((nodes,) * 3)
    return Surface(distance=values, grid_from_world=GRID_FROM_WORLD)


def ball(centre: list[float], radius: float) -> np.ndarray:
    """Signed distances of the nodes to a ball given in SIZE from CENTRE."""
    apart = node_positions() - (CENTRE + SIZE * np.array(centre))
    return np.asarray(np.linalg.norm(apart, axis=1) - SIZE * radius)


def measured(points: np.ndarray, region: Region | None = None, edge_confidence: float = 0.0) -> StereoResult:
    """Stereo that measured these points of the body, with full confidence.

    In its depth maps the subject fills the middle; the right edge of the pictures has another confidence.
    """
    region = region or true_region()
    confidence = np.zeros((60, 80), np.float32)
    confidence[20:40, 20:60] = 1.0
    confidence[:, 72:] = edge_confidence
    depth_map = DepthMap(
        depth=np.where(confidence > 0, 3, 0).astype(np.float32),
        confidence=confidence,
        empty=None,
        subject=None,
    )
    count = len(points)
    found = SurfacePoints(
        positions=transform_points(region.object_from_world, points).astype(np.float32),
        normals=true_normals(points).astype(np.float32),
        colours_srgb=texture_srgb(points).astype(np.float32),
        confidence=np.ones(count, np.float32),
        num_views=np.full(count, 3),
        view_index=np.zeros(count, np.int64),
    )
    return StereoResult(points=found, depth_maps=(depth_map, depth_map))


def front_points() -> np.ndarray:
    """The truth's vertices on the side of the cameras (-y), one in three."""
    vertices = np.asarray(true_mesh().vertices)
    return np.asarray(vertices[vertices[:, 1] < CENTRE[1] - 0.2 * SIZE][::3])


@cache
def body_scene() -> Scene:
    return photographed(arc_cameras(3, 50, 160))


@cache
def body_surface() -> Surface:
    return surface_of(surface_distance(node_positions()))


@cache
def body_mesh() -> SurfaceMesh:
    return extract(body_scene(), body_surface(), measured(front_points()))


def extract(
    scene: Scene, surface: Surface, stereo: StereoResult, config: MeshConfig | None = None
) -> SurfaceMesh:
    return extract_mesh(
        scene.views, true_region(), stereo, surface, config or MeshConfig(), progress=no_progress
    )


def as_trimesh(vertices: np.ndarray, faces: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(vertices, faces, process=False)


# the level set


def test_the_level_set_lies_on_the_surface_in_the_world() -> None:
    vertices, _ = level_set(body_surface())
    assert np.abs(surface_distance(vertices)).max() < 0.05 * CELL
    np.testing.assert_allclose(np.ptp(vertices, axis=0), true_mesh().extents, atol=0.2 * CELL)


def test_the_level_set_is_closed_and_faces_outwards() -> None:
    mesh = as_trimesh(*level_set(body_surface()))
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(true_mesh().volume, rel=0.01)  # negative if turned inside out
    assert (np.asarray(mesh.face_normals) * true_normals(mesh.triangles_center)).sum(axis=1).min() > 0.9


@pytest.mark.parametrize("value", [-1.0, 1.0])
def test_a_field_without_a_zero_level_is_told(value: float) -> None:
    with pytest.raises(ReconstructionError) as raised:
        level_set(surface_of(np.full(NODES**3, value)))
    assert raised.value.code == ErrorCode.NO_SURFACE


# pieces


def test_areas_are_those_of_triangles() -> None:
    vertices = np.array([[0.0, 0, 0], [3, 0, 0], [0, 4, 0], [0, 0, 1]])
    np.testing.assert_allclose(face_areas(vertices, np.array([[0, 1, 2], [0, 3, 1]])), [6.0, 1.5])


def three_balls() -> tuple[np.ndarray, np.ndarray]:
    """Radius 1, 0.5 and 0.1, so areas as 1, 0.25 and 0.01."""
    balls = [trimesh.creation.icosphere(3, radius) for radius in (1.0, 0.5, 0.1)]
    for index, piece in enumerate(balls):
        piece.apply_translation([3.0 * index, 0, 0])
    joined = trimesh.util.concatenate(balls)
    assert isinstance(joined, trimesh.Trimesh)
    return np.asarray(joined.vertices, np.float64), np.asarray(joined.faces, np.int64)


@pytest.mark.parametrize(("smallest", "pieces"), [(0.005, 3), (0.02, 2), (0.3, 1)])
def test_pieces_are_kept_by_their_share_of_the_largest(smallest: float, pieces: int) -> None:
    vertices, faces = three_balls()
    kept = without_small_pieces(vertices, faces, smallest)
    assert as_trimesh(*only_used(vertices, kept)).body_count == pieces
    assert len(kept) == pieces * len(faces) // 3


def test_unused_vertices_go_and_the_shape_stays() -> None:
    vertices, faces = three_balls()
    chosen = faces[::7]
    fewer, renumbered = only_used(vertices, chosen)
    np.testing.assert_array_equal(fewer[renumbered], vertices[chosen])
    assert len(fewer) == len(np.unique(chosen))


def test_a_floating_piece_is_dropped() -> None:
    """A speck in a corner is gone, a second object of a third of the size is not."""
    speck, second = ball([0.95, 0.95, 0.95], 0.1), ball([0.0, -0.2, 0.95], 0.16)
    with_pieces = np.minimum(np.minimum(surface_distance(node_positions()), speck), second)
    config = MeshConfig(smallest_piece=0.015)
    mesh = extract(body_scene(), surface_of(with_pieces), measured(front_points()), config)
    assert as_trimesh(mesh.vertices, mesh.faces).body_count == 2
    assert np.linalg.norm(mesh.vertices - (CENTRE + 0.95 * SIZE), axis=1).min() > 0.3 * SIZE


def test_pieces_that_no_camera_sees_are_dropped_but_never_the_largest() -> None:
    """The smallest ball is seen whole, the middle one in a hundredth, the largest not at all."""
    vertices, faces = three_balls()
    ball_of = np.arange(len(vertices)) * 3 // len(vertices)
    seen = np.zeros((len(vertices), 2), bool)
    seen[ball_of == 2, 1] = True
    seen[np.flatnonzero(ball_of == 1)[::100], 0] = True
    # three balls have equally many faces: the first of them stands for the largest
    kept = in_seen_pieces(faces, seen)
    np.testing.assert_array_equal(kept, np.isin(ball_of[faces[:, 0]], [0, 2]))


def test_what_fills_the_masks_shadow_behind_the_body_is_dropped() -> None:
    """A large ball that the body hides from the only camera; the same ball beside the body stays."""
    scene = photographed(arc_cameras(1, 0, 160))
    for centre, pieces in (([0.0, 0.95, 0.0], 1), ([0.0, -0.2, 0.95], 2)):
        joined = surface_of(np.minimum(surface_distance(node_positions()), ball(centre, 0.2)))
        mesh = extract(scene, joined, measured(front_points()))
        assert as_trimesh(mesh.vertices, mesh.faces).body_count == pieces
        assert len(mesh.normals) == len(mesh.support) == len(mesh.colours_srgb) == len(mesh.vertices)


def test_what_only_photographs_without_masks_show_is_dropped_beside_others_that_have_some() -> None:
    """A ball beside the body, hidden by it from the cameras with masks and shown whole by one without."""
    cameras = [*arc_cameras(2, 4, 160), camera_at(75, 1.0, 160)]
    first, second, bare = photographed(cameras).views
    joined = surface_of(np.minimum(surface_distance(node_positions()), ball([0.0, 0.95, 0.0], 0.2)))
    for views, pieces in (
        ((first, second, replace(bare, mask=None)), 1),
        ((first, second, bare), 2),
        ((first, replace(second, mask=None), replace(bare, mask=None)), 2),
    ):
        mesh = extract(replace(photographed(cameras), views=views), joined, measured(front_points()))
        assert as_trimesh(mesh.vertices, mesh.faces).body_count == pieces


# simplification


@pytest.mark.parametrize("max_faces", [500, 3000])
def test_simplification_keeps_to_the_budget_closed_and_on_the_surface(max_faces: int) -> None:
    vertices, faces = simplified(*level_set(body_surface()), max_faces)
    mesh = as_trimesh(vertices, faces)
    assert 0.9 * max_faces < len(faces) <= max_faces
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(true_mesh().volume, rel=0.02)
    assert np.abs(surface_distance(vertices)).max() < 0.01 * diagonal()


def test_what_is_within_the_budget_is_not_touched() -> None:
    vertices, faces = level_set(body_surface())
    same_vertices, same_faces = simplified(vertices, faces, len(faces))
    np.testing.assert_array_equal(same_vertices, vertices)
    np.testing.assert_array_equal(same_faces, faces)


def test_simplification_far_from_the_origin_is_as_good() -> None:
    """Single precision at a hundred million units would round the whole body to one point."""
    vertices, faces = level_set(body_surface())
    far, fewer = simplified(vertices + 1e8, faces, 2000)
    assert len(fewer) <= 2000
    assert np.abs(surface_distance(far - 1e8)).max() < 0.01 * diagonal()
    assert as_trimesh(far, fewer).is_watertight


def test_where_the_collapse_opens_the_mesh_more_faces_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    simplify = fast_simplification.simplify

    def leaky(*mesh: np.ndarray, target_count: int, **options: object) -> tuple[np.ndarray, np.ndarray]:
        points, faces = simplify(*mesh, target_count=target_count, **options)
        return points, faces[1:] if target_count < 1500 else faces

    monkeypatch.setattr(fast_simplification, "simplify", leaky)
    vertices, faces = simplified(*level_set(body_surface()), 500)
    assert as_trimesh(vertices, faces).is_watertight
    assert 1500 < len(faces) <= 2000


def test_a_foam_is_given_up_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """A field that has learned next to nothing crosses zero everywhere: no collapse leaves that closed."""
    asked = []

    def never(
        vertices: np.ndarray, faces: np.ndarray, *, target_count: int, **_: object
    ) -> tuple[np.ndarray, np.ndarray]:
        asked.append(target_count)
        return vertices, faces[1:]

    monkeypatch.setattr(fast_simplification, "simplify", never)
    whole = level_set(body_surface())
    assert len(whole[1]) > 7705
    _, faces = simplified(*whole, 500)
    assert len(faces) == len(whole[1])
    assert asked == [500, 600, 864, 1792, 7705]


# normals


def test_normals_of_a_box_point_out_of_its_corners() -> None:
    box = trimesh.creation.box()
    corners = np.asarray(box.vertices, np.float64)
    normals = vertex_normals(corners, np.asarray(box.faces, np.int64))
    assert (normals * np.sign(corners)).min() > 0
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)


def test_mesh_normals_are_the_surface_s() -> None:
    mesh = body_mesh()
    assert (mesh.normals * true_normals(mesh.vertices)).sum(axis=1).min() > np.cos(np.deg2rad(6))


# support


def test_support_is_seven_tenths_measured_and_three_tenths_seen() -> None:
    vertices = np.array([[0.0, 0, 0], [100, 0, 0]])
    many = np.zeros((8, 3))
    sure = np.ones(8, np.float32)
    for seen, expected in (
        (np.zeros((2, 3), bool), [0.7, 0.0]),
        (np.ones((2, 3), bool), [1.0, 0.3]),
    ):
        support = support_of(vertices, seen, many, sure, 1.0)
        np.testing.assert_allclose(support, expected, atol=0.02)


def test_support_grows_with_every_kind_of_evidence() -> None:
    """One vertex; more cameras, more points, nearer points and surer points each back it better."""

    def support(cameras: int, points: int, apart: float, confidence: float) -> float:
        seen = np.arange(4)[None] < cameras
        positions = np.full((points, 3), [apart, 0.0, 0.0])
        found = support_of(np.zeros((1, 3)), seen, positions, np.full(points, confidence, np.float32), 1.0)
        return float(found[0])

    before = support(1, 1, 1.0, 0.5)
    assert 0 < before < 1
    for more in ((2, 1, 1.0, 0.5), (1, 2, 1.0, 0.5), (1, 1, 0.5, 0.5), (1, 1, 1.0, 0.6)):
        assert support(*more) > before + 0.01


def test_support_tells_the_measured_front_from_the_guessed_back() -> None:
    mesh = body_mesh()
    front = mesh.vertices[:, 1] < CENTRE[1] - 0.3 * SIZE
    back = mesh.vertices[:, 1] > CENTRE[1] + 0.3 * SIZE
    assert np.quantile(mesh.support[front], 0.05) > 0.7
    assert mesh.support[back].max() < 0.1
    assert mesh.support.min() >= 0
    assert mesh.support.max() <= 1


def test_surface_hidden_behind_another_part_is_not_seen() -> None:
    """A ball behind the body, joined to it by a rod, faces the camera, but the body covers it."""
    world = (node_positions() - CENTRE) / SIZE
    rod = np.maximum(np.hypot(world[:, 0], world[:, 2]) - 0.12, np.abs(world[:, 1] - 0.6) - 0.3) * SIZE
    behind = np.minimum(rod, ball([0.0, 0.95, 0.0], 0.2))
    surface = surface_of(np.minimum(surface_distance(node_positions()), behind))
    mesh = extract(photographed(arc_cameras(1, 0, 160)), surface, measured(front_points()))
    hidden = mesh.vertices[:, 1] > CENTRE[1] + 0.78 * SIZE
    assert hidden.sum() > 20
    assert mesh.support[hidden].max() < 0.05


# colours


def test_seen_vertices_have_the_texture_s_colours() -> None:
    mesh = body_mesh()
    seen = mesh.support > 0.8
    apart = np.abs(mesh.colours_srgb[seen] / 255.0 - texture_srgb(mesh.vertices[seen]))
    assert np.median(apart) < 0.03
    # a colour from elsewhere would be off by as much as two places of the texture differ
    assert (
        np.abs(texture_srgb(mesh.vertices) - np.roll(texture_srgb(mesh.vertices), 999, axis=0)).mean() > 0.15
    )


def test_drawn_from_a_camera_the_mesh_looks_like_the_photograph() -> None:
    view = body_scene().views[1]
    drawn = render_mesh(body_mesh(), view.camera)
    both = drawn.coverage & body_scene().coverage[1]
    assert both.sum() > 0.97 * (drawn.coverage | body_scene().coverage[1]).sum()
    squared = ((drawn.colour_srgb - view.image_srgb)[both] ** 2).mean()
    assert -10 * np.log10(squared) > 20


def test_unseen_vertices_get_a_mixture_of_what_is_seen() -> None:
    scene = body_scene()
    red = np.array([0.8, 0.2, 0.1], np.float32)
    painted = tuple(
        replace(view, image_srgb=np.broadcast_to(red, view.image_srgb.shape)) for view in scene.views
    )
    mesh = extract(replace(scene, views=painted), body_surface(), measured(front_points()))
    np.testing.assert_allclose(
        mesh.colours_srgb / 255.0, np.broadcast_to(red, mesh.vertices.shape), atol=0.01
    )


# open and closed


def back_side(mesh: SurfaceMesh) -> list[str]:
    """What was decided about it, if anything."""
    return [decision.choice for decision in mesh.decisions if decision.what == "back side"]


def test_a_closed_object_without_masks_stays_closed() -> None:
    roomy = Region(object_from_world=np.diag([0.75, 0.75, 0.75, 1]) @ true_region().object_from_world)
    stereo = measured(front_points(), roomy)
    views = body_scene().without_masks().views
    mesh = extract_mesh(views, roomy, stereo, body_surface(), MeshConfig(), progress=no_progress)
    assert as_trimesh(mesh.vertices, mesh.faces).is_watertight
    assert back_side(mesh) == ["closed smoothly"]


def floor_surface() -> Surface:
    """A slab through the region's middle that ends only at its rim: a piece of a larger scene."""
    world = node_positions()
    flat = np.abs(world[:, 2] - CENTRE[2]) - 0.3 * SIZE
    return surface_of(np.maximum(flat, np.linalg.norm(world - CENTRE, axis=1) - 1.15 * SIZE))


def floor_points() -> np.ndarray:
    steps = np.linspace(-1.2, 1.2, 80) * SIZE
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps))
    points = np.stack([x, y, np.full_like(x, 0.3 * SIZE)], axis=-1)
    return CENTRE + points[np.hypot(x, y) < 1.1 * SIZE]


def test_a_piece_of_a_larger_scene_loses_its_back() -> None:
    stereo = measured(floor_points(), edge_confidence=0.6)
    mesh = extract(body_scene().without_masks(), floor_surface(), stereo)
    assert back_side(mesh) == ["cut off"]
    assert (mesh.vertices[:, 2] > CENTRE[2] - 0.25 * SIZE).all()  # the bottom lies at -0.3
    cut = as_trimesh(mesh.vertices, mesh.faces)
    assert not cut.is_watertight
    rim = cut.edges_sorted[trimesh.grouping.group_rows(cut.edges_sorted, require_count=1)]
    assert mesh.vertices[np.unique(rim), 2].std() < 0.3 * CELL  # across faces, not along their edges
    whole = face_areas(*level_set(floor_surface())).sum()
    assert np.pi * (1.1 * SIZE) ** 2 < face_areas(mesh.vertices, mesh.faces).sum() < 0.75 * whole
    lengths = {len(mesh.vertices), len(mesh.normals), len(mesh.colours_srgb), len(mesh.support)}
    assert lengths == {mesh.faces.max() + 1}


def test_what_is_cut_off_takes_none_of_the_faces() -> None:
    stereo, few = measured(floor_points(), edge_confidence=0.6), MeshConfig(max_faces=1500, textured=False)
    mesh = extract(body_scene().without_masks(), floor_surface(), stereo, few)
    assert back_side(mesh) == ["cut off"]
    assert 0.85 * 1500 < len(mesh.faces) < 1.15 * 1500


def test_support_reaches_as_far_as_the_surface_says() -> None:
    stereo, quick = measured(front_points()), MeshConfig(textured=False)
    near = extract(body_scene(), body_surface(), stereo, quick).support
    far = extract(body_scene(), replace(body_surface(), reach_cells=3.0), stereo, quick).support
    assert (far >= near - 1e-6).all()
    assert (far > near + 0.2).any()


@pytest.mark.parametrize(("edge_confidence", "choice"), [(0.2, "closed smoothly"), (0.5, "cut off")])
def test_only_sure_measurements_at_the_edges_open_a_scene(edge_confidence: float, choice: str) -> None:
    stereo = measured(floor_points(), edge_confidence=edge_confidence)
    mesh = extract(body_scene().without_masks(), floor_surface(), stereo)
    assert back_side(mesh) == [choice]


def test_with_masks_nothing_is_cut() -> None:
    mesh = extract(body_scene(), floor_surface(), measured(floor_points()))
    assert as_trimesh(mesh.vertices, mesh.faces).is_watertight
    assert back_side(mesh) == []
