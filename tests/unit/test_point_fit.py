"""Shapes that are known, given back from points on them that are noisy, strayed, flipped or few."""

import itertools
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from backend.errors import Cancelled, ErrorCode, ReconstructionError
from backend.point_methods import PointMethod
from backend.scene import SurfaceMesh, no_progress
from backend.stages.mesh.extraction import MeshConfig
from backend.stages.points import point_network
from backend.stages.points.point_cloud import PointCloud, clean_cloud
from backend.stages.points.point_fit import PointFitConfig, fit_points
from backend.stages.points.point_mesh import mesh_of_points
from backend.stages.points.point_network import METHODS, NetworkConfig, PointNetwork, Queries
from backend.stages.safe_steps import PATIENCE, SafeSteps

CPU = torch.device("cpu")
QUICK = PointFitConfig(
    nodes=64,
    sides=NetworkConfig(
        width=32, layers=3, steps=300, batch=500, learning_rate=5e-3, warm_up=30, anywhere=0.25
    ),
    network=NetworkConfig(width=32, layers=3, steps=400, batch=1000),
)
CENTRE, RADIUS = np.array([50.0, -20.0, 3.0]), 4.0
TUBE = 0.4
"""Of the torus, whose middle circle has the radius 1."""


def sphere(count: int, noise: float, seed: int = 0) -> np.ndarray:
    """Around CENTRE; the noise is in radii."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return np.asarray(CENTRE + RADIUS * (points + noise * rng.normal(size=points.shape)))


def fitted(cloud: PointCloud, config: PointFitConfig = QUICK, seed: int = 0) -> SurfaceMesh:
    torch.manual_seed(1234 + seed)  # must not matter
    generator = torch.Generator().manual_seed(seed)
    surface = fit_points(cloud, config, device=CPU, generator=generator, progress=no_progress)
    return mesh_of_points(surface, cloud, MeshConfig(), progress=no_progress)


def off_sphere(mesh: SurfaceMesh) -> np.ndarray:
    """Distance of each vertex from the sphere, in radii."""
    return np.abs(np.linalg.norm(mesh.vertices - CENTRE, axis=1) / RADIUS - 1)


def closed(mesh: SurfaceMesh) -> trimesh.Trimesh:
    """The mesh, closed and with its faces outwards."""
    made = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert made.is_watertight
    assert made.volume > 0
    return made


def test_a_noisy_sphere_without_normals() -> None:
    """Three of a grid's cells hold ten points and more: less than half of their noise is left."""
    noise = 0.04
    mesh = fitted(clean_cloud(sphere(3000, noise), None))
    assert closed(mesh).euler_number == 2
    assert off_sphere(mesh).mean() < noise / 2
    assert np.median(mesh.support) > 0.8


def test_a_torus_keeps_its_hole() -> None:
    rng = np.random.default_rng(0)
    around, across = rng.uniform(0, 2 * np.pi, (2, 3000))
    ring = 1 + TUBE * np.cos(across)
    points = np.stack([ring * np.cos(around), ring * np.sin(around), TUBE * np.sin(across)], axis=1)
    mesh = fitted(clean_cloud(points, None))
    assert closed(mesh).euler_number == 0
    to_circle = np.linalg.norm(mesh.vertices[:, :2], axis=1) - 1
    off = np.abs(np.hypot(to_circle, mesh.vertices[:, 2]) - TUBE)
    assert off.mean() < 0.01


def test_a_bore_seen_by_few_points_stays_open() -> None:
    """As a scanner sees a pipe: the bore has an eighth of the density outside."""
    rng = np.random.default_rng(0)
    bore, outer, half_length = 0.35, 0.6, 0.3

    def mantle(radius: float, count: int) -> np.ndarray:
        turn, z = rng.uniform(0, 2 * np.pi, count), rng.uniform(-half_length, half_length, count)
        return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)

    def end(z: float, count: int) -> np.ndarray:
        turn, radius = rng.uniform(0, 2 * np.pi, count), np.sqrt(rng.uniform(bore**2, outer**2, count))
        return np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full(count, z)], axis=1)

    seen = [mantle(outer, 4000), mantle(bore, 300), end(-half_length, 400), end(half_length, 400)]
    mesh = fitted(clean_cloud(np.concatenate(seen), None))
    assert closed(mesh).euler_number == 0
    across, along = np.linalg.norm(mesh.vertices[:, :2], axis=1), np.abs(mesh.vertices[:, 2])
    inside_bore = np.minimum(bore - across, half_length - along)
    assert inside_bore.max() < 0.05


