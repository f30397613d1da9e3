"""The walk against a dense solve, and a tube that was closed by lids."""

import numpy as np
import pytest
import torch

from backend.maths.grid import interpolate, locate, node_positions
from backend.maths.sides import Crossings, random_walk, sides_by_walking

NODES = 4
BORE, OUTER, HALF_LENGTH = 0.3, 0.55, 0.35


def test_matches_a_dense_solve() -> None:
    generator = torch.Generator().manual_seed(0)
    shape = (NODES, NODES, NODES)
    side, trust = (torch.rand(shape, generator=generator, dtype=torch.float64) for _ in range(2))
    conductance = []
    matrix = np.diag(trust.flatten().numpy())
    for axis in range(3):
        edges = torch.rand([NODES - (a == axis) for a in range(3)], generator=generator, dtype=torch.float64)
        conductance.append(edges)
        for place in np.ndindex(*edges.shape):
            other = tuple(i + (a == axis) for a, i in enumerate(place))
            ends = [int(np.ravel_multi_index(end, shape)) for end in (place, other)]
            matrix[np.ix_(ends, ends)] += float(edges[place]) * np.array([[1, -1], [-1, 1]])
    one, other = (
        locate(2 * torch.rand((5, 3), generator=generator, dtype=torch.float64) - 1, NODES) for _ in range(2)
    )
    weight = torch.rand(5, generator=generator, dtype=torch.float64)
    unit = torch.eye(NODES**3, dtype=torch.float64).reshape(-1, *shape)
    both = np.stack([(interpolate(u, one) + interpolate(u, other)).numpy() for u in unit], axis=1)
    matrix += both.T @ np.diag(weight.numpy()) @ both
    expected = np.linalg.solve(matrix, (trust * side).flatten().numpy()).reshape(shape)
    crossings = Crossings(one=one, other=other, weight=weight)
    found = random_walk(side, trust, conductance, crossings, steps=100)
    torch.testing.assert_close(found, torch.tensor(expected), atol=1e-9, rtol=0)


def tube(count: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Points on its four faces, evenly, with normals and weights; its axis is z."""
    rng = np.random.default_rng(0)
    areas = np.array(
        [4 * np.pi * HALF_LENGTH * r for r in (BORE, OUTER)] + 2 * [np.pi * (OUTER**2 - BORE**2)]
    )
    face = rng.choice(4, count, p=areas / areas.sum())
    turn = rng.uniform(0, 2 * np.pi, count)
    radius = np.choose(face, [BORE, OUTER, *2 * [np.sqrt(rng.uniform(BORE**2, OUTER**2, count))]])
    z = np.choose(face, [*2 * [rng.uniform(-HALF_LENGTH, HALF_LENGTH, count)], -HALF_LENGTH, HALF_LENGTH])
    across = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    up = np.broadcast_to([0.0, 0.0, 1.0], across.shape)
    places = radius[:, None] * across + z[:, None] * up
    return seen(places, np.where(face[:, None] < 2, across, up), rng)


def seen(
    places: np.ndarray, normals: np.ndarray, rng: np.random.Generator
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """As sides_by_walking takes them: nobody knows the normals' signs."""
    signs = rng.choice([-1.0, 1.0], (len(places), 1))
    return (
        torch.tensor(places, dtype=torch.float32),
        torch.tensor(signs * normals, dtype=torch.float32),
        torch.ones(len(places)),
    )


def on_ball(count: int, top: float = 1.0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Points on a sphere of radius 0.6 below `top` radii."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals[normals[:, 2] <= top]
    return seen(0.6 * normals, normals, rng)


@pytest.mark.parametrize("count", [1000, 20_000])
def test_lids_without_points_are_opened(count: int) -> None:
    """The field is the solid cylinder's; of the true tube only the places far from all points are asked."""
    position = node_positions(48, torch.device("cpu"))
    across, along = position[..., :2].norm(dim=-1), position[..., 2].abs()
    solid = torch.maximum(across - OUTER, along - HALF_LENGTH)
    true = torch.maximum(solid, BORE - across)
    found = sides_by_walking(solid, *tube(count)).distance
    clear = true.abs() > 0.1
    assert (solid > 0)[clear & (true > 0)].float().mean() < 1
    assert ((found > 0) == (true > 0))[clear].all()


def test_a_solid_stays_one() -> None:
    """Without points inside nothing may open it, though the middle is far from all of them."""
    ball = node_positions(48, torch.device("cpu")).norm(dim=-1) - 0.6
    clear = ball.abs() > 0.1
    found = sides_by_walking(ball, *on_ball(1000)).distance
    assert ((found > 0) == (ball > 0))[clear].all()


@pytest.mark.parametrize("top", [2 / 3, 1 / 3, 0.0])
def test_a_gap_hollows_nothing_out(top: float) -> None:
    """What was scanned from one side is closed by about a flat lid: behind a far wall there is outside."""
    position = node_positions(48, torch.device("cpu"))
    ball = position.norm(dim=-1) - 0.6
    lidded = torch.maximum(ball, position[..., 2] - 0.6 * top)
    found = sides_by_walking(ball, *on_ball(4000, top)).distance
    clear = (lidded.abs() > 0.1) & ~((lidded > 0) & (ball < 0))
    assert ((found > 0) == (lidded > 0))[clear].all()


def test_clearance_is_counted_in_distances_between_points() -> None:
    """Four times as many points on a sphere are half as far apart: the same place is twice as clear."""
    ball = node_positions(32, torch.device("cpu")).norm(dim=-1) - 0.6
    few, many = (sides_by_walking(ball, *on_ball(count)).clearance for count in (200, 800))
    middle = slice(12, 20)
    ratio = many[middle, middle, middle] / few[middle, middle, middle]
    assert ratio.median() == pytest.approx(2, rel=0.2)
    assert (few >= 0).all()
