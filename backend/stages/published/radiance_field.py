"""Density and radiance as networks of place and direction (NeRF), and rays through them.

A small second network, the proposal, is asked first, at many places; where it says that light is absorbed,
the field is asked (mip-NeRF 360). Lengths are in object units; the field is known inside the unit sphere.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from ...maths.encoding import positional_encoding, wave_window
from ...maths.radiance import log_pass_of_density
from ...maths.rays import points_along, sphere_span
from ...maths.resampling import resample, strata
from ...maths.volume import blending_weights
from ...scene import Region
from ..radiance import Radiance, RadianceShape

_DENSITY_UNIT = 10.0
"""Per object unit: an interval of a tenth of the sphere's radius is neither clear nor opaque."""
_DENSITY_SHIFT = -3.0
"""At the start a ray loses some half of its light, so that every place on it is heard."""
_FLOOR = 0.01
"""Weight that every place on a ray has besides the proposed one: what is overlooked can still be found."""


_FIRST_WAVES = 2
"""That count from the first step."""


class RadianceField(nn.Module):
    """Density, 1 / object unit, and the colour that leaves a place in a direction; and the proposal."""

    def __init__(self, shape: RadianceShape, generator: torch.Generator) -> None:
        super().__init__()
        self.shape = shape
        self.active_waves = float(shape.frequencies)
        place, direction = 6 * shape.frequencies + 3, 6 * shape.direction_frequencies + 3
        width = shape.width
        self.trunk = _layers([place, *[width] * shape.layers], generator)
        self.density_head = _layers([width, 1], generator)
        self.colour_head = _layers([width + direction, width // 2, 3], generator)
        proposal_place = 6 * shape.proposal_frequencies + 3
        self.proposal = _layers([proposal_place, *[shape.proposal_width] * 2, 1], generator)

    def open_waves(self, share: float) -> None:
        """Let a share of the encoded place's waves count, the long ones first; 1 and more: all."""
        self.active_waves = _FIRST_WAVES + (self.shape.frequencies - _FIRST_WAVES) * min(1.0, share)

    def density_and_features(
        self, points: Float[Tensor, "points 3"]
    ) -> tuple[Float[Tensor, "points"], Float[Tensor, "points width"]]:
        """Density, and what the colour is made from."""
        encoded = _with_waves(points, self.shape.frequencies, self.active_waves)
        features = torch.relu(_through(self.trunk, encoded))
        return _density(_through(self.density_head, features)[:, 0]), features

    def colour(
        self, features: Float[Tensor, "points width"], directions: Float[Tensor, "points 3"]
    ) -> Float[Tensor, "points 3"]:
        """sRGB, in (0, 1), towards a camera that looks along unit directions."""
        seen = torch.cat([features, _with_waves(directions, self.shape.direction_frequencies)], dim=-1)
        return torch.sigmoid(_through(self.colour_head, seen))

    def proposed_density(self, points: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        """What the proposal says of the density."""
        encoded = _with_waves(points, self.shape.proposal_frequencies)
        return _density(_through(self.proposal, encoded)[:, 0])


def kept(field: RadianceField, region: Region, background_srgb: Float[Tensor, "3"] | None) -> Radiance:
    """The field as data; `restored` is the inverse."""
    parameters = nn.utils.parameters_to_vector(field.parameters())
    return Radiance(
        shape=field.shape,
        parameters=parameters.detach().cpu().numpy(),
        object_from_world=region.object_from_world,
        background_srgb=None if background_srgb is None else background_srgb.detach().cpu().numpy(),
    )


def restored(radiance: Radiance, device: torch.device) -> RadianceField:
    """The field that was kept. ValueError where the parameters are not those of the shape."""
    field = RadianceField(radiance.shape, torch.Generator())
    parameters = torch.tensor(radiance.parameters)
    if len(parameters) != sum(part.numel() for part in field.parameters()):
        raise ValueError(f"{len(parameters)} parameters do not fit {radiance.shape}")
    nn.utils.vector_to_parameters(parameters, field.parameters())
    return field.to(device).requires_grad_(False)


@dataclass(frozen=True, kw_only=True)
class RaySamples:
    """What the field and the proposal say of rays; positions are distances along unit directions."""

    edges: Float[Tensor, "rays edges"]
    log_pass: Float[Tensor, "rays intervals"]
    colour: Float[Tensor, "rays intervals 3"]
    proposal_edges: Float[Tensor, "rays proposal_edges"]
    proposal_weights: Float[Tensor, "rays proposal_intervals"]


def sample_rays(
    field: RadianceField,
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    generator: torch.Generator | None,
) -> RaySamples:
    """Rays (unit directions) through the unit sphere, cut where the proposal expects something.

    Without a generator places are not drawn but spread evenly. On a ray that misses the sphere all intervals
    have no length.
    """
    shape = field.shape
    rays = len(origins)
    near, far = (end[:, None] for end in sphere_span(origins, directions))
    inner = strata(rays, shape.proposal_intervals - 1, generator, origins.device)
    proposal_edges = torch.cat([near, near + (far - near) * inner, far], dim=-1)
    proposed = field.proposed_density(_middles(origins, directions, proposal_edges)).reshape(rays, -1)
    proposal_weights = blending_weights(log_pass_of_density(proposed, proposal_edges))
    inner = strata(rays, shape.intervals - 1, generator, origins.device)
    looked_for = proposal_weights.detach() + _FLOOR / shape.proposal_intervals
    edges = torch.cat([near, resample(proposal_edges, looked_for, inner), far], dim=-1)
    density, features = field.density_and_features(_middles(origins, directions, edges))
    towards = directions.repeat_interleave(shape.intervals, dim=0)
    return RaySamples(
        edges=edges,
        log_pass=log_pass_of_density(density.reshape(rays, -1), edges),
        colour=field.colour(features, towards).reshape(rays, -1, 3),
        proposal_edges=proposal_edges,
        proposal_weights=proposal_weights,
    )


def _middles(
    origins: Float[Tensor, "rays 3"], directions: Float[Tensor, "rays 3"], edges: Float[Tensor, "rays edges"]
) -> Float[Tensor, "points 3"]:
    along = (edges[:, 1:] + edges[:, :-1]) / 2
    return points_along(origins, directions, along).reshape(-1, 3)


def _density(x: Float[Tensor, "points"]) -> Float[Tensor, "points"]:
    """Softplus: grows linearly, so that neither value nor gradient can overflow; never negative."""
    return _DENSITY_UNIT * F.softplus(x + _DENSITY_SHIFT)


def _with_waves(
    x: Float[Tensor, "points 3"], frequencies: int, active: float | None = None
) -> Float[Tensor, "points inputs"]:
    waves = positional_encoding(x, frequencies)
    if active is not None and active < frequencies:
        waves = waves * wave_window(frequencies, 3, active).to(waves)
    return torch.cat([x, waves], dim=-1)


def _through(layers: nn.ModuleList, x: Float[Tensor, "points inputs"]) -> Float[Tensor, "points outputs"]:
    """A plain network: relu between its layers."""
    for number, layer in enumerate(layers):
        x = layer(torch.relu(x) if number else x)
    return x


def _layers(sizes: list[int], generator: torch.Generator) -> nn.ModuleList:
    """Uniform start of variance 2 / inputs (He et al., 2015), drawn on the CPU; no bias at first."""
    layers = nn.ModuleList()
    for inputs, outputs in pairwise(sizes):
        layer = nn.Linear(inputs, outputs)
        bound = math.sqrt(6 / inputs)
        drawn = torch.rand((outputs, inputs), generator=generator, device=generator.device)
        with torch.no_grad():
            layer.weight.copy_((drawn * 2 - 1) * bound)
            layer.bias.zero_()
        layers.append(layer)
    return layers
