"""Distances on a grid where it is delicate: at borders of cells and of the box, and without a gradient."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from backend.maths import losses
from backend.maths.gradients import central_gradient
from backend.maths.grid import (
    interpolate,
    laplacian,
    laplacian_at,
    locate,
    node_positions,
    spacing,
    value_and_gradient,
)
from backend.maths.hash_grid import corner_rows, encode, table_rows
from backend.maths.rays import sphere_entry
from tests.stability.sweep import Errors, Sweep, check, gradient, largest

CPU = torch.device("cpu")
NODES = (2, 3, 47, 96, 192)


@cache
def ball(nodes: int) -> Tensor:
    """Distances to a ball, in float64."""
    return node_positions(nodes, CPU).double().norm(dim=-1) - 0.6


def border_points(nodes: int) -> Tensor:
    """On nodes, a digit to either side of them, on the box's sides, and beyond."""
    generator = torch.Generator().manual_seed(0)
    node = torch.randint(nodes, (300, 3), generator=generator)
    on = node * spacing(nodes) - 1
    away = torch.nextafter(on, torch.full_like(on, 9.0))
    towards = torch.nextafter(on, torch.full_like(on, -9.0))
    side = 2 * torch.rand((300, 3), generator=generator) - 1
    side[torch.arange(300), node[:, 0] % 3] = torch.where(node[:, 1] % 2 == 0, 1.0, -1.0)
    return torch.cat([on, away, towards, side, 1.5 * side])


# interpolation


def stopped_short(points: Tensor, nodes: int) -> Tensor:
    """The ball's distance, with places kept from the last node by a ten-thousandth of a cell."""
    scaled = ((points + 1) * (0.5 * (nodes - 1))).clamp(0, nodes - 1 - 1e-4)
    return interpolate(ball(nodes).float(), locate(scaled * spacing(nodes) - 1, nodes))


def interpolated(points: Tensor, nodes: int) -> Tensor:
    return interpolate(ball(nodes).to(points.dtype), locate(points, nodes))


def border_error(value: Callable[[Tensor, int], Tensor]) -> float:
    """Largest, in units of the box's half side."""
    cases = [(border_points(nodes), nodes) for nodes in NODES]
    return max(largest(value(points, n), interpolated(points.double(), n)) for points, n in cases)


# gradients at borders

Slope = Callable[[Tensor, int], Tensor]
"""From places and a number of nodes to the gradient of the ball's interpolated distance."""


def slope_of_a_cell(points: Tensor, nodes: int) -> Tensor:
    return value_and_gradient(ball(nodes).to(points.dtype), locate(points, nodes))[1]


def slope_across_the_border(points: Tensor, nodes: int) -> Tensor:
    """A central difference that is narrow beside a cell."""
    step = 1e-2 * spacing(nodes)
    taps = step * torch.eye(3, dtype=points.dtype)
    ahead, behind = (interpolated((points[:, None] + sign * taps).reshape(-1, 3), nodes) for sign in (1, -1))
    return ((ahead - behind) / (2 * step)).reshape(-1, 3)


def border_slope_error(slope: Slope) -> Errors:
    """Difference from the gradient in that cell around each place which agrees best."""

    def error(nodes: int) -> float:
        points = border_points(nodes)
        found, inner = slope(points, nodes), points.double().clamp(-1, 1)
        step = 1e-3 * spacing(nodes)
        corners = torch.cartesian_prod(*[torch.tensor([-step, step], dtype=torch.float64)] * 3)
        apart = [(found - slope_of_a_cell(inner + corner, nodes)).abs().amax(dim=-1) for corner in corners]
        return float(torch.stack(apart).amin(dim=0).max())

    return {f"{nodes} nodes": error(nodes) for nodes in NODES}


def border_eikonal_error(slope: Slope) -> Errors:
    """Of the ball's eikonal loss at borders of cells and of the box, which is nearly 0.

    A cell's gradient is off by the square of its share of the radius.
    """
    errors = {}
    for nodes in NODES[2:]:
        points = border_points(nodes)[:1200]  # the others lie beyond the box
        far = points.norm(dim=-1) > 0.3
        errors[f"{nodes} nodes"] = float(losses.eikonal(slope(points[far], nodes)))
    return errors


