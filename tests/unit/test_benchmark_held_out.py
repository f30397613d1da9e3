"""The mesh against photographs it was not made from: differences known in advance."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from backend.benchmark.held_out import held_out_fit, held_out_radiance_fit, known_views
from backend.benchmark.suites import Case
from backend.maths.raycast import render_mesh
from backend.scene import Camera, Region, SurfaceMesh, View
from backend.stages.published.radiance_field import RadianceField, kept
from backend.stages.radiance import RadianceShape
from tests.synthetic_scene import photographed, ring_cameras, write_scene

GREY = 102
"""Of 255: 0.4 to the bit of a test's tolerance."""


def grey_ball() -> SurfaceMesh:
    ball = trimesh.creation.icosphere(3, 1.0)
    return SurfaceMesh(
        vertices=np.asarray(ball.vertices),
        faces=np.asarray(ball.faces, np.int64),
        normals=np.asarray(ball.vertex_normals, np.float32),
        colours_srgb=np.full((len(ball.vertices), 3), GREY, np.uint8),
        support=np.ones(len(ball.vertices), np.float32),
    )


def camera() -> Camera:
    """Four units before the ball, which fills about a quarter of the picture."""
    camera_from_world = np.eye(4)
    camera_from_world[2, 3] = 4.0
    sizes = {"width": 64, "height": 48}
    return Camera(
        camera_from_world=camera_from_world, fx_px=60.0, fy_px=60.0, cx_px=32.0, cy_px=24.0, **sizes
    )


def view_of(value: float, mask: np.ndarray | None) -> View:
    """A photograph of one brightness everywhere."""
    image = np.full((48, 64, 3), value, np.float32)
    return View(name="a", camera=camera(), image_srgb=image, mask=mask)


def coverage() -> np.ndarray:
    return render_mesh(grey_ball(), camera()).coverage


@pytest.mark.parametrize("masked", [True, False])
def test_a_tenth_too_bright_is_twenty_decibels(masked: bool) -> None:
    mask = coverage().astype(np.float32) if masked else None
    fit = held_out_fit(grey_ball(), [view_of(0.5, mask)])
    assert fit.psnr_db == pytest.approx(20.0, abs=1e-3)
    assert fit.covered_share == pytest.approx(1.0 if masked else coverage().mean())


def test_surface_that_is_missing_counts_as_black() -> None:
    """Where the mask covers everything, the picture is the ball's 0.4, and off the ball 0."""
    fit = held_out_fit(grey_ball(), [view_of(0.4, np.ones((48, 64), np.float32))])
    share = coverage().mean()
    assert fit.psnr_db == pytest.approx(-10 * np.log10((1 - share) * 0.4**2), abs=1e-3)
    assert fit.covered_share == pytest.approx(share)


def test_several_views_count_alike() -> None:
    mask = coverage().astype(np.float32)
    fit = held_out_fit(grey_ball(), [view_of(0.5, mask), view_of(0.41, mask)])
    assert fit.psnr_db == pytest.approx((20.0 + 40.0) / 2, abs=1e-2)


def test_an_empty_mask_has_no_number() -> None:
    fit = held_out_fit(grey_ball(), [view_of(0.5, np.zeros((48, 64), np.float32))])
    assert fit.psnr_db is None
    assert fit.covered_share == 0.0


def test_the_views_are_those_that_are_asked_for(tmp_path: Path) -> None:
    scene = photographed(ring_cameras(5, 48))
    write_scene(scene, tmp_path)
    case = Case(name="a", folder="a", given=(0, 2, 4), held_out=(1, 3), cameras="images/transforms.json")
    found = known_views(case, tmp_path, case.held_out)
    assert [view.name for view in found] == [scene.views[index].name for index in (1, 3)]
    for view, index in zip(found, (1, 3), strict=True):
        np.testing.assert_allclose(
            view.camera.camera_from_world, scene.cameras[index].camera_from_world, atol=1e-9
        )
        assert view.mask is not None


def test_a_radiance_field_is_measured_by_its_own_pictures() -> None:
    """Opaque and black in the unit sphere: 20 dB from a photograph of brightness 0.1."""
    field = RadianceField(RadianceShape(width=8, layers=1), torch.Generator().manual_seed(0))
    with torch.no_grad():
        field.density_head[0].bias.fill_(100.0)
        field.colour_head[-1].bias.fill_(-100.0)
    radiance = kept(field, Region(object_from_world=np.eye(4)), None)
    fit = held_out_radiance_fit(radiance, [view_of(0.1, None)], torch.device("cpu"))
    assert fit.psnr_db == pytest.approx(20.0, abs=1e-3)
    assert fit.covered_share == pytest.approx(coverage().mean(), rel=0.05)
    masked = held_out_radiance_fit(
        radiance, [view_of(0.1, coverage().astype(np.float32))], torch.device("cpu")
    )
    assert masked.covered_share > 0.98