def test_known_normals_are_met() -> None:
    """A gap of a sixth of the sphere is closed by them, rounder than by a flat lid, which is a third off."""
    points = sphere(2000, 0.0)
    points = points[points[:, 2] < CENTRE[2] + (2 / 3) * RADIUS]
    mesh = fitted(clean_cloud(points, (points - CENTRE) / RADIUS), replace(QUICK, normals_known=True))
    closed(mesh)
    assert np.median(off_sphere(mesh)) < 0.005
    assert off_sphere(mesh).max() < 1 / 3
    assert not any(d.what == "normals" for d in mesh.decisions)


def test_half_of_the_points_are_strays() -> None:
    strays = CENTRE + RADIUS * np.random.default_rng(1).uniform(-1.3, 1.3, (1500, 3))
    mesh = fitted(clean_cloud(np.concatenate([sphere(1500, 0.01), strays]), None))
    closed(mesh)
    assert np.median(off_sphere(mesh)) < 0.03
    assert (off_sphere(mesh) < 0.1).mean() > 0.9


def test_normals_flipped_at_random_are_noticed() -> None:
    points = sphere(1500, 0.0)
    signs = np.random.default_rng(0).choice([-1, 1], (1500, 1))
    mesh = fitted(clean_cloud(points, signs * (points - CENTRE)), replace(QUICK, normals_known=True))
    closed(mesh)
    assert off_sphere(mesh).mean() < 0.01
    assert any(d.what == "normals" and "signs left out" in d.choice for d in mesh.decisions)


def test_normals_that_all_point_inwards_are_turned_round() -> None:
    """As of a scan of a mould, or of a mesh whose faces are inside out."""
    points = sphere(1500, 0.0)
    mesh = fitted(clean_cloud(points, CENTRE - points), replace(QUICK, normals_known=True))
    closed(mesh)
    assert off_sphere(mesh).mean() < 0.01
    assert any(d.what == "normals" and "turned round" in d.choice for d in mesh.decisions)


@pytest.mark.parametrize("method", sorted(METHODS))
def test_each_network_finds_the_sphere(method: PointMethod) -> None:
    """They begin as a ball elsewhere and of half the size."""
    mesh = fitted(clean_cloud(sphere(500, 0.01), None), replace(QUICK, method=method))
    assert closed(mesh).euler_number == 2
    assert off_sphere(mesh).mean() < 0.03


class PlainSteps(SafeSteps):
    """The optimiser's own steps, whatever they lead to."""

    def take(self, loss: torch.Tensor, length: float = 1.0) -> None:
        self._optimiser.zero_grad()
        torch.autograd.backward(loss)
        self._optimiser.step()


def plant_nans(monkeypatch: pytest.MonkeyPatch, method: PointMethod, wrong: Callable[[int], bool]) -> None:
    """A query is no number in the steps that `wrong` says, counted from 0."""
    step_loss, steps = METHODS[method], itertools.count()

    def spoiled(network: PointNetwork, batch: Queries, *others: Any) -> torch.Tensor:
        if wrong(next(steps)):
            positions = batch.positions.clone()
            positions[3, 1] = torch.nan
            batch = replace(batch, positions=positions)
        return step_loss(network, batch, *others)

    monkeypatch.setitem(METHODS, method, spoiled)