# a network's gradient by differences


def slanted(points: Tensor) -> Tensor:
    """A plane's distance: differences of it are its normal at any step."""
    normal = torch.tensor([0.48, -0.6, 0.64], dtype=torch.float64).to(points.dtype)
    return points @ normal + 0.3


Difference = Callable[[Tensor, float], Tensor]
"""From places and a step to the plane's gradient."""


def over_twice_the_step(points: Tensor, step: float) -> Tensor:
    """Taps are moved to the box's side, and the step is taken for what it was."""
    taps = step * torch.eye(3)
    ahead, behind = (slanted((points[:, None] + sign * taps).clamp(-1, 1)) for sign in (1, -1))
    return (ahead - behind) / (2 * step)


def difference_error(differences: Difference) -> Errors:
    """With steps of 1/64, 1/160 and 1/512, as wide as a cell of the hash grid's last level."""
    generator = torch.Generator().manual_seed(0)
    inner = 1.9 * torch.rand((1000, 3), generator=generator) - 0.95
    sides = inner.clone()
    sides[torch.arange(1000), torch.arange(1000) % 3] = inner[:, 0].sign()
    exact = slanted(torch.eye(3).double()) - slanted(torch.zeros(1, 3).double())
    steps = (1 / 64, 1 / 160, 1 / 512)
    return {
        name: max(largest(differences(points, step), exact.expand(1000, 3)) for step in steps)
        for name, points in (("inside", inner), ("sides", sides))
    }


# the hash grid

CELLS = (4, 16, 160)
FEATURES = 2


def tables() -> list[Tensor]:
    """Of three levels, the last one hashed."""
    generator = torch.Generator().manual_seed(0)
    return [
        torch.rand((table_rows(cells, 2**17), FEATURES), generator=generator, dtype=torch.float64)
        for cells in CELLS
    ]


def hashed(points: Tensor) -> Tensor:
    return encode([table.to(points.dtype) for table in tables()], CELLS, points, len(CELLS))


def one_cell_beyond(points: Tensor) -> Tensor:
    """floor(x) as it is: on the far side of the box the cell is the one after the last."""
    found = []
    for table, cells in zip(tables(), CELLS, strict=True):
        scaled = (points.clamp(-1, 1) + 1) * (0.5 * cells)
        low = scaled.floor()
        x, y, z = torch.stack([1 - scaled + low, scaled - low], dim=1).unbind(-1)
        weight = x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]
        rows = corner_rows(low.long(), cells, len(table)).clamp(max=len(table) - 1)
        found.append((weight.flatten(1)[..., None] * table.to(points.dtype)[rows]).sum(dim=1))
    return torch.cat(found, dim=-1)


def hash_value_error(encoded: Callable[[Tensor], Tensor]) -> float:
    """On nodes, a digit beside them, on and beyond the box; features from 0 to 1."""
    return max(
        largest(encoded(points), hashed(points.double()))
        for points in (border_points(cells + 1) for cells in CELLS)
    )


def hash_slope_error(encoded: Callable[[Tensor], Tensor]) -> float:
    """Of the sum of features by the place, on nodes and on the box's sides: that of a cell beside it."""
    worst = 0.0
    for cells in CELLS:
        points = border_points(cells + 1)[:1200].clamp(-1, 1)
        found = gradient(encoded, points)
        step = 1e-5
        corners = torch.cartesian_prod(*[torch.tensor([-step, step], dtype=torch.float64)] * 3)
        # a place must not be moved over the box's side: there the features are constant
        beside = [(points.double() + corner).clamp(-1 + step, 1 - step) for corner in corners]
        apart = [(found - gradient(hashed, place)).abs().amax(dim=-1) for place in beside]
        if not found.isfinite().all():
            return math.inf
        worst = max(worst, float(torch.stack(apart).amin(dim=0).max()) / max(CELLS))
    return worst


def hash_sum(points: Tensor) -> Tensor:
    """The features' mean of each place, from 0 to 1: a field of differences."""
    return hashed(points).mean(dim=-1)


