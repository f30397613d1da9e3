"""The networks of NeuS and SparseCraft: a signed distance that starts as a ball, and colours on it.

Weights are drawn from the generator that is given, on the CPU, so that every device starts alike.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from ...maths.encoding import positional_encoding
from ...maths.harmonics import NUM_HARMONICS, spherical_harmonics
from ...maths.hash_grid import encode, level_cells, table_rows

_STEEPNESS = 100.0
"""Of softplus: nearly relu, so that the start is a ball, but with second derivatives."""
_SQRT2 = math.sqrt(2)
_RIDGE = 1e-3
"""Weight of the published row beside the ball's mean square error: the row grows by a fifth, not to twice."""


@dataclass(frozen=True, kw_only=True)
class HashConfig:
    """A multi-resolution hash grid."""

    levels: int = 10
    features: int = 2
    """At each node."""
    coarsest: int = 4
    """Cells along each axis."""
    finest: int = 160
    most_rows: int = 2**17
    """Of a level's table."""


@dataclass(frozen=True, kw_only=True)
class NetworkConfig:
    """Sizes; the published ones are those of the presets that are named so."""

    width: int = 64
    layers: int = 4
    """Hidden layers of the distance."""
    features: int = 32
    """What the distance hands on to the colour."""
    colour_layers: int = 2
    """Hidden layers of each network of colour."""
    frequencies: int = 4
    """Of the positional encoding of places; not used with a hash grid."""
    longest_wave: float = 2.0
    """Of positional encodings, object units: 2 for sin(2^k pi x), 2 pi for NeuS's sin(2^k x)."""
    direction_frequencies: int = 2
    """Of the positional encoding of directions."""
    spherical_harmonics: bool = False
    """Of directions, in place of their positional encoding."""
    hash_grid: HashConfig | None = None
    albedo_and_specular: bool = False
    """Colour as the sum of what all directions see and a grey gloss, in logits; else one network of all."""
    radius: float = 0.5
    """Of the ball that the distance starts as, object units."""


class Linear(nn.Module):
    """x -> g (v / |v|) x + b, a row of v at a time: weight normalisation (Salimans & Kingma, 2016)."""

    def __init__(self, weight: Float[Tensor, "outputs inputs"], bias: Float[Tensor, "outputs"]) -> None:
        super().__init__()
        self.direction = nn.Parameter(weight)
        self.length = nn.Parameter(weight.norm(dim=1, keepdim=True))
        self.bias = nn.Parameter(bias)

    def forward(self, x: Float[Tensor, "*batch inputs"]) -> Float[Tensor, "*batch outputs"]:
        """The layer's value."""
        return F.linear(x, self.length * F.normalize(self.direction, dim=1), self.bias)


def _drawn(outputs: int, inputs: int, spread: float, generator: torch.Generator) -> Tensor:
    return spread * torch.randn((outputs, inputs), generator=generator)


class DistanceNetwork(nn.Module):
    """Signed distance and features of places, and of what an encoding tells of them.

    Starts close to |x| - radius whatever the encoding says: rows N(0, 2 / width), nothing from the
    encoding, the last row sqrt(pi / width) and the bias -radius (Atzmon & Lipman, SAL, CVPR 2020; Yariv et
    al., IDR, NeurIPS 2020). That holds for infinite width: the distance is linear in the last row, which is
    then mended by least squares. The middle layer gets its input again, over sqrt 2.
    """

    def __init__(self, config: NetworkConfig, encoded: int, generator: torch.Generator) -> None:
        super().__init__()
        width, inputs = config.width, 3 + encoded
        self.again = config.layers // 2 if config.layers > 2 else 0
        """The layer that gets the input again; 0 for none."""
        layers = []
        for number in range(config.layers):
            before = inputs if number == 0 else width
            after = width - inputs if self.again and number == self.again - 1 else width
            weight = _drawn(after, before, _SQRT2 / math.sqrt(after), generator)
            if number == 0:
                weight[:, 3:] = 0
            elif number == self.again:
                weight[:, -encoded:] = 0
            layers.append(Linear(weight, torch.zeros(after)))
        self.hidden = nn.ModuleList(layers)
        weight = _drawn(1 + config.features, width, 1 / math.sqrt(width), generator)
        bias = torch.zeros(1 + config.features)
        weight[0], bias[0] = math.sqrt(math.pi / width), -config.radius
        points = 2 * torch.rand((4096, 3), generator=generator) - 1
        with torch.no_grad():
            activity = self._activity(points, points.new_zeros((len(points), encoded)))
        weight[0], bias[0] = _mended(weight[0], bias[0], activity, points.norm(dim=1) - config.radius)
        self.last = Linear(weight, bias)

    def forward(
        self, points: Float[Tensor, "points 3"], encoded: Float[Tensor, "points encoded"]
    ) -> tuple[Float[Tensor, "points"], Float[Tensor, "points features"]]:
        """Distance, > 0 outside, and features."""
        out = self.last(self._activity(points, encoded))
        return out[:, 0], out[:, 1:]

    def _activity(
        self, points: Float[Tensor, "points 3"], encoded: Float[Tensor, "points encoded"]
    ) -> Float[Tensor, "points width"]:
        """Of the last hidden layer."""
        x = given = torch.cat([points, encoded], dim=-1)
        for number, layer in enumerate(self.hidden):
            if self.again and number == self.again:
                x = torch.cat([x, given], dim=-1) / _SQRT2
            x = F.softplus(layer(x), beta=_STEEPNESS)
        return x


