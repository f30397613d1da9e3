"""The texture: what the photographs show at each place of the surface, whatever the vertices hold."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from jaxtyping import Float64

from backend.maths.atlas import faces_at
from backend.maths.exposure import evened
from backend.maths.metrics import psnr
from backend.maths.projection import projected
from backend.maths.raycast import RayCaster, interpolate, render_mesh, visible_from
from backend.scene import SurfaceMesh, Texture, View
from backend.stages.mesh import simplified, vertex_normals
from backend.stages.texture import TextureConfig, paint
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
    return paint(mesh, seen_by(mesh, given), given, None, exposures, TextureConfig(max_side_px=max_side_px))


def texel_places(
    texture: Texture, mesh: SurfaceMesh
) -> tuple[np.ndarray, Float64[np.ndarray, "texels 3"], Float64[np.ndarray, "texels 3"]]:
    """Face, place in the world and colour (0 to 1) of each texel that is one."""
    height, width = texture.image_srgb.shape[:2]
    texels = faces_at(texture.corners_px, width, height)
    places = interpolate(mesh.vertices, mesh.faces[texels.face], texels.barycentric)
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
    texture = paint(body(), unseen, views(), None, np.zeros((3, 3)), config)
    assert max(texture.image_srgb.shape[:2]) <= 512
    _, _, colours = texel_places(texture, body())
    np.testing.assert_array_equal(colours, np.broadcast_to(MARKER / 255, colours.shape))
