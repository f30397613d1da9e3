"""Networks start as a ball that can be learned from, split colour as they should, and repeat their seeds."""

import pytest
import torch
from torch import Tensor

from backend.presets import PRESETS
from backend.stages.published.networks import HashConfig, Linear, NetworkConfig, NeuralSurface
from backend.stages.published.neus_fit import NeusConfig


def published(name: str) -> NetworkConfig:
    train = PRESETS[f"{name}-published"].train
    assert isinstance(train, NeusConfig)
    return train.network


HASHED = HashConfig(levels=4, finest=32, most_rows=1000)
SHAPES = [
    pytest.param(NetworkConfig(), id="neus"),
    pytest.param(NetworkConfig(layers=1, hash_grid=HASHED, albedo_and_specular=True), id="sparsecraft"),
    pytest.param(published("neus"), id="neus as published"),
    pytest.param(
        NetworkConfig(layers=1, hash_grid=HASHED, albedo_and_specular=True, spherical_harmonics=True),
        id="harmonics",
    ),
]


def made(config: NetworkConfig, seed: int = 0) -> NeuralSurface:
    return NeuralSurface(config, torch.Generator().manual_seed(seed))


def in_unit_ball(num: int, seed: int = 1) -> Tensor:
    points = torch.rand(2 * num, 3, generator=torch.Generator().manual_seed(seed)) * 2 - 1
    return points[points.norm(dim=-1) < 1][:num]


