"""The texture: what the photographs show at each place of the surface, whatever the vertices hold."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from jaxtyping import Float64

from backend.kernels.side_by_side import BAND
from backend.maths.atlas import faces_at
from backend.maths.exposure import evened
from backend.maths.metrics import psnr
from backend.maths.pieces import connected_pieces
from backend.maths.projection import projected
from backend.maths.raycast import RayCaster, interpolate, render_mesh, visible_from
from backend.scene import Camera, SurfaceMesh, Texture, View
from backend.stages.mesh import texture as stage
from backend.stages.mesh.extraction import simplified, vertex_normals
from backend.stages.mesh.texture import TextureConfig, bleed, paint
from tests.synthetic_scene import arc_cameras, photographed, texture_srgb, true_mesh

MARKER = np.array([255, 0, 255], np.uint8)
"""A colour that no photograph has."""


@cache
def views(count: int = 3) -> tuple[View, ...]:
    return photographed(arc_cameras(count, 40 * (count > 1), 320)).views


@cache
def body() -> SurfaceMesh:
    """The true surface in a few thousand triangles, its vertices in the marker's colour."""
    truth = true_mesh()
    vertices, faces = simplified(np.asarray(truth.vertices), np.asarray(truth.faces, np.int64), 4000)
    return SurfaceMesh(
        vertices=vertices,
        faces=faces,
        normals=vertex_normals(vertices, faces).astype(np.float32),
        colours_srgb=np.tile(MARKER, (len(vertices), 1)),
        support=np.zeros(len(vertices), np.float32),
    )


def seen_by(mesh: SurfaceMesh, given: tuple[View, ...]) -> np.ndarray:
    caster = RayCaster(mesh.vertices, mesh.faces)
    normals = mesh.normals.astype(np.float64)
    return visible_from(mesh.vertices, normals, [view.camera for view in given], caster)


def painted(
    given: tuple[View, ...] | None = None,
    mesh: SurfaceMesh | None = None,
    log_exposures: np.ndarray | None = None,
    max_side_px: int = 4096,
) -> Texture:
    given, mesh = given or views(), mesh or body()
    none = np.zeros((len(given), 3))
    exposures = none if log_exposures is None else log_exposures
    config = TextureConfig(max_side_px=max_side_px)
    return paint(mesh, seen_by(mesh, given), given, None, exposures, config)[0]


def texel_places(
    texture: Texture, mesh: SurfaceMesh
) -> tuple[np.ndarray, Float64[np.ndarray, "texels 3"], Float64[np.ndarray, "texels 3"]]:
    """Face, place in the world and colour (0 to 1) of each texel that is one."""
    height, width = texture.image_srgb.shape[:2]
    texels = faces_at(texture.corners_px, width, height)
    places = interpolate(mesh.vertices, mesh.faces[texels.face], texels.barycentric())
    return texels.face, places, texture.image_srgb[texels.covered] / 255.0


def test_texels_have_the_colours_of_the_surface() -> None:
    face, places, colours = texel_places(painted(), body())
    shown = seen_by(body(), views())[body().faces].all(axis=1).any(axis=1)[face]
    apart = np.abs(colours - texture_srgb(places))[shown]
    assert shown.mean() > 0.7
    assert np.median(apart) < 0.01
    assert np.quantile(apart, 0.99) < 0.1


def test_drawn_it_repeats_photographs_far_better_than_the_vertices_can() -> None:
    mesh = body()
    known = np.round(255 * texture_srgb(mesh.vertices)).astype(np.uint8)
    between = photographed(arc_cameras(4, 40, 320)).views[1]

    def fit(drawn: SurfaceMesh) -> float:
        image = render_mesh(drawn, between.camera)
        found = psnr(between.image_srgb, image.colour_srgb, image.coverage & (between.mask > 0.5))
        assert found is not None
        return found

    of_vertices = fit(replace(mesh, colours_srgb=known))
    assert fit(replace(mesh, colours_srgb=known, texture=painted())) > of_vertices + 6


def test_surface_that_no_photograph_shows_has_the_colours_of_the_vertices() -> None:
    face, _, colours = texel_places(painted(), body())
    hidden = ~seen_by(body(), views())[body().faces].all(axis=1).any(axis=1)[face]
    assert hidden.sum() > 500
    np.testing.assert_array_equal(colours[hidden], np.broadcast_to(MARKER / 255, (hidden.sum(), 3)))


def test_faces_lie_apart_and_away_from_the_border() -> None:
    texture = painted()
    height, width = texture.image_srgb.shape[:2]
    assert texture.corners_px.min() >= 2
    assert (texture.corners_px.max(axis=(0, 1)) <= [width - 2, height - 2]).all()
    a, b, c = np.moveaxis(texture.corners_px.astype(np.float64), 1, 0)
    (abx, aby), (acx, acy) = (b - a).T, (c - a).T
    areas = np.abs(abx * acy - aby * acx) / 2
    covered = faces_at(texture.corners_px, width, height).covered
    # faces on top of each other would cover less than their areas together
    assert covered.sum() == pytest.approx(areas.sum(), rel=0.005)


