"""Which side of a surface each place is on: one changes it by passing between points, and there one does.

A network that is pulled onto points may close a bore or a recess by a lid on which no point lies. Such a lid
is found by a walk (the random walker, Grady, PAMI 2006): far from points the side stays, from a bore's mouth
to its end, and across each point it is the opposite one. The second law is what keeps a ball with a gap from
being hollowed out through it: behind the points of its far wall there is outside already. It minimises

    sum over edges c_ij (u_i - u_j)^2 + sum over points w_p (u(p + s n) + u(p - s n))^2
                                      + trust * sum over nodes (u_i - s_i)^2

where c grows from where points are with the cube of the distance to them, n is the normal of either sign and
s_i, -1 to 1, the side by the field so far; u = 1 on the sides of the cube, which are outside.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from .conjugate_gradients import conjugate_gradients
from .evidence import merged_points
from .grid import Corners, interpolate, locate, node_positions, spacing, splat
from .nearest import nearest_tree

_TRUST = 0.03
"""In the field so far at a node; an edge half as far from points as they are apart has 1."""
_OUTSIDE = 1e6
"""The same for the sides of the cube."""
_CLOSEST = 0.05
"""Least length that counts: an edge with a point on it is not quite cut."""
_WIDEST = 4.0
"""Most that an edge conducts. Without a bound the widest room decides for all that is open to it."""
_OPPOSITE = 100.0
"""Weight of the points in one cell."""
_NEIGHBOUR = 4
"""The distance to it is about how far apart the points of a surface are: 1.1 / sqrt(density)."""
_STEPS = 150


@dataclass(frozen=True, kw_only=True)
class Sides:
    """Which side of the surface each node of a grid is on, and how much that tells of its distance."""

    distance: Float[Tensor, "nodes nodes nodes"]
    """To the nearest point, times the side: > 0 outside, less where the side is in doubt."""
    clearance: Float[Tensor, "nodes nodes nodes"]
    """The same without a sign, in distances between the points around there. Below one or two the nearest
    point's noise, and the gap to the next, are most of `distance`."""


@dataclass(frozen=True, kw_only=True)
class Crossings:
    """Pairs of places on either side of a surface."""

    one: Corners
    other: Corners
    weight: Float[Tensor, "pairs"]


def sides_by_walking(
    field: Float[Tensor, "nodes nodes nodes"],
    points: Float[Tensor, "points 3"],
    normals: Float[Tensor, "points 3"],
    weight: Float[Tensor, "points"],
) -> Sides:
    """The sides by the walk; `field` is > 0 outside, `weight`, 0 to 1, of the normals, whose signs are free.

    The length that counts is half the distance between points around there, or a cell if that is more. The
    sides are asked for four such lengths apart.
    """
    nodes, h = len(field), spacing(len(field))
    tree = nearest_tree(points.cpu().numpy())
    around, _ = tree.query(tree.data, k=[min(_NEIGHBOUR + 1, tree.n)], workers=-1)
    far, nearest = tree.query(node_positions(nodes, torch.device("cpu")).numpy(), workers=-1)
    distance, apart = torch.as_tensor(far).to(field), torch.as_tensor(around[nearest, 0]).to(field)
    openness = (distance / (apart / 2).clamp(min=h)).clamp(min=_CLOSEST)
    conductance = [
        ((openness.narrow(axis, 1, nodes - 1) + openness.narrow(axis, 0, nodes - 1)) / 2)
        .pow(3)
        .clamp(max=_WIDEST)
        for axis in range(3)
    ]
    outer = torch.ones_like(field, dtype=torch.bool)
    outer[1:-1, 1:-1, 1:-1] = False
    trust = torch.where(outer, _OUTSIDE, torch.full_like(field, _TRUST))
    side = torch.where(outer, 1.0, torch.tanh(field / h))
    merged, direction, share = merged_points(points, normals, weight, h)
    _, nearest = tree.query(merged.cpu().numpy(), workers=-1)
    step = torch.as_tensor(around[nearest, 0]).to(field).clamp(min=2 * h)[:, None] * direction
    crossings = Crossings(
        one=locate(merged + step, nodes),
        other=locate(merged - step, nodes),
        weight=_OPPOSITE * share.clamp(max=1),
    )
    walked = random_walk(side, trust, conductance, crossings, steps=_STEPS).clamp(-1, 1)
    return Sides(distance=distance * walked, clearance=distance / apart.clamp(min=h))


def random_walk(
    side: Float[Tensor, "nodes nodes nodes"],
    trust: Float[Tensor, "nodes nodes nodes"],
    conductance: list[Float[Tensor, "_ _ _"]],
    crossings: Crossings,
    *,
    steps: int,
) -> Float[Tensor, "nodes nodes nodes"]:
    """The minimum of the energy above, by conjugate gradients from `side`.

    `conductance` is of the edges along each axis; that axis is shorter by one. `trust` is > 0.
    """
    nodes = len(side)
    places = (crossings.one, crossings.other)

    def apply(u: Tensor) -> Tensor:
        out = trust * u
        for axis, open_ in enumerate(conductance):
            count = nodes - 1
            flow = open_ * (u.narrow(axis, 1, count) - u.narrow(axis, 0, count))
            out.narrow(axis, 0, count).sub_(flow)
            out.narrow(axis, 1, count).add_(flow)
        same = crossings.weight * (interpolate(u, places[0]) + interpolate(u, places[1]))
        for place in places:
            out += splat(same[:, None], place, nodes).reshape(u.shape)
        return out

    diagonal = trust.clone()
    for axis, open_ in enumerate(conductance):
        diagonal.narrow(axis, 0, open_.shape[axis]).add_(open_)
        diagonal.narrow(axis, 1, open_.shape[axis]).add_(open_)
    for place in places:
        own = crossings.weight[:, None] * place.weight.square()
        diagonal.view(-1).index_add_(0, place.index.flatten(), own.flatten())
    return conjugate_gradients(apply, diagonal, trust * side, side, steps=steps)
