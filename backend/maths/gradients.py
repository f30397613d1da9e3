"""Gradients of a distance field in space, for fields that are functions rather than grids."""

import torch
from jaxtyping import Float
from torch import Tensor

from .rays import DistanceFunction


def analytic_gradient(
    distance: Float[Tensor, "points"], points: Float[Tensor, "points 3"]
) -> Float[Tensor, "points 3"]:
    """Gradient of distances that were computed from the points; itself differentiable in the parameters.

    Each distance depends on its own point alone, and the points require gradients.
    """
    (gradient,) = torch.autograd.grad(distance.sum(), points, create_graph=True)
    return gradient


def central_gradient(
    distance: DistanceFunction, points: Float[Tensor, "points 3"], step: float
) -> Float[Tensor, "points 3"]:
    """Difference of the field `step` before and behind each point along each axis, over their distance.

    Neuralangelo (Li et al., arXiv:2306.03092), section 3.1: with steps as wide as a grid's cells it is
    continuous across them and reaches all nodes around. A tap outside the cube [-1, 1]^3, where the field
    is not defined, is moved to its side, and the shorter distance counts.
    """
    steps = step * torch.eye(3, dtype=points.dtype, device=points.device)
    ahead, behind = ((points[:, None] + sign * steps).clamp(-1, 1) for sign in (1, -1))
    values = distance(torch.cat([ahead, behind]).reshape(-1, 3)).reshape(2, *points.shape)
    return (values[0] - values[1]) / (ahead - behind).diagonal(dim1=1, dim2=2)
