"""Sphere tracing against rays and spheres in closed form."""

import math

import pytest
import torch
from torch import Tensor

from backend.maths.grid import node_positions, read
from backend.maths.rays import first_crossing, lowest_along, lowest_in_torch, sphere_entry

RADIUS = 0.5


def ball(points: Tensor) -> Tensor:
    distance: Tensor = points.norm(dim=-1) - RADIUS
    return distance


def rays_towards(num: int, spread: float) -> tuple[Tensor, Tensor]:
    """Rays from 3 units away towards places within `spread` of the origin."""
    generator = torch.Generator().manual_seed(2)
    origins = 3 * torch.nn.functional.normalize(torch.randn(num, 3, generator=generator), dim=-1)
    targets = (torch.rand(num, 3, generator=generator) * 2 - 1) * spread
    return origins, torch.nn.functional.normalize(targets - origins, dim=-1)


def sphere_along(origins: Tensor, directions: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """The nearest place to the centre along rays, and where they first meet the sphere (NaN: never)."""
    middle = -(origins * directions).sum(dim=-1)
    squared = radius**2 - (origins.square().sum(dim=-1) - middle**2)
    return middle, middle - squared.sqrt()


def test_sphere_entry_lies_on_the_unit_sphere() -> None:
    origins, directions = rays_towards(500, 1.2)
    middle, first = sphere_along(origins, directions, 1.0)
    assert first.isnan().any()
    assert first.isfinite().any()
    expected = torch.where(first.isnan(), middle, first)
    torch.testing.assert_close(sphere_entry(origins, directions), expected, atol=2e-3, rtol=0)


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (0.0, 0.2, 0.9), (0.0, 0.0, 3.0), (0.0, 2.0, 0.1)])
def test_sphere_entry_is_the_start_inside_the_sphere_and_beyond_it(
    origin: tuple[float, float, float],
) -> None:
    entry = sphere_entry(torch.tensor([origin]), torch.tensor([[0.0, 0.0, 1.0]]))
    assert entry.item() == 0


def test_tracing_finds_the_first_hit() -> None:
    origins, directions = rays_towards(500, 0.8)
    middle, first = sphere_along(origins, directions, RADIUS)
    along = (origins + middle[:, None] * directions).norm(dim=-1)
    found = first_crossing(ball, origins, directions, sphere_entry(origins, directions))
    sure = (along - RADIUS).abs() > 1e-3  # a ray that just grazes may pass between two steps
    assert (found.hit == first.isfinite())[sure].all()
    deep = found.hit & (along < 0.95 * RADIUS)
    assert 100 < deep.sum() < 450
    torch.testing.assert_close(found.along[deep], first[deep], atol=1e-4, rtol=0)


def test_a_ray_that_misses_gets_the_place_where_it_comes_nearest() -> None:
    """As near as its steps are dense: they are at most as long as the distance there."""
    origins, directions = rays_towards(500, 0.9)
    middle, first = sphere_along(origins, directions, RADIUS)
    found = first_crossing(ball, origins, directions, sphere_entry(origins, directions))
    missed = first.isnan() & ~found.hit
    assert missed.sum() > 50
    nearest = ball(origins + middle[:, None] * directions)[missed]
    assert ((found.along - middle)[missed].abs() <= 0.5 * nearest + 0.02).all()
    reached = ball(origins + found.along[:, None] * directions)[missed]
    assert (reached - nearest).max() < 0.03


def test_a_start_inside_is_a_hit_there() -> None:
    origins = torch.tensor([[0.0, 0.0, 0.1], [0.3, 0.0, 0.0]])
    directions = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    start = torch.tensor([0.0, 0.1])
    found = first_crossing(ball, origins, directions, start)
    assert found.hit.all()
    torch.testing.assert_close(found.along, start)


def test_the_first_of_two_surfaces_is_taken() -> None:
    def two(points: Tensor) -> Tensor:
        ahead = torch.tensor([0.0, 0.0, 0.5])
        return torch.minimum((points - ahead).norm(dim=-1), (points + ahead).norm(dim=-1)) - 0.2

    found = first_crossing(two, torch.tensor([[0.0, 0, -2]]), torch.tensor([[0.0, 0, 1]]), torch.ones(1))
    assert found.along.item() == pytest.approx(1.3, abs=1e-4)


def test_rays_end_at_their_reach() -> None:
    origins, directions = torch.tensor([[0.0, 0.0, -2.0]]), torch.tensor([[0.0, 0.0, 1.0]])
    short = first_crossing(ball, origins, directions, torch.zeros(1), reach=1.4)
    assert not short.hit.any()
    assert short.along.item() == pytest.approx(1.4)
    assert first_crossing(ball, origins, directions, torch.zeros(1), reach=1.6).hit.all()


def test_a_distance_that_is_too_small_is_still_crossed_exactly() -> None:
    """A field half as steep as it should be takes more steps to the same crossing."""
    origins, directions = rays_towards(100, 0.2)
    _, first = sphere_along(origins, directions, RADIUS)
    found = first_crossing(lambda x: 0.5 * ball(x), origins, directions, sphere_entry(origins, directions))
    assert found.hit.all()
    torch.testing.assert_close(found.along, first, atol=1e-4, rtol=0)


