"""Blender's lens settings and pinholes: closed forms, inverses, and what Blender has no lens for."""

from dataclasses import asdict, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from addon.intrinsics import (
    LensSettings,
    Pinhole,
    Raster,
    aspect_pair,
    pinhole_from_settings,
    rendered_size,
    settings_from_pinhole,
    shared_aspect_or_none,
)

LANDSCAPE = Raster(width=800, height=600)
PORTRAIT = Raster(width=600, height=800)


@st.composite
def pinholes(draw: st.DrawFn) -> Pinhole:
    width, height = draw(st.integers(16, 8000)), draw(st.integers(16, 8000))
    fx = width * draw(st.floats(0.1, 20.0))
    return Pinhole(
        fx_px=fx,
        fy_px=fx / draw(st.floats(0.5, 2.0)),
        cx_px=width * draw(st.floats(-0.5, 1.5)),
        cy_px=height * draw(st.floats(-0.5, 1.5)),
        width=width,
        height=height,
    )


@given(pinhole=pinholes())
def test_settings_and_back_is_the_same_pinhole(pinhole: Pinhole) -> None:
    aspect_x, aspect_y = aspect_pair(pinhole.pixel_aspect)
    raster = Raster(width=pinhole.width, height=pinhole.height, aspect_x=aspect_x, aspect_y=aspect_y)
    found = pinhole_from_settings(settings_from_pinhole(pinhole), raster)
    assert asdict(found) == pytest.approx(asdict(pinhole), rel=1e-9, abs=1e-9)


@given(pinhole=pinholes(), scene_aspect=st.floats(0.5, 2.0))
def test_in_a_scene_of_another_aspect_all_but_fy_is_right(pinhole: Pinhole, scene_aspect: float) -> None:
    aspect_x, aspect_y = aspect_pair(scene_aspect)
    raster = Raster(width=pinhole.width, height=pinhole.height, aspect_x=aspect_x, aspect_y=aspect_y)
    found = pinhole_from_settings(settings_from_pinhole(pinhole, pixel_aspect=scene_aspect), raster)
    expected = replace(pinhole, fy_px=pinhole.fx_px / scene_aspect)
    assert asdict(found) == pytest.approx(asdict(expected), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(
    ("lens", "raster", "focal_px"),
    [
        (LensSettings(lens_mm=36, sensor_fit="HORIZONTAL"), LANDSCAPE, 800),
        (LensSettings(lens_mm=36, sensor_fit="HORIZONTAL"), PORTRAIT, 600),
        (LensSettings(lens_mm=24, sensor_fit="VERTICAL"), LANDSCAPE, 600),
        (LensSettings(lens_mm=24, sensor_fit="VERTICAL"), PORTRAIT, 800),
        (LensSettings(lens_mm=36, sensor_fit="AUTO"), LANDSCAPE, 800),
        (LensSettings(lens_mm=36, sensor_fit="AUTO"), PORTRAIT, 800),
    ],
)
def test_a_lens_as_long_as_the_sensor_sees_a_right_angle_halved(
    lens: LensSettings, raster: Raster, focal_px: float
) -> None:
    """Along the side that it is fitted to, the focal length in pixels is then that side."""
    found = pinhole_from_settings(lens, raster)
    assert (found.fx_px, found.fy_px) == pytest.approx((focal_px, focal_px))
    assert (found.cx_px, found.cy_px) == (raster.width / 2, raster.height / 2)


def test_wide_pixels_decide_what_auto_fits() -> None:
    """600 x 800 pixels of twice the width are a landscape."""
    raster = Raster(width=600, height=800, aspect_x=2.0)
    found = pinhole_from_settings(LensSettings(lens_mm=36, sensor_fit="AUTO"), raster)
    assert (found.fx_px, found.fy_px) == pytest.approx((600, 1200))


def test_a_shift_by_one_moves_the_middle_by_the_fitted_side() -> None:
    found = pinhole_from_settings(LensSettings(lens_mm=50, shift_x=1.0, shift_y=1.0), LANDSCAPE)
    assert (found.cx_px, found.cy_px) == pytest.approx((400 - 800, 300 + 800))


def test_fractions_of_a_pixel_are_cut_off() -> None:
    assert rendered_size(1921, 1080, 33) == (633, 356)
    assert rendered_size(1921, 1080, 100) == (1921, 1080)


def test_an_empty_picture_has_no_pinhole() -> None:
    with pytest.raises(ValueError, match="empty"):
        pinhole_from_settings(LensSettings(lens_mm=50), Raster(width=0, height=10))


@pytest.mark.parametrize("fx_px", [1.0, 1e6])
def test_lenses_that_blender_would_change_are_refused(fx_px: float) -> None:
    pinhole = Pinhole(fx_px=fx_px, fy_px=fx_px, cx_px=50, cy_px=50, width=100, height=100)
    with pytest.raises(ValueError, match="focal length"):
        settings_from_pinhole(pinhole)


@pytest.mark.parametrize("aspect", [0.25, 1.0, 1.5])
def test_the_smaller_aspect_is_one(aspect: float) -> None:
    across, up = aspect_pair(aspect)
    assert min(across, up) == 1.0
    assert up / across == pytest.approx(aspect)


def test_the_shared_aspect() -> None:
    square = Pinhole(fx_px=500, fy_px=500, cx_px=1, cy_px=1, width=10, height=10)
    nearly, tall = replace(square, fy_px=500.0001), replace(square, fy_px=250)
    assert shared_aspect_or_none(()) is None
    assert shared_aspect_or_none((nearly, square)) == 1.0
    assert shared_aspect_or_none((tall, tall)) == 2.0
    assert shared_aspect_or_none((tall, square)) is None
