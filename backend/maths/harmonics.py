"""Spherical harmonics: functions of a direction, orthonormal over the sphere, of ever more lobes."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

NUM_HARMONICS = 16
"""Of degrees 0 to 3."""


def spherical_harmonics(directions: Float[Tensor, "points 3"]) -> Float[Tensor, "points 16"]:
    """The real harmonics of degrees 0 to 3, degree by degree, orders -l to l, as polynomials of x, y, z.

    Those of unit vectors, without the sign (-1)^m of physics. The integral of the product of two over the
    sphere is 1 for the same and 0 for different ones. What hash grids' programs call degree 4.
    """
    x, y, z = directions.unbind(dim=-1)
    xx, yy, zz = x * x, y * y, z * z
    found = (
        math.sqrt(1 / 4) * torch.ones_like(x),
        math.sqrt(3 / 4) * y,
        math.sqrt(3 / 4) * z,
        math.sqrt(3 / 4) * x,
        math.sqrt(15 / 4) * x * y,
        math.sqrt(15 / 4) * y * z,
        math.sqrt(5 / 16) * (3 * zz - 1),
        math.sqrt(15 / 4) * x * z,
        math.sqrt(15 / 16) * (xx - yy),
        math.sqrt(35 / 32) * y * (3 * xx - yy),
        math.sqrt(105 / 4) * x * y * z,
        math.sqrt(21 / 32) * y * (5 * zz - 1),
        math.sqrt(7 / 16) * z * (5 * zz - 3),
        math.sqrt(21 / 32) * x * (5 * zz - 1),
        math.sqrt(105 / 16) * z * (xx - yy),
        math.sqrt(35 / 32) * x * (xx - 3 * yy),
    )
    return torch.stack(found, dim=-1) / math.sqrt(math.pi)
