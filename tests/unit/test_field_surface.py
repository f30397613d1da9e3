"""A distance that is a function, on a grid around its inside: the same values, in the grid's own units."""

import numpy as np
import pytest
import torch
from torch import Tensor

from backend.errors import ErrorCode, ReconstructionError
from backend.maths.grid import node_positions
from backend.scene import Region, to_unit_sphere, transform_points
from backend.stages.published.field_surface import field_surface, surface_in

CPU = torch.device("cpu")
REGION = Region(object_from_world=to_unit_sphere(np.array([5.0, -2.0, 1.0]), 3.0))
MIDDLE, RADIUS = torch.tensor([0.3, -0.2, 0.1]), 0.2
"""Of a ball, in the region's object frame."""


def ball(points: Tensor) -> Tensor:
    return (points - MIDDLE).norm(dim=-1) - RADIUS


def test_the_grid_lies_tightly_around_the_inside_and_holds_the_distance() -> None:
    surface = field_surface(ball, REGION, 24, CPU)
    world_from_grid = np.linalg.inv(surface.grid_from_world)
    nodes = node_positions(24, CPU).reshape(-1, 3).double().numpy()
    object_positions = (
        transform_points(REGION.object_from_world @ world_from_grid, nodes) - MIDDLE.double().numpy()
    )
    scale = np.cbrt(np.linalg.det(surface.grid_from_world[:3, :3])) * REGION.radius_world
    expected = scale * (np.linalg.norm(object_positions, axis=-1) - RADIUS)
    np.testing.assert_allclose(surface.distance.ravel(), expected, atol=1e-5)
    inside = np.argwhere(surface.distance < 0)
    assert 0 < inside.min() < inside.max() < 23
    assert (np.ptp(inside, axis=0) > 11).all(), "a ball of a fifth of the region fills half of its grid"


def test_what_lies_outside_the_unit_sphere_is_outside() -> None:
    """A function that says that all is inside: chance where no ray went."""
    surface = surface_in(lambda points: torch.full((len(points),), -3.0), REGION, np.eye(4), 9, CPU)
    reach = node_positions(9, CPU).norm(dim=-1)
    torch.testing.assert_close(torch.tensor(surface.distance), reach - 1)


def test_nothing_inside_is_told() -> None:
    with pytest.raises(ReconstructionError) as raised:
        field_surface(lambda points: ball(points).abs() + 0.1, REGION, 24, CPU)
    assert raised.value.code is ErrorCode.NO_SURFACE
