"""A mesh cut along a line: the two parts make up the whole, and the line is where the function says."""

import numpy as np
import pytest
import trimesh

from backend.maths.clipping import Clipped, clipped
from backend.maths.faces import area_vectors, face_areas


def ball() -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(subdivisions=3)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64)


def above(vertices: np.ndarray, height: float) -> np.ndarray:
    return np.asarray(vertices @ [0.2, -0.3, 0.933] - height)


def area_of(part: Clipped, vertices: np.ndarray) -> float:
    return float(face_areas(part.extended(vertices), part.faces).sum())


@pytest.mark.parametrize("height", [-0.7, 0.0, 0.31])
def test_both_sides_of_a_line_make_up_the_whole(height: float) -> None:
    vertices, faces = ball()
    beyond = above(vertices, height)
    below, rest = clipped(faces, beyond), clipped(faces, -beyond)
    assert area_of(below, vertices) + area_of(rest, vertices) == pytest.approx(
        face_areas(vertices, faces).sum()
    )
    # of a ball of radius 1, cut at this height
    assert area_of(below, vertices) == pytest.approx(2 * np.pi * (1 + height), rel=0.02)


def test_the_line_lies_where_the_function_is_0_and_is_one() -> None:
    vertices, faces = ball()
    part = clipped(faces, above(vertices, 0.31))
    places = part.extended(vertices)
    assert np.abs(above(places[len(vertices) :], 0.31)).max() < 0.02 * 0.15  # a fiftieth of the longest edge
    assert (above(places[np.unique(part.faces)], 0.31) < 0.003).all()
    used, renumbered = np.unique(part.faces, return_inverse=True)
    mesh = trimesh.Trimesh(places[used], renumbered.reshape(-1, 3), process=False)
    rim = mesh.edges_sorted[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)]
    assert np.unique(rim).size == len(rim) == len(part.ends)  # one closed line
    assert mesh.is_winding_consistent
    assert face_areas(mesh.vertices, renumbered.reshape(-1, 3)).min() > 0


def test_faces_look_to_where_they_did() -> None:
    vertices, faces = ball()
    part = clipped(faces, above(vertices, 0.31))
    places = part.extended(vertices)
    outwards = area_vectors(places, part.faces)
    assert ((outwards * places[part.faces].mean(axis=1)).sum(axis=1) > 0).all()


def test_values_go_over_into_each_other_and_keep_their_kind() -> None:
    faces, beyond = np.array([[0, 1, 2]]), np.array([-1.0, 1.0, 3.0])
    part = clipped(faces, beyond)
    values = np.array([0, 8, 8], np.float32)
    np.testing.assert_allclose(part.extended(values), [0, 8, 8, 4, 2])
    assert part.extended(values).dtype == np.float32
    np.testing.assert_array_equal(part.ends, [[0, 1], [0, 2]])
    np.testing.assert_array_equal(part.faces, [[0, 3, 4]])


@pytest.mark.parametrize(("value", "kept"), [(-1.0, 1280), (0.0, 1280), (1.0, 0)])
def test_all_or_nothing(value: float, kept: int) -> None:
    vertices, faces = ball()
    part = clipped(faces, np.full(len(vertices), value))
    assert (len(part.faces), len(part.ends)) == (kept, 0)
    np.testing.assert_array_equal(part.extended(vertices), vertices)