@pytest.mark.parametrize("constant", [1e4, -1e4, 0.0, math.inf])
def test_a_field_without_a_surface_gives_finite_places(constant: float) -> None:
    origins, directions = rays_towards(5, 0.2)
    found = first_crossing(lambda x: torch.full_like(x[:, 0], constant), origins, directions, torch.ones(5))
    assert found.along.isfinite().all()
    assert (found.hit == (constant <= 0)).all()


def wavy_field(nodes: int) -> Tensor:
    """A dented ball on a grid, less steep than a distance and rough from node to node."""
    generator = torch.Generator().manual_seed(3)
    at = node_positions(nodes, torch.device("cpu"))
    dents = 0.1 * (7 * at).sin().prod(dim=-1) + 0.02 * torch.rand(at.shape[:-1], generator=generator)
    return 0.8 * (at.norm(dim=-1) - RADIUS) + dents


@pytest.mark.parametrize("scale", [0.5, 1.0, 3.0])
def test_compiled_tracing_is_the_same_as_in_torch(scale: float) -> None:
    """From far away, from beside the cube and from inside it; in single precision compiled, else not."""
    origins, directions = rays_towards(9000, 0.9)
    origins, field = scale / 3 * origins, wavy_field(33)
    start = torch.zeros(len(origins))
    limits = {"reach": scale + 1.5, "shortest": 0.03, "longest": 0.2, "steps": 50}
    expected = first_crossing(lambda at: read(field, at), origins, directions, start, **limits)
    single = first_crossing(field, origins, directions, start, **limits)
    rays = (values.double() for values in (field, origins, directions, start))
    double = first_crossing(*rays, **limits)
    assert expected.hit.sum() > 1000
    assert double.along.dtype == torch.float64
    for found in (single, double):
        assert (found.hit == expected.hit).float().mean() > 0.999
        same = found.hit & expected.hit
        torch.testing.assert_close(found.along[same].float(), expected.along[same], atol=2e-5, rtol=0)
        missed = ~found.hit & ~expected.hit
        lowest, least = (
            read(field, (origins + where.along[:, None].float() * directions)[missed])
            for where in (found, expected)
        )
        torch.testing.assert_close(lowest, least, atol=1e-4, rtol=0)


@pytest.mark.parametrize("threads", [1, 2])
def test_compiled_tracing_is_the_same_on_any_number_of_threads(
    threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    origins, directions = rays_towards(20_000, 0.9)
    start, field = sphere_entry(origins, directions), wavy_field(33)
    expected = first_crossing(field, origins, directions, start)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    found = first_crossing(field, origins, directions, start)
    assert torch.equal(found.along, expected.along)
    assert torch.equal(found.hit, expected.hit)


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_compiled_tracing_stays_in_the_grid_whatever_it_is_given(number: float) -> None:
    origins, directions = rays_towards(30, 0.9)
    field = wavy_field(9)
    broken = torch.full_like(origins, number)
    for rays in ((broken, directions), (origins, broken)):
        found = first_crossing(field, *rays, torch.zeros(30))
        assert found.along.isfinite().all()
    without = first_crossing(torch.full_like(field, math.nan), origins, directions, torch.ones(30))
    assert (without.along == 1).all()
    assert not without.hit.any()
    assert first_crossing(field, origins[:0], directions[:0], torch.zeros(0)).hit.shape == (0,)


def test_a_ray_is_lowest_where_it_passes_the_middle_of_a_ball() -> None:
    """At the nearest of its places; nowhere if it misses the cube; never behind the eye."""
    nodes = 65
    field = node_positions(nodes, torch.device("cpu")).norm(dim=-1) - 0.5
    origins = torch.tensor([[-3.0, 0.2, 0.1], [-3.0, 1.1, 0.0], [0.5, 0.0, 0.0]])
    directions = torch.tensor([[1.0, 0, 0], [1, 0, 0], [1, 0, 0]])
    along, least = lowest_along(field, origins, directions, origins.norm(dim=-1), torch.linspace(-2, 2, 401))
    torch.testing.assert_close(along, torch.tensor([3.0, 0.0, 0.0]), atol=0.02, rtol=0)
    expected = torch.tensor([math.sqrt(0.05) - 0.5, math.inf, 0.0])
    torch.testing.assert_close(least, expected, atol=2e-3, rtol=0)


def test_what_is_compiled_finds_the_lowest_place_of_the_reference() -> None:
    origins, directions = rays_towards(2000, 1.3)
    given = (wavy_field(17), origins, directions, origins.norm(dim=-1), torch.linspace(-1.7, 1.7, 60))
    (along, least), (there, value) = lowest_along(*given), lowest_in_torch(*given)
    assert 10 < int(value.isinf().sum()) < 1000
    torch.testing.assert_close(least, value, atol=1e-5, rtol=0)
    assert float((along == there).float().mean()) > 0.99