@pytest.mark.parametrize("method", [PointMethod.LINEAR, *sorted(METHODS)])
def test_steps_that_are_not_finite_are_taken_back_and_told(
    method: PointMethod, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two of them; by plain steps the first one leaves nothing but NaN."""
    cloud, config = clean_cloud(sphere(500, 0.01), None), replace(QUICK, method=method)
    pulled = PointMethod.NEURAL_PULL if method == PointMethod.LINEAR else method
    steps = (QUICK.sides if method == PointMethod.LINEAR else QUICK.network).steps
    plant_nans(monkeypatch, pulled, (37, 250).__contains__)
    mesh = fitted(cloud, config)
    assert closed(mesh).euler_number == 2
    assert off_sphere(mesh).mean() < 0.03
    (told,) = (d for d in mesh.decisions if d.choice == f"{steps} steps")
    assert "2 steps led to numbers that are not finite, were taken back and shortened" in told.because

    monkeypatch.undo()
    plant_nans(monkeypatch, pulled, (37).__eq__)
    monkeypatch.setattr(point_network, "SafeSteps", PlainSteps)
    few = {name: replace(getattr(config, name), steps=40) for name in ("sides", "network")}
    with pytest.raises(ReconstructionError, match="No surface was found"):
        fitted(cloud, replace(config, nodes=24, **few))


def test_steps_none_of_which_is_finite_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    plant_nans(monkeypatch, PointMethod.NEURAL_PULL, lambda _: True)
    told = f"{PATIENCE} steps led to numbers that are not finite"
    with pytest.raises(ReconstructionError, match=told) as caught:
        fitted(clean_cloud(sphere(100, 0.0), None))
    assert caught.value.code == ErrorCode.NO_SURFACE


def test_the_same_seed_gives_the_same_surface() -> None:
    cloud = clean_cloud(sphere(300, 0.01), None)
    once, again = (fitted(cloud, replace(QUICK, nodes=48)) for _ in range(2))
    np.testing.assert_array_equal(once.vertices, again.vertices)


@cache
def exact_cloud() -> PointCloud:
    """In steps of 2^-20, so that it is the same cloud, to the bit, a million from here."""
    return clean_cloud(np.round(sphere(300, 0.01) * 2**20) / 2**20, None)


@cache
def found_here(method: PointMethod) -> SurfaceMesh:
    return fitted(exact_cloud(), brief(method))


def brief(method: PointMethod) -> PointFitConfig:
    few = NetworkConfig(width=32, layers=3, steps=100, batch=500, warm_up=10)
    return replace(QUICK, nodes=32, method=method, network=few)


@pytest.mark.parametrize("method", [PointMethod.LINEAR, *sorted(METHODS)])
@pytest.mark.parametrize(("scale", "shift"), [(1e-4, 0.0), (1e5, 0.0), (1.0, 1e6)])
def test_neither_size_nor_place_matters(method: PointMethod, scale: float, shift: float) -> None:
    """The same vertices up to the similarity, in radii; a network's steps magnify any digit that differs."""
    offset, cloud, here = np.array([shift, -shift, shift]), exact_cloud(), found_here(method)
    there = fitted(replace(cloud, positions=scale * cloud.positions + offset), brief(method))
    np.testing.assert_array_equal(there.faces, here.faces)
    apart = (there.vertices - offset) / scale - here.vertices
    assert np.abs(apart).max() < (1e-9 if shift else 1e-13) * RADIUS


def test_points_beyond_the_most_are_drawn() -> None:
    mesh = fitted(clean_cloud(sphere(900, 0.0), None), replace(QUICK, nodes=48, most_points=400))
    assert ("points", "400 of 900") in [(d.what, d.choice) for d in mesh.decisions]
    assert off_sphere(mesh).mean() < 0.02


def test_known_normals_that_are_not_there() -> None:
    cloud = clean_cloud(sphere(100, 0.0), None)
    with pytest.raises(ReconstructionError) as caught:
        fitted(cloud, replace(QUICK, normals_known=True))
    assert caught.value.code == ErrorCode.CLOUD_UNUSABLE
    assert "Do not say that they are known" in caught.value.remedy


def test_a_fit_is_cancelled_between_two_steps() -> None:
    def stop(fraction: float, _text: str) -> None:
        if fraction > 0.1:
            raise Cancelled

    with pytest.raises(Cancelled):
        fit_points(
            clean_cloud(sphere(100, 0.0), None),
            QUICK,
            device=CPU,
            generator=torch.Generator().manual_seed(0),
            progress=stop,
        )