def difference_of(
    field: Callable[[Tensor], Tensor], points: Tensor, step: float, *, over_twice: bool
) -> Tensor:
    """By the taps' distance, or by twice the step where a tap is moved to the box's side too."""
    found = central_gradient(field, points, step)
    apart = (points + step).clamp(-1, 1) - (points - step).clamp(-1, 1)
    return found * apart / (2 * step) if over_twice else found


def hash_difference_error(over_twice: bool) -> Errors:
    """Over a cell of each level, on nodes, a digit beside them and on the box's sides; in 1 / step.

    Against the same in float64.
    """
    errors = {"within": 0.0, "box's sides": 0.0}
    for cells in CELLS:
        points, step = border_points(cells + 1)[:1200].clamp(-1, 1), 2 / cells
        found = difference_of(hash_sum, points, step, over_twice=over_twice)
        exact = central_gradient(hash_sum, points.double(), step)
        cut = (points.abs() > 1 - step).any(dim=-1)
        for name, here in (("within", ~cut), ("box's sides", cut)):
            if here.any():
                errors[name] = max(errors[name], largest(found[here], exact[here], 1 / step))
    return errors


# lengths of gradients


def gradients() -> Tensor:
    """Vectors of length 0 to 1e4 in all directions, many of them denormal."""
    lengths = torch.cat([torch.zeros(1), 10.0 ** torch.arange(-44, 5)])
    directions = F.normalize(torch.randn((20, 3), generator=torch.Generator().manual_seed(0)), dim=-1)
    return (lengths[:, None, None] * directions).reshape(-1, 3)


def plain_eikonal(g: Tensor) -> Tensor:
    return (g.square().sum(dim=-1).sqrt() - 1).square().mean()


def eikonal_slope_error(loss: Callable[[Tensor], Tensor]) -> float:
    """Of the derivative 2 (|g| - 1) g / |g|; where |g|^2 is denormal, only that it is of a size like that."""
    g = gradients()
    found = gradient(loss, g) * len(g)
    length = g.double().norm(dim=-1, keepdim=True)
    exact = 2 * (length - 1) * g.double() / length
    sharp = length[:, 0] > 1e-18
    too_large = float((found.norm(dim=-1) - 4).clamp(min=0)[~sharp].max())
    return max(largest(found[sharp], exact[sharp], 1 + length[sharp]), largest(found, found), too_large)


# Taylor residuals


def taylor_cases() -> tuple[Tensor, Tensor, Tensor]:
    """Distances, gradients, and offsets to a measured point."""
    g = gradients()
    generator = torch.Generator().manual_seed(1)
    return 0.1 * torch.randn(len(g), generator=generator), g, 0.1 * torch.randn(g.shape, generator=generator)


def pulled(distance: Tensor, g: Tensor, p_minus_q: Tensor) -> Tensor:
    """Neural-Pull (Ma et al., ICML 2021): how far p lies from q moved by f along g / |g|."""
    return (p_minus_q + distance[:, None] * g / g.norm(dim=-1, keepdim=True)).norm(dim=-1)


def newton_pulled(distance: Tensor, g: Tensor, p_minus_q: Tensor) -> Tensor:
    """The same by a Newton step: also the published program of SparseCraft's Taylor residual."""
    return (p_minus_q + distance[:, None] * g / g.square().sum(dim=-1, keepdim=True)).norm(dim=-1)


def taylor_error(residual: Callable[[Tensor, Tensor, Tensor], Tensor]) -> Errors:
    """Of the residual and of its derivative by the gradient, against their own values in float64.

    In shares of 1 + |g| + their own size.
    """
    distance, g, p_minus_q = taylor_cases()

    def slope(g: Tensor) -> Tensor:
        return gradient(lambda x: residual(distance.to(g.dtype), x, p_minus_q.to(g.dtype)), g)

    value, exact = residual(distance, g, p_minus_q), residual(*(x.double() for x in taylor_cases()))
    length = g.double().norm(dim=-1)
    size, by_g, exact_by_g = 1 + length, slope(g), slope(g.double())
    errors = {}
    for name, least, below in (("|g| = 0", 0, 1e-46), ("faint", 1e-46, 1e-11), ("|g| >= 1e-10", 1e-11, 1e9)):
        here = (length >= least) & (length < below)
        errors[name] = max(
            largest(value[here], exact[here], size[here] + exact[here].abs()),
            largest(by_g[here], exact_by_g[here], 1 + exact_by_g[here].norm(dim=-1, keepdim=True)),
        )
    return errors


