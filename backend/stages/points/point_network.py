"""A field for points without normals: a small network trained to pull space onto the cloud.

Four ways of asking for it. None needs to know which side is inside: the network begins as the signed
distance of a ball. What they ask of it is in maths/losses.py.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import softplus

from ...maths.grid import node_positions
from ...maths.losses import entropy_of_side, log_mean_exp, newton_pull, pull, worst_offset
from ...maths.nearest import nearest_tree
from ...point_methods import PointMethod
from ...scene import Progress
from ..safe_steps import SafeSteps

NEIGHBOURS = 50
"""The distance to this neighbour is how far around a point queries are drawn (Ma et al.)."""
_BALL = 0.5
"""Radius of the ball to begin with, in half sides of the cube."""
_QUERIES = 200_000
"""Drawn around the points, about."""
_NODES_AT_ONCE = 65_536


@dataclass(frozen=True, kw_only=True)
class NetworkConfig:
    """The published settings, with a smaller network and fewer steps: a CPU has to do."""

    width: int = 64
    """Published: 256."""
    layers: int = 4
    """Hidden ones. Published: 8."""
    steps: int = 1000
    """Published: 40 000."""
    batch: int = 500
    """Places a step, shared by the queries and what is tried around them. Published: 5000 queries."""
    learning_rate: float = 3e-3
    """Published: 1e-3."""
    warm_up: int = 100
    anywhere: float = 0.0
    """Queries all over the cube, over those around points: only they meet surface far from points."""
    adversary: float = 1e-2
    """NAP: radius in which the worst query is looked for, in spreads of the queries."""
    draws: int = 5
    """SDRO: queries around each query."""
    jitter: float = 1 / 23
    """SDRO: their spread, in spreads of the queries."""
    temperature: float = 66 / 23
    """SDRO: of the soft maximum over the draws, in spreads of the queries."""
    robust_share: float = 0.2
    """SDRO: of the robust loss; the rest is Neural-Pull's."""
    entropy_decay: float = 8 * math.log(10)
    """Entropy: its weight at the end of the steps' first quarter is exp(-decay)."""
    pull_weight: float = 10.0
    """Entropy: of the pull beside the entropy."""


@dataclass(frozen=True, kw_only=True)
class Queries:
    """Places in space, each with the point of the cloud that is nearest to it."""

    positions: Float[Tensor, "queries 3"]
    nearest: Float[Tensor, "queries 3"]
    spread: Float[Tensor, "queries"]
    """Standard deviation of the noise that made the query from a point."""


@dataclass(frozen=True, kw_only=True)
class LearnedField:
    """What a network has learned, on a grid over the cube [-1, 1]^3."""

    distance: Float[Tensor, "nodes nodes nodes"]
    """> 0 outside; only for the entropy's it is no distance."""
    taken_back: int
    """Steps whose loss or gradient was not finite."""