def test_a_texel_is_a_pixel_of_the_photograph_that_shows_its_face_largest() -> None:
    (view,) = views(1)
    texture = painted((view,))
    shown = seen_by(body(), (view,))[body().faces].all(axis=1)[:, 0]
    pixels, _ = projected(body().vertices, view.camera)
    moved = texture.corners_px[shown] - pixels[body().faces[shown]]
    np.testing.assert_allclose(moved, moved[:, :1].repeat(3, axis=1), atol=1e-3)
    np.testing.assert_allclose(moved, np.round(moved), atol=1e-3)  # whole pixels: nothing is blurred


def test_a_small_picture_holds_all_of_it_at_a_smaller_scale() -> None:
    small = painted(max_side_px=128)
    assert max(small.image_srgb.shape[:2]) <= 128
    face, places, colours = texel_places(small, body())
    shown = seen_by(body(), views())[body().faces].all(axis=1).any(axis=1)[face]
    assert np.median(np.abs(colours - texture_srgb(places))[shown]) < 0.02
    full, few = np.ptp(painted().corners_px, axis=1), np.ptp(small.corners_px, axis=1)
    ratio = few.sum() / full.sum()
    assert ratio < 0.5
    np.testing.assert_allclose(few, ratio * full, atol=0.02 * few.max())


def test_what_is_beside_a_chart_is_like_it() -> None:
    """What is drawn between texels, or from afar, must not bring in another colour."""
    texture = painted()
    height, width = texture.image_srgb.shape[:2]
    covered = faces_at(texture.corners_px, width, height).covered
    beside = ~covered[1:-1, 1:-1] & covered[1:-1, 2:]
    jump = np.abs(texture.image_srgb[1:-1, 1:-1].astype(int) - texture.image_srgb[1:-1, 2:])[beside]
    assert np.median(jump) == 0


def test_colours_go_on_from_the_nearest_texel_as_if_the_picture_were_one_piece() -> None:
    rng = np.random.default_rng(0)
    height, width = 3 * BAND + 5, 90  # the last rows' nearest texels lie beyond their own
    covered = rng.random((height, width)) < 0.002
    covered[: BAND + 40] &= rng.random((BAND + 40, 1)) < 0.02  # whole bands without any
    colours = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    colours[~covered] = 0
    found = colours.copy()
    bleed(found, covered)
    np.testing.assert_array_equal(found[covered], colours[covered])
    texels = np.argwhere(covered)
    for place in np.argwhere(~covered)[::7]:
        away = np.linalg.norm(texels - place, axis=1)
        of_nearest = colours[tuple(texels[np.isclose(away, away.min())].T)]
        expected = of_nearest if away.min() <= 16 else np.full((1, 3), 128)
        assert (expected == found[tuple(place)]).all(axis=1).any()


def test_photographs_are_brought_to_one_exposure() -> None:
    by = np.log(2.0) * np.array([[0.5, 0.4, 0.5], [-0.3, -0.2, -0.4], [0.0, 0.0, 0.0]])
    brighter = tuple(
        replace(
            view,
            image_srgb=evened(view.image_srgb.reshape(-1, 3).astype(np.float64), -log)
            .reshape(view.image_srgb.shape)
            .astype(np.float32),
        )
        for view, log in zip(views(), by, strict=True)
    )
    alike, found = painted(), painted(brighter, log_exposures=by)
    apart = np.abs(found.image_srgb.astype(int) - alike.image_srgb)
    assert apart.mean() < 1
    unlike = painted(brighter)
    assert np.abs(unlike.image_srgb.astype(int) - alike.image_srgb).mean() > 5 * apart.mean()


def test_a_photograph_fades_out_where_it_stops_seeing() -> None:
    """Two photographs in two colours: no step as large as between them at the end of what one sees."""
    one, two = views(3)[0], views(3)[2]
    red, blue = np.array([0.9, 0.1, 0.1], np.float32), np.array([0.1, 0.1, 0.9], np.float32)
    given = tuple(
        replace(view, image_srgb=np.broadcast_to(colour, view.image_srgb.shape).copy())
        for view, colour in ((one, red), (two, blue))
    )
    texture = painted(given)
    mesh = replace(body(), texture=texture)
    drawn = render_mesh(mesh, views(3)[1].camera)
    inside = drawn.coverage[:, 1:] & drawn.coverage[:, :-1]
    step = np.abs(np.diff(drawn.colour_srgb[..., 0], axis=1))[inside]
    assert np.quantile(step, 0.995) < 0.2
    assert np.ptp(drawn.colour_srgb[..., 0][drawn.coverage]) > 0.5


def test_the_same_photographs_give_the_same_texture() -> None:
    one, two = painted(), painted()
    np.testing.assert_array_equal(one.image_srgb, two.image_srgb)
    np.testing.assert_array_equal(one.corners_px, two.corners_px)


