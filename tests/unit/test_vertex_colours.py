"""Vertex colours: photographs of another exposure give the same colours, and those exposed alike stay."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from backend.maths.raycast import RayCaster, visible_from
from backend.maths.srgb import linear_from_srgb, srgb_from_linear
from backend.scene import Decision, View
from backend.stages.mesh import vertex_colours
from backend.stages.mesh.vertex_colours import colour_vertices
from tests.synthetic_scene import arc_cameras, photographed, texture_srgb, true_mesh, true_normals

STOPS = np.array([[0.25, 0.2, 0.3], [-0.35, -0.3, -0.4], [0.1, 0.1, 0.1]])
"""By photograph and channel: exposure and white balance both differ."""


@cache
def body_views() -> tuple[View, ...]:
    return photographed(arc_cameras(3, 40, 320)).views


def exposed(views: tuple[View, ...], stops: np.ndarray) -> tuple[View, ...]:
    """The photographs as with other exposures, in eight bits."""
    images = (
        srgb_from_linear(linear_from_srgb(view.image_srgb) * 2.0**by).clip(0, 1)
        for view, by in zip(views, stops, strict=True)
    )
    return tuple(
        replace(view, image_srgb=(np.round(image * 255) / 255).astype(np.float32))
        for view, image in zip(views, images, strict=True)
    )


def coloured(
    views: tuple[View, ...], *, exposures_evened: bool = True
) -> tuple[np.ndarray, np.ndarray, Decision]:
    """Colours (0 to 1) of the vertices that are seen, where they are, and the decision."""
    mesh = true_mesh()
    vertices, normals = np.asarray(mesh.vertices), true_normals(np.asarray(mesh.vertices))
    caster = RayCaster(vertices, np.asarray(mesh.faces))
    seen = visible_from(vertices, normals, [view.camera for view in views], caster)
    found = colour_vertices(vertices, normals, seen, views, exposures_evened=exposures_evened)
    shown = seen.any(axis=1)
    return found.colours_srgb[shown] / 255.0, vertices[shown], found.decision


def test_photographs_exposed_alike_are_left_alone() -> None:
    colours, vertices, decision = coloured(body_views())
    assert decision.choice == "left as it is"
    assert np.median(np.abs(colours - texture_srgb(vertices))) < 0.02


def test_exposure_and_white_balance_make_no_seams() -> None:
    alike, _, _ = coloured(body_views())
    common = srgb_from_linear(linear_from_srgb(alike) * 2.0 ** STOPS.mean(axis=0))
    colours, _, decision = coloured(exposed(body_views(), STOPS))
    assert decision.choice == "brought to the mean of all"
    assert f"up to {np.abs(STOPS - STOPS.mean(axis=0)).max():.2f} stops" in decision.because
    assert np.abs(colours - common).mean() < 0.01


def test_fewer_vertices_decide_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    views = exposed(body_views(), STOPS)
    _, _, by_all = coloured(views)
    monkeypatch.setattr(vertex_colours, "_MOST_VERTICES", 500)
    _, _, by_some = coloured(views)
    assert by_some.choice == by_all.choice == "brought to the mean of all"
    assert by_some.because != by_all.because  # it is from others


def test_where_it_is_not_asked_for_photographs_stay_as_exposed() -> None:
    views = exposed(body_views(), STOPS)
    colours, _, decision = coloured(views, exposures_evened=False)
    assert (decision.choice, decision.because) == ("left as it is", "the preset")
    assert np.abs(colours - coloured(views)[0]).mean() > 0.01


def test_photographs_of_something_else_are_not_brought_together() -> None:
    """What they disagree about is not exposure."""
    first, second, third = body_views()
    other = replace(second, image_srgb=0.8 * second.image_srgb[::-1, ::-1].copy())
    views = (first, replace(other, mask=second.mask), third)
    _, _, decision = coloured(views)
    assert decision.choice == "left as it is"


def test_without_a_photograph_that_shows_anything_nothing_is_divided_by_zero() -> None:
    mesh = true_mesh()
    vertices, normals = np.asarray(mesh.vertices), true_normals(np.asarray(mesh.vertices))
    unseen = np.zeros((len(vertices), 3), bool)
    found = colour_vertices(vertices, normals, unseen, body_views())
    assert found.decision.choice == "left as it is"
    assert not found.log_exposures.any()
    assert not found.colours_srgb.any()