def at_point_by_root(distance: Tensor, g: Tensor, offset: Tensor) -> Tensor:
    """f(q) - |grad f(p)| n . (q - p), the length as the root of the sum of squares."""
    return losses.taylor_at_point(distance, g.square().sum(dim=-1, keepdim=True).sqrt() * UP, offset)


def at_point(distance: Tensor, g: Tensor, offset: Tensor) -> Tensor:
    """As SparseCraft's loss here has it."""
    return losses.taylor_at_point(distance, losses.length(g)[:, None] * UP, offset)


UP = torch.tensor([0.0, 0.6, 0.8])
"""The measured normal."""


def at_point_error(residual: Callable[[Tensor, Tensor, Tensor], Tensor]) -> Errors:
    """Of the residual and of its derivative by the gradient at the point, in shares of 1 + |g|.

    The derivative, g / |g| n . (p - q), is 0 where g is; where |g|^2 is denormal, only its size is asked.
    """
    distance, g, p_minus_q = taylor_cases()
    length = g.double().norm(dim=-1)
    along = (p_minus_q.double() * UP.double()).sum(dim=-1)
    exact = distance.double() + length * along
    exact_by_g = F.normalize(g.double(), dim=-1, eps=1e-60) * along[:, None]
    value, by_g = residual(distance, g, p_minus_q), gradient(lambda x: residual(distance, x, p_minus_q), g)
    errors = {}
    for name, least, below in (("|g| = 0", 0, 1e-46), ("faint", 1e-46, 1e-18), ("|g| >= 1e-18", 1e-18, 1e9)):
        here = (length >= least) & (length < below)
        errors[name] = largest(value[here], exact[here], 1 + length[here])
        if name == "faint":
            too_steep = by_g[here].norm(dim=-1) - 2 * along[here].abs()
            size = float(too_steep.clamp(min=0).max())
            errors[name] = max(errors[name], size, largest(by_g[here], by_g[here]))
        else:
            errors[name] = max(errors[name], largest(by_g[here], exact_by_g[here]))
    return errors


def pull_error(pull: Callable[[Tensor, Tensor, Tensor], Tensor], least_slope: float, power: int) -> float:
    """Of |p - q + f g / |g|^power| and of its derivative by f; the derivative by g must be finite.

    A slope below `least_slope` counts as that.
    """
    distance, g, p_minus_q = taylor_cases()
    length = g.double().norm(dim=-1, keepdim=True).clamp(min=least_slope)
    step = g.double() / length**power
    exact = p_minus_q + distance.double()[:, None] * step
    value = pull(distance, g, p_minus_q)
    slope = gradient(lambda x: pull(x, g, p_minus_q), distance)
    exact_slope = (exact * step).sum(dim=-1) / exact.norm(dim=-1)
    by_g = gradient(lambda x: pull(distance, x, p_minus_q), g)
    size = 1 + step.norm(dim=-1)
    return max(
        largest(value, exact.norm(dim=-1), size), largest(slope, exact_slope, size), largest(by_g, by_g)
    )


# log mean exp


def log_mean_exp_error(soft_maximum: Callable[[Tensor, float], Tensor]) -> float:
    """Of losses from 1e-6 to 1e2 at temperatures from 1e-3 to 1e3, in shares of largest and temperature."""
    generator = torch.Generator().manual_seed(2)
    draws = 10 ** (8 * torch.rand((7, 500), generator=generator) - 6)
    worst = 0.0
    for temperature in (1e-3, 1e-1, 1.0, 10.0, 1e3):
        scaled = draws.double() / temperature
        exact = temperature * (torch.logsumexp(scaled, dim=0) - torch.tensor(7.0).double().log())
        size = draws.double().amax(dim=0) + temperature
        worst = max(worst, largest(soft_maximum(draws, temperature), exact, size))
    return worst