def unit(num: int, seed: int) -> Tensor:
    draws = torch.randn(num, 3, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.normalize(draws, dim=-1)


def sizes(layers: torch.nn.ModuleList) -> list[tuple[int, ...]]:
    return [tuple(layer.direction.shape) for layer in layers]


def test_published_sizes_are_those_of_the_programs() -> None:
    """NeuS: 6 waves of places, 4 of directions, 256 features. SparseCraft: 67 numbers of a place, 16 features
    with it, 16 harmonics; some 19 million numbers in tables."""
    neus = made(published("neus"))
    inside = [(256, 39), (256, 256), (256, 256), (217, 256), *[(256, 256)] * 4]
    assert sizes(neus.distance_network.hidden) == inside
    assert tuple(neus.distance_network.last.direction.shape) == (257, 256)
    assert sizes(neus.directed.layers) == [(256, 289), *[(256, 256)] * 3, (3, 256)]
    sparsecraft = made(published("sparsecraft"))
    assert sizes(sparsecraft.distance_network.hidden) == [(64, 67)]
    assert sparsecraft.albedo is not None
    assert sizes(sparsecraft.albedo.layers) == [(64, 16), (64, 64), (64, 64), (3, 64)]
    assert sizes(sparsecraft.directed.layers) == [(64, 35), (64, 64), (64, 64), (1, 64)]
    assert 18e6 < sum(table.numel() for table in sparsecraft.tables) < 20e6


def test_waves_may_be_as_long_as_neus_has_them() -> None:
    """sin(2^k x) and cos(2^k x)."""
    x = in_unit_ball(50)
    waves = [torch.sin(2.0**k * x) for k in range(6)] + [torch.cos(2.0**k * x) for k in range(6)]
    found = made(published("neus"))._waves(x, 6)
    torch.testing.assert_close(found, torch.cat(waves, dim=-1), rtol=0, atol=1e-5)


@pytest.mark.parametrize("config", SHAPES)
@pytest.mark.parametrize("seed", range(3))
def test_the_distance_starts_as_a_balls(config: NetworkConfig, seed: int) -> None:
    """The published start is off by 0.05 to 0.25 on average, by seed and size."""
    points = in_unit_ball(1000).requires_grad_()
    distance, _ = made(config, seed).distance(points, 4)
    wrong = (distance - (points.norm(dim=-1) - config.radius)).abs().detach()
    assert wrong.mean() < 0.04
    (gradient,) = torch.autograd.grad(distance.sum(), points)
    outwards = (gradient * torch.nn.functional.normalize(points, dim=-1)).sum(dim=-1)
    assert (outwards > 0.5).float().mean() > 0.97


def test_the_ball_has_the_radius_that_was_asked_for() -> None:
    inside = made(NetworkConfig(radius=0.8)).distance(0.7 * unit(200, 2), 0)[0]
    outside = made(NetworkConfig(radius=0.6)).distance(0.7 * unit(200, 2), 0)[0]
    assert (inside < 0).all()
    assert (outside > 0).all()


@pytest.mark.parametrize("config", SHAPES)
def test_everything_is_learned(config: NetworkConfig) -> None:
    """Distances, gradients in space and colours give every parameter a gradient, and a finite one."""
    surface = made(config)
    points = in_unit_ball(200).requires_grad_()
    distance, features = surface.distance(points, 4)
    (gradient,) = torch.autograd.grad(distance.sum(), points, create_graph=True)
    seen = surface.seen(points, features, unit(200, 3), unit(200, 4))
    gloss = 0.0 if seen.gloss is None else seen.gloss.sum()
    torch.autograd.backward(seen.colour.square().sum() + gradient.square().sum() + distance.sum() + gloss)
    for name, parameter in surface.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name


def test_a_layer_does_not_depend_on_the_length_of_its_rows() -> None:
    """And each row's gradient is at right angles to it: steps can not make directions shrink."""
    weight, bias = torch.randn(5, 3, generator=torch.Generator().manual_seed(0)), torch.arange(5.0)
    layer, x = Linear(weight, bias), in_unit_ball(20)
    torch.testing.assert_close(layer(x), x @ weight.T + bias)
    layer(x).square().sum().backward()
    assert layer.direction.grad is not None
    across = (layer.direction.grad * layer.direction).sum(dim=1)
    torch.testing.assert_close(across, torch.zeros(5), atol=1e-3, rtol=0)
    before = layer(x)
    with torch.no_grad():
        layer.direction.mul_(torch.tensor([[1e-3], [1.0], [7.0], [1e3], [0.5]]))
    torch.testing.assert_close(layer(x), before)


@pytest.mark.parametrize("config", SHAPES)
def test_colour_depends_on_the_direction(config: NetworkConfig) -> None:
    surface, points = made(config), in_unit_ball(50)
    features = surface.distance(points, 4)[1]
    one, other = (surface.seen(points, features, unit(50, 3), unit(50, seed)).colour for seed in (4, 5))
    assert not torch.equal(one, other)
    assert ((one > 0) & (one < 1)).all()


def test_split_colour_is_albedo_and_a_grey_gloss() -> None:
    surface, points = made(NetworkConfig(hash_grid=HASHED, albedo_and_specular=True)), in_unit_ball(50)
    features = surface.distance(points, 4)[1]
    seen = surface.seen(points, features, unit(50, 3), unit(50, 4))
    assert seen.gloss is not None
    logits = surface.all_round(points, features) + seen.gloss[:, None]
    torch.testing.assert_close(torch.logit(seen.colour), logits, atol=1e-4, rtol=1e-4)


def test_levels_that_are_not_active_change_nothing() -> None:
    surface, points = made(NetworkConfig(hash_grid=HASHED)), in_unit_ball(50)
    with torch.no_grad():
        for layer in surface.distance_network.hidden:
            layer.direction.add_(0.1)  # which at the start are deaf to the encoding
    before = surface.distance(points, 2)[0]
    with torch.no_grad():
        for table in surface.tables[2:]:
            table.fill_(1.0)
    assert torch.equal(surface.distance(points, 2)[0], before)
    assert not torch.equal(surface.distance(points, 4)[0], before)


@pytest.mark.parametrize("config", SHAPES[:2])
def test_the_same_seed_starts_alike(config: NetworkConfig) -> None:
    state, again, other = (dict(made(config, seed).named_parameters()) for seed in (4, 4, 5))
    assert all(torch.equal(state[name], again[name]) for name in state)
    assert not all(torch.equal(state[name], other[name]) for name in state)