def test_a_mesh_that_no_photograph_shows_is_laid_out_all_the_same() -> None:
    unseen, config = np.zeros((len(body().vertices), 3), bool), TextureConfig(max_side_px=512)
    texture, decision = paint(body(), unseen, views(), None, np.zeros((3, 3)), config)
    height, width = texture.image_srgb.shape[:2]
    assert (decision.what, decision.choice) == ("texture", f"{width} x {height}")
    assert max(texture.image_srgb.shape[:2]) <= 512
    _, _, colours = texel_places(texture, body())
    np.testing.assert_array_equal(colours, np.broadcast_to(MARKER / 255, colours.shape))


def plane(cells: int = 20) -> SurfaceMesh:
    """A square in y = 0, 2 wide, that faces -y, as a grid."""
    x, z = np.meshgrid(np.linspace(-1, 1, cells + 1), np.linspace(-1, 1, cells + 1))
    corner = np.arange((cells + 1) * cells).reshape(cells, cells + 1)[:, :-1].ravel()
    halves = ([0, 1, cells + 2], [0, cells + 2, cells + 1])
    count = (cells + 1) ** 2
    return SurfaceMesh(
        vertices=np.stack([x.ravel(), np.zeros(count), z.ravel()], axis=-1),
        faces=np.concatenate([corner[:, None] + half for half in halves]),
        normals=np.tile(np.float32([0, -1, 0]), (count, 1)),
        colours_srgb=np.tile(MARKER, (count, 1)),
        support=np.zeros(count, np.float32),
    )


def facing_the_plane(x: float, grey: float) -> View:
    """A photograph of one grey, taken from (x, -4, 0)."""
    camera = Camera(
        camera_from_world=np.array([[1, 0, 0, -x], [0, 0, -1, 0], [0, 1, 0, 4], [0, 0, 0, 1]], np.float64),
        fx_px=400.0,
        fy_px=400.0,
        cx_px=160.0,
        cy_px=160.0,
        width=320,
        height=320,
    )
    return View(
        name=f"{x}.png", camera=camera, image_srgb=np.full((320, 320, 3), grey, np.float32), mask=None
    )


def test_where_something_hides_a_photograph_it_ends_without_a_step() -> None:
    mesh, given = plane(), (facing_the_plane(-0.1, 0.2), facing_the_plane(0.1, 0.8))
    seen = np.ones((len(mesh.vertices), 2), bool)
    seen[mesh.vertices[:, 0] > 0.001, 1] = False
    texture, _ = paint(mesh, seen, given, None, np.zeros((2, 3)), TextureConfig())
    drawn = render_mesh(replace(mesh, texture=texture), facing_the_plane(0, 0).camera).colour_srgb[
        160, 80:240
    ]
    middle, one = drawn[:60, 0].mean(), drawn[100:, 0].mean()
    assert middle == pytest.approx(0.5, abs=0.02)
    assert one == pytest.approx(0.2, abs=0.01)
    assert np.abs(np.diff(drawn[5:-5, 0])).max() < 0.06  # the whole 0.3 over a cell of ten pixels


def num_charts(texture: Texture, mesh: SurfaceMesh) -> int:
    """Pieces in which faces share corners of the surface at one place of the texture."""
    keys = np.column_stack([mesh.faces.ravel(), np.round(texture.corners_px.reshape(-1, 2) * 16)])
    _, corner = np.unique(keys, axis=0, return_inverse=True)
    corner = corner.reshape(-1, 3)
    pairs = np.concatenate([corner[:, :2], corner[:, 1:]]).T
    return len(np.unique(connected_pieces(pairs, int(corner.max()) + 1)))


def test_faces_ask_their_neighbours_for_the_best_photograph(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = num_charts(painted(), body())
    monkeypatch.setattr(stage, "_SPREAD_ROUNDS", 0)
    assert asked < 0.8 * num_charts(painted(), body())


@pytest.mark.parametrize(("mask", "counts"), [(0.45, False), (0.55, True)])
def test_pixels_that_are_half_off_the_subject_do_not_count(mask: float, counts: bool) -> None:
    view = facing_the_plane(0, 0.5)
    given = (replace(view, mask=np.full((320, 320), mask, np.float32)),)
    mesh = plane()
    seen = np.ones((len(mesh.vertices), 1), bool)
    texture, _ = paint(mesh, seen, given, None, np.zeros((1, 3)), TextureConfig())
    _, _, colours = texel_places(texture, mesh)
    expected = np.full(3, 128) if counts else MARKER
    np.testing.assert_allclose(255 * colours, np.broadcast_to(expected, colours.shape), atol=1)


def test_a_texture_finer_than_the_picture_is_drawn_as_its_mean() -> None:
    mesh = plane(1)
    fine = np.zeros((512, 512, 3), np.uint8)
    fine[::2, ::2] = fine[1::2, 1::2] = 200  # a chequerboard of single texels
    corners = 256 + 255 * mesh.vertices[mesh.faces][..., [0, 2]] * [1, -1]
    textured = replace(mesh, texture=Texture(image_srgb=fine, corners_px=corners.astype(np.float32)))
    camera = facing_the_plane(0, 0).camera.resized(80, 80)
    drawn = render_mesh(textured, camera)
    assert drawn.colour_srgb[drawn.coverage] == pytest.approx(100 / 255, abs=0.05)
