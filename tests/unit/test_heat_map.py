"""The add-on's heat maps: the report page's colours, and laws of a ramp."""

import numpy as np
import pytest

from addon.heat_map import ERROR, SUPPORT, HeatMap, heat_colours
from backend.report_page.pictures import ERROR_STOPS_SRGB, SUPPORT_STOPS_SRGB
from backend.stages.report import ERROR_MAP_LIMIT_PERCENT

BOTH = pytest.mark.parametrize("heat", [SUPPORT, ERROR], ids=["support", "error"])


def test_they_are_those_of_the_report_page() -> None:
    np.testing.assert_allclose(np.array(SUPPORT.stops_srgb) / 255, SUPPORT_STOPS_SRGB)
    np.testing.assert_allclose(np.array(ERROR.stops_srgb) / 255, ERROR_STOPS_SRGB)
    assert ERROR.limit == ERROR_MAP_LIMIT_PERCENT
    assert f"{ERROR.limit:g} %" in ERROR.legend


@BOTH
def test_stops_are_met_and_the_ends_hold_beyond(heat: HeatMap) -> None:
    places = np.linspace(0, heat.limit, len(heat.stops_srgb), dtype=np.float32)
    found = heat_colours(heat, places) * 255
    np.testing.assert_allclose(found[:, :3], heat.stops_srgb, atol=1e-3)
    beyond = heat_colours(heat, np.array([-1, 10, np.inf, np.nan], np.float32)) * 255
    np.testing.assert_allclose(beyond[0, :3], heat.stops_srgb[0], atol=1e-3)
    np.testing.assert_allclose(beyond[1:, :3], [heat.stops_srgb[-1]] * 3, atol=1e-3)
    assert (beyond[:, 3] == 255).all()
    assert heat_colours(heat, np.zeros(0, np.float32)).shape == (0, 4)


@BOTH
def test_neighbouring_values_differ_without_red_and_green(heat: HeatMap) -> None:
    """Lightness and blueness, which the red-green blind see, tell any two stops apart."""
    stops = np.array(heat.stops_srgb, np.float64)
    seen = np.stack([stops @ [0.2126, 0.7152, 0.0722], stops[:, 2] - stops[:, :2].mean(axis=1)], axis=1)
    apart = np.linalg.norm(seen[:, None] - seen[None], axis=-1) + 1e9 * np.eye(len(stops))
    assert apart.min() > 30