class PointNetwork(nn.Module):
    """A multilayer perceptron that begins as the signed distance of a ball (Atzmon and Lipman, SAL, 2020)."""

    def __init__(self, width: int, layers: int, generator: torch.Generator) -> None:
        super().__init__()
        sizes = [3, *[width] * layers]
        self.hidden: Iterable[nn.Linear]
        self.hidden = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))  # type: ignore[assignment]
        self.last = nn.Linear(width, 1)
        with torch.no_grad():
            for layer in self.hidden:
                layer.weight.normal_(0, math.sqrt(2 / layer.out_features), generator=generator)
                layer.bias.zero_()
            self.last.weight.normal_(math.sqrt(math.pi / width), 1e-4, generator=generator)
            self.last.bias.fill_(-_BALL)

    def forward(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """The field; > 0 outside."""
        values = points
        for layer in self.hidden:
            values = softplus(layer(values), beta=100)
        field: Tensor = self.last(values)
        return field[..., 0]


def fit_network(
    points: Float[Tensor, "points 3"],
    nodes: int,
    method: PointMethod,
    config: NetworkConfig,
    *,
    generator: torch.Generator,
    progress: Progress,
) -> LearnedField:
    """The field that a method's network has learned of points in the cube.

    `method` is one of METHODS. Raises ReconstructionError(NO_SURFACE) if too many steps were not finite.
    """
    step_loss = METHODS[method]
    num_queries = config.batch // {PointMethod.NAP: 2, PointMethod.SDRO: 1 + config.draws}.get(method, 1)
    queries = _draw_queries(points, config.anywhere, generator)
    network = PointNetwork(config.width, config.layers, generator).to(points.device)
    balance = nn.Parameter(torch.ones(2, device=points.device))  # NAP's own weights
    optimiser = torch.optim.Adam([*network.parameters(), balance], lr=config.learning_rate)
    safe = SafeSteps(optimiser)
    for step in range(config.steps):
        if step % 10 == 0:
            progress(step / config.steps, f"step {step} of {config.steps}")
            safe.keep()
        chosen = torch.randint(len(queries.positions), (num_queries,), generator=generator)
        batch = Queries(
            positions=queries.positions[chosen],
            nearest=queries.nearest[chosen],
            spread=queries.spread[chosen],
        )
        loss = step_loss(network, batch, balance, step / config.steps, config, generator)
        safe.take(loss, _rate(step, config))
        if safe.hopeless:
            break
    safe.raise_if_nothing_was_learned("the points", "Check that they lie on a surface; try another method.")
    with torch.no_grad():
        places = (
            node_positions(nodes, points.device).reshape(-1, 3).tensor_split(-(-(nodes**3) // _NODES_AT_ONCE))
        )
        values = torch.cat([network(part) for part in places])
    return LearnedField(distance=values.reshape(nodes, nodes, nodes), taken_back=safe.taken_back)


def _draw_queries(points: Float[Tensor, "points 3"], share: float, generator: torch.Generator) -> Queries:
    """Places around the points, as far away as their neighbours are, and some anywhere."""
    places = points.cpu().numpy()
    tree = nearest_tree(places)
    spread, _ = tree.query(places, k=[min(NEIGHBOURS, len(places) - 1) + 1], workers=-1)
    times = max(1, _QUERIES // len(places))
    widths = torch.tensor(spread[:, 0], dtype=points.dtype).repeat(times)
    noise = torch.randn((len(widths), 3), generator=generator, dtype=points.dtype)
    around = points.cpu().repeat(times, 1) + widths[:, None] * noise
    anywhere = torch.rand((int(share * len(around)), 3), generator=generator, dtype=points.dtype) * 2 - 1
    positions = torch.cat([around, anywhere])
    widths = torch.cat([widths, widths.mean().expand(len(anywhere))])
    _, nearest = tree.query(positions.numpy(), workers=-1)
    device = points.device
    return Queries(
        positions=positions.to(device), nearest=points[torch.from_numpy(nearest)], spread=widths.to(device)
    )


def _rate(step: int, config: NetworkConfig) -> float:
    """Of the learning rate: up in a line, down by a cosine."""
    if step < config.warm_up:
        return (step + 1) / config.warm_up
    done = (step - config.warm_up) / max(1, config.steps - config.warm_up)
    return 0.5 * (1 + math.cos(math.pi * done))


def _value_and_gradient(
    network: PointNetwork, positions: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
    """Both differentiable in the network and in the positions, which must ask for gradients."""
    values = network(positions)
    (gradient,) = torch.autograd.grad(values.sum(), positions, create_graph=True)
    return values, gradient


def _pull_losses(
    network: PointNetwork, positions: Float[Tensor, "*batch 3"], nearest: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch"]:
    values, gradient = _value_and_gradient(network, positions)
    return pull(values, gradient, nearest - positions)


def _neural_pull(
    network: PointNetwork,
    batch: Queries,
    _balance: Tensor,
    _done: float,
    _config: NetworkConfig,
    _generator: torch.Generator,
) -> Float[Tensor, ""]:
    """Ma et al., arXiv:2011.13495."""
    return _pull_losses(network, batch.positions.requires_grad_(), batch.nearest).mean()


def _nap(
    network: PointNetwork,
    batch: Queries,
    balance: Tensor,
    _done: float,
    config: NetworkConfig,
    _generator: torch.Generator,
) -> Float[Tensor, ""]:
    """Queries moved to where they are pulled worst; both losses weighted by what is learned."""
    positions = batch.positions.requires_grad_()
    losses = _pull_losses(network, positions, batch.nearest)
    (rise,) = torch.autograd.grad(losses.sum(), positions, retain_graph=True)
    moved = (positions + worst_offset(rise, config.adversary * batch.spread)).detach().requires_grad_()
    both = torch.stack([losses.mean(), _pull_losses(network, moved, batch.nearest).mean()])
    weights = balance.abs() + 1e-3
    return (both / (2 * weights) + torch.log1p(weights)).sum()


def _sdro(
    network: PointNetwork,
    batch: Queries,
    _balance: Tensor,
    _done: float,
    config: NetworkConfig,
    generator: torch.Generator,
) -> Float[Tensor, ""]:
    """The worst distribution of queries near the drawn one, softly."""
    shape = (config.draws, *batch.positions.shape)
    noise = torch.randn(shape, generator=generator).to(batch.positions)
    around = batch.positions + config.jitter * batch.spread[:, None] * noise
    everywhere = torch.cat([batch.positions[None], around]).requires_grad_()
    losses = _pull_losses(network, everywhere, batch.nearest)
    temperature = config.temperature * float(batch.spread.mean())
    robust = log_mean_exp(losses[1:], temperature).mean()
    return (1 - config.robust_share) * losses[0].mean() + config.robust_share * robust


def _entropy(
    network: PointNetwork,
    batch: Queries,
    _balance: Tensor,
    done: float,
    config: NetworkConfig,
    generator: torch.Generator,
) -> Float[Tensor, ""]:
    """An occupancy's logit: decided everywhere in space, undecided on the cloud (SparseOcc, CVPR 2024)."""
    positions = batch.positions.requires_grad_()
    values, gradient = _value_and_gradient(network, positions)
    pulled = newton_pull(values, gradient, batch.nearest - positions, least_slope=0.1).mean()
    anywhere = torch.rand((len(positions) // 10, 3), generator=generator).to(positions) * 2 - 1
    undecided = entropy_of_side(network(anywhere), 1.0).mean()
    on_cloud = entropy_of_side(network(batch.nearest), 1.0).mean()
    weight = math.exp(-config.entropy_decay * 4 * done)
    return config.pull_weight * pulled + weight * (undecided - on_cloud)


_StepLoss = Callable[
    [PointNetwork, Queries, Tensor, float, NetworkConfig, torch.Generator], Float[Tensor, ""]
]
METHODS: dict[PointMethod, _StepLoss] = {
    PointMethod.NEURAL_PULL: _neural_pull,
    PointMethod.NAP: _nap,
    PointMethod.SDRO: _sdro,
    PointMethod.ENTROPY: _entropy,
}
