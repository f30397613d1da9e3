"""Light that a surface mirrors: what shines looks different from two sides, alike where it faces alike.

From far lights a place mirrors what arrives along its mirrored ray, blurred by how rough it is: one function
of a direction for the whole thing (Blinn and Newell, "Texture and Reflection in Computer Generated Images",
CACM 1976). What two photographs show of a place differs by that function at one direction less it at another.
Such differences determine it and say how well they do, if a Gaussian process is what was thought of it
before; its scale has the largest evidence (MacKay, "Bayesian Interpolation", Neural Computation 1992).
"""

from dataclasses import dataclass
from functools import cache

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int64
from torch import Tensor

_SIDE = 12
BINS = _SIDE * _SIDE
"""Directions that are told apart, some 15 degrees wide."""
_LOBE_RAD = 0.4
"""As far as that the light from two directions is alike: what is rougher than a mirror blurs it as much."""
_SCALES = (0.3, 1.0, 3.0)
"""Of the light, beside the noise, that are tried."""
_ITERATIONS = 3
"""Of weights that keep outliers from counting: edges, and what hides one place from a photograph."""
_OUTLYING = 3.0
"""Standard deviations at which a difference counts half."""
_FREEDOM = 3.0
"""Degrees of it, of Student's law, by which predictions are judged: its tails are as long as those seen."""


@dataclass(frozen=True, kw_only=True)
class MirroredLight:
    """From all sides, up to a constant, and how well it is known."""

    mean: Float[Tensor, "bins"]
    covariance: Float[Tensor, "bins bins"]

    def to(self, device: torch.device) -> "MirroredLight":
        """The same in single precision on a device."""
        return MirroredLight(mean=self.mean.float().to(device), covariance=self.covariance.float().to(device))

    def difference(
        self, here: Int64[Tensor, "*places"], there: Int64[Tensor, "*places"]
    ) -> Float[Tensor, "*places"]:
        """From one direction less from another."""
        return self.mean[here] - self.mean[there]

    def variance(
        self, here: Int64[Tensor, "*places"], there: Int64[Tensor, "*places"]
    ) -> Float[Tensor, "*places"]:
        """Of that."""
        own = self.covariance.diagonal()
        return (own[here] + own[there] - 2 * self.covariance[here, there]).clamp(min=0)


def mirrored_bins(
    normals: Float[Tensor, "places 3"], towards: Float[Tensor, "places 3"]
) -> Int64[Tensor, "places"]:
    """In which bin the mirrored direction is, of unit vectors `towards` the camera.

    Bins are the squares of an octahedron's eight faces, unfolded (Cigolle et al., "A Survey of Efficient
    Representations for Independent Unit Vectors", JCGT 2014).
    """
    mirrored = 2 * (normals * towards).sum(dim=-1, keepdim=True) * normals - towards
    x, y, z = (mirrored / mirrored.abs().sum(dim=-1, keepdim=True)).unbind(dim=-1)
    u, v = _folded(x, y, z < 0)
    row, column = (((side + 1) / 2 * _SIDE).long().clamp(0, _SIDE - 1) for side in (u, v))
    return row * _SIDE + column


def means_of_bins(
    here: Int64[Tensor, "places"], there: Int64[Tensor, "places"], cell: Int64[Tensor, "places"], fewest: int
) -> Float[Tensor, "cells bins"]:
    """Rows that, times the light, are cells' means of its differences; as brightness.means_of_cells."""
    count = torch.bincount(cell)
    sums = torch.zeros(len(count) * BINS, device=cell.device)
    one = torch.ones(len(cell), device=cell.device)
    sums.index_add_(0, cell * BINS + here, one).index_add_(0, cell * BINS + there, -one)
    return (sums.view(-1, BINS) / count.clamp(min=1)[:, None])[count >= fewest]


def mirrored_light(
    rows: Float[Tensor, "cells bins"],
    difference: Float[Tensor, "cells"],
    variance: Float[Tensor, "cells"],
    noise: float,
) -> MirroredLight:
    """The light that explains differences of so much variance; `noise` is the least deviation of any."""
    half = torch.linalg.cholesky(_alike())
    weight, a = 1 / variance, rows @ half
    for _ in range(_ITERATIONS):
        own, axes = torch.linalg.eigh(a.T @ (weight[:, None] * a))
        own, seen = own.clamp(min=0), axes.T @ (a.T @ (weight * difference))
        scale2 = max(((scale * noise) ** 2 for scale in _SCALES), key=lambda s2: _log_evidence(own, seen, s2))
        posterior = scale2 / (1 + scale2 * own)
        known = half @ axes
        mean = known @ (posterior * seen)
        off2 = (difference - rows @ mean).square() / variance
        weight = 1 / (variance * (1 + off2 / _OUTLYING**2))
    return MirroredLight(mean=mean, covariance=(known * posterior) @ known.T)


def gain_nats(
    light: MirroredLight,
    rows: Float[Tensor, "cells bins"],
    difference: Float[Tensor, "cells"],
    variance: Float[Tensor, "cells"],
) -> float:
    """How much better it predicts differences than none: mean logarithm of the ratio of their densities."""
    predicted = ((rows @ light.covariance) * rows).sum(dim=-1).clamp(min=0)
    without = _log_density(difference, variance)
    return float((_log_density(difference - rows @ light.mean, variance + predicted) - without).mean())


def spread_of_bins(
    rows: Float[Tensor, "cells bins"], squares: Float[Tensor, "cells"]
) -> Float[Tensor, "bins"]:
    """The mean about each direction of squares that should be 1; at least 1.

    One more of them counts, that is 1: a direction that few cells look in tells little.
    """
    near = _alike() @ rows.abs().T
    return ((near @ squares + 1) / (near.sum(dim=-1) + 1)).clamp(min=1)


def _log_evidence(own: Float[Tensor, "bins"], seen: Float[Tensor, "bins"], scale2: float) -> float:
    """Up to what does not depend on the scale."""
    explained = (scale2 * seen.square() / (1 + scale2 * own)).sum()
    return float(explained - torch.log1p(scale2 * own).sum()) / 2


def _log_density(off: Float[Tensor, "cells"], variance: Float[Tensor, "cells"]) -> Float[Tensor, "cells"]:
    """Student's, up to a constant."""
    tails = (_FREEDOM + 1) / 2 * torch.log1p(off.square() / (_FREEDOM * variance))
    return -variance.log() / 2 - tails


@cache
def _alike() -> Float[Tensor, "bins bins"]:
    """How alike the light is from any two bins; a little more by itself, so that it can be factored."""
    side = (torch.arange(_SIDE, dtype=torch.float64) + 0.5) / _SIDE * 2 - 1
    u, v = (axis.flatten() for axis in torch.meshgrid(side, side, indexing="ij"))
    z = 1 - u.abs() - v.abs()
    directions = F.normalize(torch.stack([*_folded(u, v, z < 0), z], dim=-1), dim=-1)
    alike = torch.exp((directions @ directions.T - 1) / _LOBE_RAD**2)
    return alike + 1e-6 * torch.eye(BINS, dtype=torch.float64)


def _folded(x: Tensor, y: Tensor, below: Tensor) -> tuple[Tensor, Tensor]:
    """An octahedron's lower faces turned over its edges to the corners of a square, or back."""
    over_x, over_y = torch.copysign(1 - y.abs(), x), torch.copysign(1 - x.abs(), y)
    return torch.where(below, over_x, x), torch.where(below, over_y, y)
