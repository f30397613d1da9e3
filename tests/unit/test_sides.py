"""The walk against a dense solve, and a tube that was closed by lids."""

import numpy as np
import pytest
import torch

from backend.maths.grid import node_positions
from backend.maths.sides import random_walk, sides_by_walking

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
    expected = np.linalg.solve(matrix, (trust * side).flatten().numpy()).reshape(shape)
    found = random_walk(side, trust, conductance, steps=100)
    torch.testing.assert_close(found, torch.tensor(expected), atol=1e-9, rtol=0)


def tube(count: int) -> torch.Tensor:
    """Points on its four faces, evenly; its axis is z."""
    rng = np.random.default_rng(0)
    areas = np.array(
        [4 * np.pi * HALF_LENGTH * r for r in (BORE, OUTER)] + 2 * [np.pi * (OUTER**2 - BORE**2)]
    )
    face = rng.choice(4, count, p=areas / areas.sum())
    turn = rng.uniform(0, 2 * np.pi, count)
    radius = np.choose(face, [BORE, OUTER, *2 * [np.sqrt(rng.uniform(BORE**2, OUTER**2, count))]])
    z = np.choose(face, [*2 * [rng.uniform(-HALF_LENGTH, HALF_LENGTH, count)], -HALF_LENGTH, HALF_LENGTH])
    return torch.tensor(
        np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1), dtype=torch.float32
    )


@pytest.mark.parametrize("count", [1000, 20_000])
def test_lids_without_points_are_opened(count: int) -> None:
    """The field is the solid cylinder's; of the true tube only the places far from all points are asked."""
    position = node_positions(48, torch.device("cpu"))
    across, along = position[..., :2].norm(dim=-1), position[..., 2].abs()
    solid = torch.maximum(across - OUTER, along - HALF_LENGTH)
    true = torch.maximum(solid, BORE - across)
    found = sides_by_walking(solid, tube(count))
    clear = true.abs() > 0.1
    assert (solid > 0)[clear & (true > 0)].float().mean() < 1
    assert ((found > 0) == (true > 0))[clear].all()


def test_a_solid_stays_one() -> None:
    """Without points inside nothing may open it, though the middle is far from all of them."""
    rng = np.random.default_rng(0).normal(size=(1000, 3))
    points = torch.tensor(0.6 * rng / np.linalg.norm(rng, axis=1, keepdims=True), dtype=torch.float32)
    ball = node_positions(48, torch.device("cpu")).norm(dim=-1) - 0.6
    clear = ball.abs() > 0.1
    found = sides_by_walking(ball, points)
    assert ((found > 0) == (ball > 0))[clear].all()
