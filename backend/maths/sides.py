"""Which side of a surface each place is on: to change sides one has to pass near points.

A network that is pulled onto points may close a bore or a recess by a lid on which no point lies. Such a lid
is found by a walk: far from points the side stays, and changes only where points are. This is the random
walker (Grady, PAMI 2006) with the cube of the unsigned distance for conductance. It minimises

    sum over edges  c_ij (u_i - u_j)^2  +  trust * sum over nodes  (u_i - s_i)^2,

where s, from -1 to 1, is the side by the field so far; u = 1 on the sides of the cube, which are outside.
"""

import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from .conjugate_gradients import conjugate_gradients
from .grid import node_positions, spacing

_TRUST = 0.3
"""In the field so far at a node; an edge half as far from points as they are apart has 1."""
_OUTSIDE = 1e6
"""The same for the sides of the cube."""
_CLOSEST = 0.05
"""Least length that counts: an edge with a point on it is not quite cut."""
_NEIGHBOUR = 4
"""The distance to it is about how far apart the points of a surface are: 1.1 / sqrt(density)."""
_STEPS = 150


def sides_by_walking(
    field: Float[Tensor, "nodes nodes nodes"], points: Float[Tensor, "points 3"]
) -> Float[Tensor, "nodes nodes nodes"]:
    """The distance to the points times the side, -1 to 1 where it is in doubt; > 0 outside as the field is.

    The length that counts is half the distance between points around there, or a cell if that is more.
    """
    nodes, h = len(field), spacing(len(field))
    distance, apart = _distance_and_spacing(points, nodes)
    openness = (distance / (apart / 2).clamp(min=h)).clamp(min=_CLOSEST)
    conductance = [
        ((openness.narrow(axis, 1, nodes - 1) + openness.narrow(axis, 0, nodes - 1)) / 2) ** 3
        for axis in range(3)
    ]
    outer = torch.ones_like(field, dtype=torch.bool)
    outer[1:-1, 1:-1, 1:-1] = False
    trust = torch.where(outer, _OUTSIDE, torch.full_like(field, _TRUST))
    side = torch.where(outer, 1.0, torch.tanh(field / h))
    return distance * random_walk(side, trust, conductance, steps=_STEPS)


def random_walk(
    side: Float[Tensor, "nodes nodes nodes"],
    trust: Float[Tensor, "nodes nodes nodes"],
    conductance: list[Float[Tensor, "_ _ _"]],
    *,
    steps: int,
) -> Float[Tensor, "nodes nodes nodes"]:
    """The minimum of the energy above, by conjugate gradients from `side`.

    `conductance` is of the edges along each axis; that axis is shorter by one. `trust` is > 0.
    """

    def apply(u: Tensor) -> Tensor:
        out = trust * u
        for axis, open_ in enumerate(conductance):
            count = u.shape[axis] - 1
            flow = open_ * (u.narrow(axis, 1, count) - u.narrow(axis, 0, count))
            out.narrow(axis, 0, count).sub_(flow)
            out.narrow(axis, 1, count).add_(flow)
        return out

    diagonal = trust.clone()
    for axis, open_ in enumerate(conductance):
        diagonal.narrow(axis, 0, open_.shape[axis]).add_(open_)
        diagonal.narrow(axis, 1, open_.shape[axis]).add_(open_)
    return conjugate_gradients(apply, diagonal, trust * side, side, steps=steps)


def _distance_and_spacing(
    points: Float[Tensor, "points 3"], nodes: int
) -> tuple[Float[Tensor, "nodes nodes nodes"], Float[Tensor, "nodes nodes nodes"]]:
    """How far each node is from its nearest point, and how far that one's neighbours are from it."""
    places = points.cpu().numpy()
    tree = cKDTree(places)
    reach, _ = tree.query(places, k=[min(_NEIGHBOUR + 1, len(places))], workers=-1)
    distance, nearest = tree.query(
        node_positions(nodes, torch.device("cpu")).reshape(-1, 3).numpy(), workers=-1
    )

    def on_grid(values: object) -> Tensor:
        return torch.as_tensor(values, dtype=points.dtype).reshape(nodes, nodes, nodes).to(points.device)

    return on_grid(distance), on_grid(reach[nearest, 0])