# curvature


def wrapping_laplacian(grid: Tensor) -> Tensor:
    """Neighbours by flat number, the sum of six less six times the middle."""
    nodes = len(grid)
    offsets = torch.tensor([1, -1, nodes, -nodes, nodes * nodes, -nodes * nodes])
    around = (torch.arange(nodes**3)[:, None] + offsets).clamp(0, nodes**3 - 1)
    flat = grid.flatten()
    return flat[around].sum(dim=-1) - 6 * flat


def our_laplacian(grid: Tensor) -> Tensor:
    nodes = len(grid)
    return laplacian_at(lambda index: grid.flatten()[index], torch.arange(nodes**3), nodes)


def laplacian_error(bent: Callable[[Tensor], Tensor]) -> float:
    """At every node of a ball's distances, in cells."""
    worst = 0.0
    for nodes in NODES[:-1]:
        grid = ball(nodes).float()
        worst = max(
            worst, largest(bent(grid) / spacing(nodes), laplacian(grid.double()).flatten() / spacing(nodes))
        )
    return worst


# small losses


def relative_error(
    function: Callable[[Tensor], Tensor], exact: Callable[[Tensor], Tensor], at: Tensor
) -> float:
    truth = exact(at.double())
    return largest(function(at), truth, truth)


def residuals() -> Tensor:
    return 10.0 ** torch.arange(-12, 5)


def exact_charbonnier(x: Tensor) -> Tensor:
    """With scale 1; in float64 right to 1e-8 from x = 1e-4 on, and there x^2 / 2 begins to be."""
    return torch.where(x < 1e-4, x.square() / 2, torch.hypot(torch.ones_like(x), x) - 1)


def logits() -> Tensor:
    return torch.linspace(-80, 80, 161)


def exact_entropy(x: Tensor) -> Tensor:
    """In float64 by the two probabilities, each from its own side."""
    inside, outside = torch.sigmoid(-x), torch.sigmoid(x)
    return -inside * F.logsigmoid(-x) - outside * F.logsigmoid(x)


# where rays enter


def far_rays() -> tuple[Tensor, Tensor]:
    """Towards the unit sphere from 2 to 1e4 away."""
    generator = torch.Generator().manual_seed(0)
    away = 10.0 ** torch.linspace(0.3, 4, 200)[:, None]
    origins = away * F.normalize(torch.randn((200, 3), generator=generator), dim=-1)
    targets = 0.5 * F.normalize(torch.randn((200, 3), generator=generator), dim=-1)
    return origins, F.normalize(targets - origins, dim=-1)


def by_discriminant(origins: Tensor, directions: Tensor) -> Tensor:
    b = (origins * directions).sum(dim=-1)
    return -b - (b * b - origins.square().sum(dim=-1) + 1).sqrt()


def entry_error(entry: Callable[[Tensor, Tensor], Tensor]) -> float:
    """In shares of the way."""
    origins, directions = far_rays()
    unit = F.normalize(directions.double(), dim=-1)
    exact = by_discriminant(origins.double(), unit)
    return largest(entry(origins, directions), exact, exact)


