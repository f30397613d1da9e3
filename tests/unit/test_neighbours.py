"""Planes of neighbours on shapes whose normals are known, and who is lonely in a cloud."""

import numpy as np
import pytest

from backend.maths.neighbours import against_neighbours, crowding, neighbour_planes, trusts


def sphere(count: int, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return np.asarray(points / np.linalg.norm(points, axis=1, keepdims=True))


def test_on_a_plane_the_normals_are_its_own_and_flatness_is_one() -> None:
    normal = np.array([2.0, -1.0, 2.0]) / 3
    points = np.random.default_rng(0).normal(size=(300, 3))
    points -= points @ normal[:, None] * normal
    planes = neighbour_planes(points)
    assert np.abs(planes.normals @ normal) == pytest.approx(1.0, abs=1e-9)
    assert planes.flatness == pytest.approx(1.0, abs=1e-9)


def test_on_a_sphere_the_normals_are_its_radii() -> None:
    """Twenty of 3000 points lie within r = 0.16: by symmetry the axis is off by less than r / 2 anywhere."""
    points = sphere(3000)
    planes = neighbour_planes(points)
    assert np.abs((planes.normals * points).sum(axis=1)).min() > np.cos(0.16 / 2)


def test_in_a_solid_no_direction_is_thin() -> None:
    points = np.random.default_rng(0).uniform(size=(5000, 3))
    assert np.median(neighbour_planes(points, 50).flatness) < 0.5


def test_coinciding_neighbours_have_no_plane_and_no_nan() -> None:
    planes = neighbour_planes(np.zeros((30, 3)))
    assert np.isfinite(planes.normals).all()
    assert not planes.flatness.any()


def test_strays_are_trusted_less_than_the_surface() -> None:
    """Half of the cloud lies anywhere in a cube: there twelve neighbours take seven times the area.

    So they should have 1 / (1 + 3.5^2) = 0.08; a stray near the surface has more.
    """
    strays = np.random.default_rng(1).uniform(-2, 2, (1000, 3))
    trust = crowding(np.concatenate([sphere(1000), strays]))
    far = np.abs(np.linalg.norm(strays, axis=1) - 1) > 0.2
    assert np.median(trust[:1000]) > 0.6
    assert np.median(trust[1000:][far]) < 0.15
    assert ((trust > 0) & (trust <= 1)).all()


def test_a_sheet_of_few_points_is_trusted_and_strays_are_not() -> None:
    """A sixteenth of the density: by crowding alone such a point would have 1 / (1 + 8^2)."""
    rng = np.random.default_rng(1)
    few = np.column_stack([rng.uniform(-2, 2, (150, 2)), np.full(150, 3.0)])
    strays = rng.uniform([-2, -2, -6], [2, 2, -2], (150, 3))
    trust = trusts(np.concatenate([sphere(2000), few, strays]))
    assert np.median(crowding(np.concatenate([sphere(2000), few]))[2000:]) < 0.05
    assert np.median(trust[2000:2150]) > 0.9
    assert np.median(trust[2150:]) < 0.25


def test_a_flipped_normal_is_against_its_neighbours() -> None:
    points = sphere(500)
    normals = points.copy()
    flipped = np.arange(0, 500, 25)
    normals[flipped] *= -1
    assert np.flatnonzero(against_neighbours(points, normals)).tolist() == flipped.tolist()
