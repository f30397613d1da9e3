"""Samples on rays: ascending, within the span, and gathered where a known surface is."""

import torch
from torch import Tensor

from backend.maths.rays import sphere_span
from backend.maths.surface_samples import surface_samples

UP = torch.tensor([[0.0, 0.0, 1.0]])


def ball(points: Tensor) -> Tensor:
    return points.norm(dim=-1) - 0.5


def sampled(offsets: Tensor, *, rounds: int, seed: int | None = 0, sharper: float = 1.0) -> Tensor:
    """Edges on rays that go up from z = -3, beside the middle by the offsets, past a ball of radius 1/2."""
    origins = torch.stack([offsets, torch.zeros_like(offsets), torch.full_like(offsets, -3.0)], dim=-1)
    directions = UP.expand(len(offsets), 3)
    return surface_samples(
        lambda points: sharper * ball(points),
        origins,
        directions,
        sphere_span(origins, directions),
        uniform=24,
        rounds=rounds,
        per_round=8,
        generator=None if seed is None else torch.Generator().manual_seed(seed),
    )


def test_edges_ascend_within_the_span() -> None:
    offsets = torch.linspace(-0.9, 0.9, 61)
    edges = sampled(offsets, rounds=4)
    half = (1 - offsets.square()).sqrt()[:, None]
    assert edges.shape == (61, 24 + 4 * 8)
    assert (edges.diff(dim=-1) >= 0).all()
    assert (edges >= 3 - half - 1e-6).all()
    assert (edges <= 3 + half + 1e-6).all()


def test_samples_gather_at_the_first_crossing() -> None:
    """Each round doubles the sharpness: most of the later samples lie within 1 / 64 of the surface."""
    offsets = torch.linspace(-0.4, 0.4, 41)
    crossing = 3 - (0.25 - offsets.square()).sqrt()[:, None]
    even = (sampled(offsets, rounds=0) - crossing).abs() < 0.05
    gathered = (sampled(offsets, rounds=4) - crossing).abs() < 0.05
    assert even.sum(dim=-1).float().mean() < 2
    assert (gathered.sum(dim=-1) >= 24).all()


def test_without_a_surface_samples_gather_where_it_is_nearest() -> None:
    """At 0.3 from the ball the first weights are below 1e-8: the published 1e-5 would drown them."""
    offsets = torch.linspace(0.55, 0.8, 11)
    even, gathered = ((sampled(offsets, rounds=rounds) - 3).abs().median(dim=-1).values for rounds in (0, 4))
    assert (gathered < 0.6 * even).all()


def test_chance_comes_from_the_generator_alone() -> None:
    offsets = torch.linspace(-0.9, 0.9, 7)
    assert torch.equal(sampled(offsets, rounds=2), sampled(offsets, rounds=2))
    assert not torch.equal(sampled(offsets, rounds=2), sampled(offsets, rounds=2, seed=1))
    assert torch.equal(sampled(offsets, rounds=2, seed=None), sampled(offsets, rounds=2, seed=None))


def test_a_ray_that_misses_the_sphere_and_wild_fields_give_finite_places() -> None:
    for sharper in (0.0, 1e-30, 1e6, -1e6):
        edges = sampled(torch.tensor([0.0, 0.5, 1.0, 1.5]), rounds=4, sharper=sharper)
        assert edges.isfinite().all()
        assert (edges.diff(dim=-1) >= 0).all()