SWEEPS = (
    Sweep(
        what="distance on nodes, a digit beside them, on and beyond the box; 2 to 192 nodes",
        usual_formula="stopping 1e-4 of a cell before the last node",
        usual=lambda: border_error(stopped_short),
        ours=lambda: border_error(interpolated),
        tolerance=1e-6,
    ),
    Sweep(
        what="gradient at borders of cells and of the box, against that of a cell beside; 2 to 192 nodes",
        usual_formula="a central difference over a fiftieth of a cell",
        usual=lambda: border_slope_error(slope_across_the_border),
        ours=lambda: border_slope_error(slope_of_a_cell),
        tolerance=5e-3,  # beside the border by a thousandth of a cell
        usual_holds=("2 nodes",),  # one cell, in which the ball's distance is constant
    ),
    Sweep(
        what="eikonal loss of a ball at borders of cells and of the box, 47 to 192 nodes",
        usual_formula="a central difference over a fiftieth of a cell",
        usual=lambda: border_eikonal_error(slope_across_the_border),
        ours=lambda: border_eikonal_error(slope_of_a_cell),
        tolerance=1e-3,
    ),
    Sweep(
        what="a plane's gradient by differences, steps of 1/512 to 1/64, at the box's sides too",
        usual_formula="over twice the step, also where a tap is moved to the side",
        usual=lambda: difference_error(over_twice_the_step),
        ours=lambda: difference_error(lambda x, step: central_gradient(slanted, x, step)),
        tolerance=2e-4,  # a digit of the distance over 1/512
        usual_holds=("inside",),
    ),
    Sweep(
        what="the same with a step that is lost in the digits",
        usual_formula="a step of 1e-6",
        usual=lambda: difference_error(lambda x, _: central_gradient(slanted, x, 1e-6)),
        ours=lambda: difference_error(lambda x, step: central_gradient(slanted, x, step)),
        tolerance=2e-4,
    ),
    Sweep(
        what="features of a hash grid on nodes, a digit beside them, on and beyond the box",
        usual_formula="stopping 1e-4 of a cell before the last node",
        usual=lambda: hash_value_error(lambda x: hashed(x.clamp(-1, 1 - 2e-4 / max(CELLS)))),
        ours=lambda: hash_value_error(hashed),
        tolerance=5e-5,  # a digit of the place is 1e-5 of the finest cell
    ),
    Sweep(
        what="their gradient there, against that of a cell beside, in cells of the finest level",
        usual_formula="the cell of floor(x): beyond the last node at the far side",
        usual=lambda: hash_slope_error(one_cell_beyond),
        ours=lambda: hash_slope_error(hashed),
        tolerance=1e-2,
    ),
    Sweep(
        what="their gradient by differences over a cell, on and beside nodes and the sides, in 1 / step",
        usual_formula="over twice the step, also where a tap is moved to the side",
        usual=lambda: hash_difference_error(over_twice=True),
        ours=lambda: hash_difference_error(over_twice=False),
        tolerance=2e-5,
        usual_holds=("within",),
    ),
    Sweep(
        what="derivative of the eikonal loss, |g| from 0 to 1e4, in shares of 1 + |g|",
        usual_formula="(|g| - 1)^2",
        usual=lambda: eikonal_slope_error(plain_eikonal),
        ours=lambda: eikonal_slope_error(losses.eikonal),
        tolerance=1e-6,
    ),
    Sweep(
        what="Taylor residual and its derivative, |g| from 0 to 1e4, in shares of 1 + |g| and itself",
        usual_formula="|p - (q - f g / |g|^2)|, SparseCraft's published program",
        usual=lambda: taylor_error(newton_pulled),
        ours=lambda: taylor_error(losses.taylor_at_query),
        tolerance=1e-6,
        usual_holds=("|g| >= 1e-10",),
    ),
    Sweep(
        what="Taylor residual at the point, f - |g| n . (q - p), and its derivative, |g| from 0 to 1e4",
        usual_formula="|g| as the root of the sum of squares",
        usual=lambda: at_point_error(at_point_by_root),
        ours=lambda: at_point_error(at_point),
        tolerance=1e-6,
        usual_holds=("|g| >= 1e-18",),
    ),
    Sweep(
        what="Neural-Pull's residual and its derivative, |g| from 0 to 1e4",
        usual_formula="pulling by f g / |g|",
        usual=lambda: pull_error(pulled, 1e-6, power=1),
        ours=lambda: pull_error(losses.pull, 1e-6, power=1),
        tolerance=1e-6,
    ),
    Sweep(
        what="the same by a Newton step, slopes below 0.1 taken as that",
        usual_formula="f g / |g|^2",
        usual=lambda: pull_error(newton_pulled, 0.1, power=2),
        ours=lambda: pull_error(lambda *x: losses.newton_pull(*x, least_slope=0.1), 0.1, power=2),
        tolerance=1e-6,
    ),
    Sweep(
        what="soft maximum of losses 1e-6 to 1e2, temperatures 1e-3 to 1e3, in shares of the largest",
        usual_formula="T log mean exp(loss / T)",
        usual=lambda: log_mean_exp_error(lambda x, t: t * (x / t).exp().mean(dim=0).log()),
        ours=lambda: log_mean_exp_error(losses.log_mean_exp),
        tolerance=1e-6,
    ),
    Sweep(
        what="Laplacian at every node, those of the sides too, in cells",
        usual_formula="neighbours by flat number, six less six times the middle",
        usual=lambda: laplacian_error(wrapping_laplacian),
        ours=lambda: laplacian_error(our_laplacian),
        tolerance=1e-6,
    ),
    Sweep(
        what="Charbonnier loss of residuals 1e-12 to 1e4 scales, relative",
        usual_formula="sqrt(1 + x^2) - 1",
        usual=lambda: relative_error(lambda x: (1 + x * x).sqrt() - 1, exact_charbonnier, residuals()),
        ours=lambda: relative_error(lambda x: losses.charbonnier(x, 1.0), exact_charbonnier, residuals()),
        tolerance=1e-6,
    ),
    Sweep(
        what="entropy of the side, logits -80 to 80, relative",
        usual_formula="softplus(x) - x sigmoid(x)",
        usual=lambda: relative_error(lambda x: F.softplus(x) - x * torch.sigmoid(x), exact_entropy, logits()),
        ours=lambda: relative_error(lambda x: losses.entropy_of_side(x, 1.0), exact_entropy, logits()),
        tolerance=1e-6,
    ),
    Sweep(
        what="where rays enter the unit sphere from 2 to 1e4 away, in shares of the way",
        usual_formula="b^2 - c, the quadratic's discriminant",
        usual=lambda: entry_error(by_discriminant),
        ours=lambda: entry_error(sphere_entry),
        tolerance=1e-6,
    ),
)


