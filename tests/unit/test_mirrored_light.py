"""Light by mirrored direction: told from differences, with how well it is known."""

import math

import pytest
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int64
from torch import Tensor

from backend.maths.mirrored_light import (
    BINS,
    gain_nats,
    means_of_bins,
    mirrored_bins,
    mirrored_light,
    spread_of_bins,
)

NOISE = 0.01


def directions(count: int, generator: torch.Generator) -> Float[Tensor, "count 3"]:
    return F.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)


def middles() -> Float[Tensor, "bins 3"]:
    """About the middle of every bin: the mean of directions in it."""
    many = directions(200_000, torch.Generator().manual_seed(5))
    bins = mirrored_bins(many, many)
    return F.normalize(torch.zeros(BINS, 3, dtype=torch.float64).index_add_(0, bins, many), dim=-1)


def lobe(towards: Float[Tensor, "places 3"]) -> Float[Tensor, "places"]:
    """A lamp above, on the right."""
    lamp = F.normalize(torch.tensor([1.0, 2.0, 0.5], dtype=torch.float64), dim=0)
    return 0.3 * torch.exp(((towards @ lamp) - 1) / 0.15)


def differences(
    generator: torch.Generator, count: int = 2000
) -> tuple[Float[Tensor, "cells bins"], Float[Tensor, "cells"], Int64[Tensor, "2 cells"]]:
    """Of the lamp in two photographs of each of some places, and noise."""
    one = directions(count, generator)
    other = F.normalize(one + 0.4 * directions(count, generator), dim=-1)
    bins = torch.stack([mirrored_bins(one, one), mirrored_bins(other, other)])
    rows = means_of_bins(bins[0], bins[1], torch.arange(count), 1).double()
    noise = NOISE * torch.randn(count, generator=generator, dtype=torch.float64)
    return rows, rows @ lobe(middles()) + noise, bins


def test_a_mirror_sends_a_ray_to_the_other_side_of_the_normal() -> None:
    generator = torch.Generator().manual_seed(0)
    normals, mirrored = directions(5000, generator), directions(5000, generator)
    towards = 2 * (normals * mirrored).sum(-1, keepdim=True) * normals - mirrored
    same = mirrored_bins(normals, towards) == mirrored_bins(mirrored, mirrored)
    assert float(same.double().mean()) > 0.999  # rounding at the borders of bins


def test_bins_cover_all_directions_and_none_is_wide() -> None:
    many = directions(20_000, torch.Generator().manual_seed(1))
    bins = mirrored_bins(many, many)
    assert sorted(set(bins.tolist())) == list(range(BINS))
    off_deg = torch.rad2deg(torch.acos((many * middles()[bins]).sum(-1).clamp(-1, 1)))
    assert float(off_deg.max()) < 20
    assert float(off_deg.mean()) < 8


def test_rows_are_means_over_cells() -> None:
    generator = torch.Generator().manual_seed(2)
    light = torch.randn(BINS, generator=generator)
    here, there = torch.randint(BINS, (2, 60), generator=generator)
    cell = torch.arange(60) % 7
    rows = means_of_bins(here, there, cell, 1)
    for number in range(7):
        which = cell == number
        expected = (light[here[which]] - light[there[which]]).mean()
        assert float(rows[number] @ light) == pytest.approx(float(expected), abs=1e-5)
    assert len(means_of_bins(here, there, cell, 9)) == 4  # 60 = 4 * 9 + 3 * 8
    assert not len(means_of_bins(here, there, cell, 10))


@pytest.mark.parametrize("spoiled", [0, 100])
def test_light_is_told_from_differences_of_which_some_may_be_anything(spoiled: int) -> None:
    rows, difference, _ = differences(torch.Generator().manual_seed(3))
    difference[:spoiled] += 0.5
    light = mirrored_light(rows, difference, torch.full((2000,), NOISE**2), NOISE)
    truth = lobe(middles())
    off = (light.mean - truth) - (light.mean - truth).mean()
    assert float(off.square().mean().sqrt()) < 0.1 * float(truth.std())


def test_it_says_how_well_it_is_known() -> None:
    """Errors of predictions are as large as it says, and much larger where nobody looked."""
    generator = torch.Generator().manual_seed(4)
    rows, difference, _ = differences(generator, 400)
    light = mirrored_light(rows, difference, torch.full((400,), NOISE**2), NOISE)
    here, there = torch.randint(BINS, (2, 3000), generator=generator)
    off = light.difference(here, there) - (lobe(middles())[here] - lobe(middles())[there])
    standard = off[here != there] / light.variance(here, there)[here != there].sqrt()
    assert 0.4 < float(standard.square().mean().sqrt()) < 1.5
    unknown = mirrored_light(rows[:0], difference[:0], difference[:0], NOISE)
    ratio = light.variance(here, there)[here != there] / unknown.variance(here, there)[here != there]
    scales2 = (3.0 / 0.3) ** 2  # of the largest light that is tried, and the least
    assert float(ratio.max()) <= scales2
    assert float(ratio.median()) < 0.1 * scales2


def test_the_difference_of_a_direction_from_itself_is_known_to_be_none() -> None:
    rows, difference, _ = differences(torch.Generator().manual_seed(6), 100)
    light = mirrored_light(rows, difference, torch.full((100,), NOISE**2), NOISE)
    every = torch.arange(BINS)
    torch.testing.assert_close(light.difference(every, every), torch.zeros(BINS, dtype=torch.float64))
    assert float(light.variance(every, every).max()) < 1e-12


def test_what_shines_is_predicted_better_and_what_is_matt_is_not() -> None:
    generator = torch.Generator().manual_seed(7)
    rows, shining, _ = differences(generator)
    matt = NOISE * torch.randn(2000, generator=generator, dtype=torch.float64)
    variance = torch.full((1000,), NOISE**2, dtype=torch.float64)
    gains = [
        gain_nats(
            mirrored_light(rows[:1000], difference[:1000], variance, NOISE),
            rows[1000:],
            difference[1000:],
            variance,
        )
        for difference in (shining, matt)
    ]
    assert gains[0] > 0.2
    assert abs(gains[1]) < 0.05


def test_a_gain_is_that_of_student_s_law() -> None:
    """Known exactly, light that explains all gains what the density at 0 is above that at the difference."""
    rows = torch.zeros(1, BINS, dtype=torch.float64)
    rows[0, 3], rows[0, 90] = 1, -1
    light = mirrored_light(rows, torch.tensor([0.5]).double(), torch.tensor([1e-12]).double(), 1.0)
    gain = gain_nats(light, rows, torch.tensor([0.5]).double(), torch.tensor([0.04]).double())
    assert gain == pytest.approx(2 * math.log1p(0.25 / (3 * 0.04)), rel=1e-3)


def test_what_is_left_over_spreads_by_direction() -> None:
    generator = torch.Generator().manual_seed(8)
    rows, _, bins = differences(generator)
    up = middles()[:, 1] > 0.3
    squares = (
        torch.where(up[bins[0]], 9.0, 1.0).double() * torch.randn(2000, generator=generator).double() ** 2
    )
    spread = spread_of_bins(rows, squares)
    assert float(spread.min()) >= 1
    assert float(spread[middles()[:, 1] > 0.7].mean()) == pytest.approx(9, rel=0.3)
    assert float(spread[middles()[:, 1] < -0.7].mean()) == pytest.approx(1, abs=0.3)
    torch.testing.assert_close(spread_of_bins(rows[:0], squares[:0]), torch.ones(BINS, dtype=torch.float64))
