"""The surface as a field: signed distances on a grid, and colour by a small network.

Only nodes near the surface are parameters; the rest of the grid keeps its values. Colour is a
function of features on the same nodes, of the normal (which carries the shading of matt surfaces)
and, where a scene is glossy, of the direction of view.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from ...maths.grid import Corners, interpolate_features, locate, near_surface


class SurfaceField(nn.Module):
    """A signed distance in object units on N^3 nodes over [-1, 1]^3 and a colour near its zero level."""

    def __init__(
        self,
        distance: Float[Tensor, "nodes nodes nodes"],
        *,
        band_cells: int,
        channels: int,
        view_dependent: bool,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.nodes = distance.shape[0]
        self.view_dependent = view_dependent
        active = near_surface(distance, band_cells).flatten()
        rows = torch.full((self.nodes**3,), -1, dtype=torch.int32, device=distance.device)
        rows[active] = torch.arange(int(active.sum()), dtype=torch.int32, device=distance.device)
        self.register_buffer("rows", rows)
        self.register_buffer("frozen", distance.flatten().clone())
        self.register_buffer("active", torch.nonzero(active).flatten())
        self.distances = nn.Parameter(distance.flatten()[active].clone())
        self.features = nn.Parameter(distance.new_zeros((len(self.distances), channels)))
        inputs = channels + 3 + (3 if view_dependent else 0)
        self.first = nn.Parameter(_uniform((inputs, 32), inputs, generator, distance.device))
        self.first_bias = nn.Parameter(distance.new_zeros(32))
        self.last = nn.Parameter(_uniform((32, 3), 32, generator, distance.device))
        self.last_bias = nn.Parameter(distance.new_zeros(3))

    rows: Int[Tensor, "cells"]
    frozen: Float[Tensor, "cells"]
    active: Int[Tensor, "parameters"]

    def locate(self, points: Float[Tensor, "points 3"]) -> Corners:
        """The cells of points; to be shared by the calls below."""
        return locate(points, self.nodes)

    def node_values(self, index: Int[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Distances at nodes given by flat number, differentiable in the parameters."""
        rows = self.rows[index]
        return torch.where(rows >= 0, self.distances[rows.clamp(min=0)], self.frozen[index])

    def change(self, index: Int[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """By how much the distances there differ from those that the field began with."""
        return self.node_values(index) - self.frozen[index]

    def distance(self, corners: Corners) -> Float[Tensor, "points"]:
        """Signed distance."""
        return (self.node_values(corners.index) * corners.weight).sum(dim=-1)

    def distance_and_gradient(
        self, corners: Corners
    ) -> tuple[Float[Tensor, "points"], Float[Tensor, "points 3"]]:
        """Signed distance and its gradient in space, both differentiable in the parameters."""
        values = self.node_values(corners.index)
        return (values * corners.weight).sum(dim=-1), torch.einsum("pc,pcd->pd", values, corners.slope)

    def colour(
        self,
        corners: Corners,
        normal: Float[Tensor, "points 3"],
        direction: Float[Tensor, "points 3"],
    ) -> Float[Tensor, "points 3"]:
        """Colour in sRGB, in (0, 1); the first three features are its logits, the network adds to them."""
        rows = replace(corners, index=self.rows[corners.index].clamp(min=0))
        features = interpolate_features(self.features, rows)
        seen = [features, normal, direction] if self.view_dependent else [features, normal]
        hidden = torch.relu(torch.cat(seen, dim=-1) @ self.first + self.first_bias)
        return torch.sigmoid(features[:, :3] + hidden @ self.last + self.last_bias)

    def whole(self) -> Float[Tensor, "nodes nodes nodes"]:
        """All distances, detached."""
        grid = self.frozen.clone()
        grid[self.active] = self.distances.detach()
        return grid.reshape(self.nodes, self.nodes, self.nodes)


def _uniform(shape: tuple[int, int], inputs: int, generator: torch.Generator, device: torch.device) -> Tensor:
    """Uniform start of variance 1 / inputs (LeCun), drawn on the CPU so that every device starts alike."""
    bound = math.sqrt(3.0 / inputs)
    return ((torch.rand(shape, generator=generator) * 2 - 1) * bound).to(device)