def _mended(
    row: Float[Tensor, "width"],
    bias: Float[Tensor, ""],
    activity: Float[Tensor, "points width"],
    wanted: Float[Tensor, "points"],
) -> tuple[Float[Tensor, "width"], Float[Tensor, ""]]:
    """The row and bias nearest to the given ones that give the wanted values: ridge regression."""
    inputs = torch.cat([activity, torch.ones_like(activity[:, :1])], dim=1).double()
    before = torch.cat([row, bias[None]]).double()
    normal = inputs.T @ inputs / len(inputs) + _RIDGE * torch.eye(len(before), dtype=torch.float64)
    after = before + torch.linalg.solve(normal, inputs.T @ (wanted - inputs @ before) / len(inputs))
    return after[:-1].float(), after[-1].float()


class ColourNetwork(nn.Module):
    """Logits of colour from whatever is given, by a plain network of relu."""

    def __init__(self, inputs: int, outputs: int, config: NetworkConfig, generator: torch.Generator) -> None:
        super().__init__()
        sizes = [inputs, *[config.width] * config.colour_layers, outputs]
        pairs = list(pairwise(sizes))
        spreads = [math.sqrt(2 / before) for before, _ in pairs[:-1]] + [0.1 / math.sqrt(sizes[-2])]
        self.layers = nn.ModuleList(
            Linear(_drawn(after, before, spread, generator), torch.zeros(after))
            for (before, after), spread in zip(pairs, spreads, strict=True)
        )

    def forward(self, x: Float[Tensor, "points inputs"]) -> Float[Tensor, "points outputs"]:
        """Logits."""
        for number, layer in enumerate(self.layers):
            x = layer(torch.relu(x) if number else x)
        return x


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What points look like."""

    colour: Float[Tensor, "points 3"]
    """sRGB, in (0, 1)."""
    gloss: Float[Tensor, "points"] | None
    """Logit of what depends on the direction; None where colour is not split."""


class NeuralSurface(nn.Module):
    """A distance in object units over the cube [-1, 1]^3, and the colours of its surface."""

    def __init__(self, config: NetworkConfig, generator: torch.Generator) -> None:
        super().__init__()
        self.config = config
        self.cells: tuple[int, ...] = ()
        grid = config.hash_grid
        encoded = 6 * config.frequencies
        self.tables = nn.ParameterList()
        if grid is not None:
            encoded = grid.levels * grid.features
            self.cells = level_cells(grid.levels, grid.coarsest, grid.finest)
            for cells in self.cells:
                shape = (table_rows(cells, grid.most_rows), grid.features)
                # Instant-NGP, section 4: nearly nothing, but not the same everywhere
                self.tables.append(nn.Parameter(1e-4 * (2 * torch.rand(shape, generator=generator) - 1)))
        self.distance_network = DistanceNetwork(config, encoded, generator)
        views = NUM_HARMONICS if config.spherical_harmonics else 3 + 6 * config.direction_frequencies
        split = config.albedo_and_specular
        seen_by_all, seen_from_one = 3 + config.features, 6 + config.features + views
        self.albedo = ColourNetwork(seen_by_all, 3, config, generator) if split else None
        self.directed = ColourNetwork(seen_from_one, 1 if split else 3, config, generator)

    def distance(
        self, points: Float[Tensor, "points 3"], active: int
    ) -> tuple[Float[Tensor, "points"], Float[Tensor, "points features"]]:
        """Distance, > 0 outside, and features; of a hash grid the first `active` levels count."""
        if self.cells:
            encoded = encode(list(self.tables), self.cells, points, active)
        else:
            encoded = self._waves(points, self.config.frequencies)
        found: tuple[Tensor, Tensor] = self.distance_network(points, encoded)
        return found

    def all_round(
        self, points: Float[Tensor, "points 3"], features: Float[Tensor, "points features"]
    ) -> Float[Tensor, "points 3"]:
        """Logits of the colour that all directions see; only where colour is split."""
        assert self.albedo is not None
        logits: Tensor = self.albedo(torch.cat([points, features], dim=-1))
        return logits

    def seen(
        self,
        points: Float[Tensor, "points 3"],
        features: Float[Tensor, "points features"],
        normals: Float[Tensor, "points 3"],
        directions: Float[Tensor, "points 3"],
    ) -> Seen:
        """Colour on the way along unit directions."""
        if self.config.spherical_harmonics:
            views = spherical_harmonics(directions)
        else:
            waves = self._waves(directions, self.config.direction_frequencies)
            views = torch.cat([directions, waves], dim=-1)
        directed: Tensor = self.directed(torch.cat([points, features, normals, views], dim=-1))
        if self.albedo is None:
            return Seen(colour=torch.sigmoid(directed), gloss=None)
        logits = self.all_round(points, features) + directed
        return Seen(colour=torch.sigmoid(logits), gloss=directed[:, 0])

    def _waves(self, x: Float[Tensor, "points 3"], frequencies: int) -> Float[Tensor, "points waves"]:
        return positional_encoding(x * (2 / self.config.longest_wave), frequencies)