@pytest.mark.parametrize("sweep", SWEEPS, ids=lambda sweep: sweep.what)
def test_sweep(sweep: Sweep) -> None:
    check(sweep)


@pytest.mark.parametrize("nodes", NODES[1:])
def test_the_eikonal_loss_of_a_ball_pulls_at_borders_as_in_double_precision(nodes: int) -> None:
    """At all border points, beyond the box too; in shares of what one of them can pull."""
    corners = locate(border_points(nodes), nodes)
    exact = replace(corners, weight=corners.weight.double(), slope=corners.slope.double())
    found = gradient(lambda grid: losses.eikonal(value_and_gradient(grid, corners)[1]), ball(nodes).float())
    true = gradient(lambda grid: losses.eikonal(value_and_gradient(grid, exact)[1]), ball(nodes))
    one = 2 / spacing(nodes) / len(border_points(nodes))
    assert largest(found, true, one) < 5e-4, "a few digits of the distance over a cell"


def test_a_flat_place_has_no_normal_and_no_infinite_one() -> None:
    """As the renderer has it: g / max(|g|, 1e-3) is 0 at 0; g / |g| is not a number."""
    g = gradients()
    normal = F.normalize(g, dim=-1, eps=1e-3)
    assert normal.norm(dim=-1).max() < 1 + 1e-6
    assert gradient(lambda x: F.normalize(x, dim=-1, eps=1e-3), g).abs().max() < 2e3
    assert not (g / g.square().sum(dim=-1, keepdim=True).sqrt()).isfinite().all()


def test_a_field_without_slope_has_losses_that_say_so() -> None:
    """All of a box at one distance: eikonal 1, curvature 0, and the residual is that distance."""
    grid = torch.full((9, 9, 9), 0.25, requires_grad=True)
    points = border_points(9)
    value, slope = value_and_gradient(grid, locate(points, 9))
    assert losses.eikonal(slope).item() == pytest.approx(1.0, abs=1e-5)
    assert (our_laplacian(grid) == 0).all()
    residual = losses.taylor_at_query(value, slope, torch.ones_like(points))
    torch.testing.assert_close(residual, torch.full_like(residual, 0.25))
    total = losses.eikonal(slope) + residual.square().mean() + our_laplacian(grid).square().mean()
    (found,) = torch.autograd.grad(total, grid)
    assert found.isfinite().all()
