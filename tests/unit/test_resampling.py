"""New positions on rays: by the inverse distribution function, also where weights are hardly any."""

import pytest
import torch
from torch import Tensor

from backend.maths.resampling import resample, strata

EDGES = torch.tensor([[0.0, 1.0, 1.5, 3.0, 4.0]])


def evenly(count: int, rays: int = 1) -> Tensor:
    return strata(rays, count, None, torch.device("cpu"))


def counted(samples: Tensor) -> Tensor:
    """Share of the samples in each interval of EDGES."""
    interval = torch.searchsorted(EDGES[0], samples[0], right=True) - 1
    return torch.bincount(interval, minlength=4) / samples.shape[1]


def test_positions_invert_the_distribution() -> None:
    """Weights 1, 3: the quarter lies at the first one's end, half the rest in the middle of the second."""
    edges = torch.tensor([[0.0, 2.0, 3.0]])
    found = resample(edges, torch.tensor([[1.0, 3.0]]), torch.tensor([[0.0, 0.125, 0.25, 0.625]]))
    torch.testing.assert_close(found, torch.tensor([[0.0, 1.0, 2.0, 2.5]]))


def test_a_share_at_an_edge_does_not_fall_into_an_interval_without_weight() -> None:
    """Half of the weight lies before the gap: the share of one half begins after it."""
    edges = torch.tensor([[0.0, 1.0, 5.0, 6.0]])
    found = resample(edges, torch.tensor([[1.0, 0.0, 1.0]]), torch.tensor([[0.0, 0.5]]))
    torch.testing.assert_close(found, torch.tensor([[0.0, 5.0]]))


def test_each_interval_gets_samples_by_its_weight_whatever_its_length() -> None:
    weights = torch.tensor([[0.1, 0.2, 0.3, 0.4]])
    torch.testing.assert_close(counted(resample(EDGES, weights, evenly(1000))), weights[0], rtol=0, atol=2e-3)


@pytest.mark.parametrize("scale", [1e-45, 1e-40, 1e-20, 1.0, 1e20, 3.2e37])
def test_the_scale_of_the_weights_does_not_matter(scale: float) -> None:
    """Denormal numbers too; the sum of the largest ones is beyond float32."""
    weights = torch.tensor([[0.0, 1.0, 0.0, 10.0]]) * scale
    samples = resample(EDGES, weights, evenly(1000))
    expected = torch.tensor([0.0, 1 / 11, 0.0, 10 / 11])
    torch.testing.assert_close(counted(samples), expected, rtol=0, atol=2e-3)


@pytest.mark.parametrize("weight", [1e-45, 1e-30, 1.0, 3e38])
@pytest.mark.parametrize("spike", range(4))
def test_a_single_spike_gets_all_samples(spike: int, weight: float) -> None:
    weights = torch.zeros(1, 4)
    weights[0, spike] = weight
    samples = resample(EDGES, weights, evenly(50))
    assert (samples >= EDGES[0, spike]).all()
    assert (samples <= EDGES[0, spike + 1]).all()
    assert samples.diff().min() > 0


def test_without_any_weight_every_place_counts_alike() -> None:
    samples = resample(EDGES, torch.zeros(1, 4), evenly(8))
    torch.testing.assert_close(samples, torch.arange(0.25, 4, 0.5)[None])


def test_intervals_without_length_are_no_trouble() -> None:
    edges = torch.tensor([[1.0, 1.0, 1.0, 2.0, 2.0], [1.0, 1.0, 1.0, 1.0, 1.0]])
    samples = resample(edges, torch.tensor([[5.0, 0.0, 5.0, 0.0], [0.0, 0.0, 0.0, 0.0]]), evenly(4, rays=2))
    torch.testing.assert_close(samples, torch.tensor([[1.0, 1.0, 1.25, 1.75], [1.0, 1.0, 1.0, 1.0]]))


def test_positions_ascend_and_stay_on_the_ray() -> None:
    """Weights over 40 powers of ten, many of them 0."""
    generator = torch.Generator().manual_seed(0)
    weights = 10 ** (torch.rand((200, 33), generator=generator) * 40 - 40)
    weights[torch.rand((200, 33), generator=generator) < 0.3] = 0
    edges = torch.rand((200, 34), generator=generator).cumsum(dim=-1)
    samples = resample(edges, weights, strata(200, 64, generator, torch.device("cpu")))
    assert (samples.diff(dim=-1) >= 0).all()
    assert (samples >= edges[:, :1]).all()
    assert (samples <= edges[:, -1:]).all()
    interval = torch.searchsorted(edges, samples).sub(1).clamp(min=0)
    assert (weights.gather(-1, interval) > 0).all()


def test_strata_hold_one_number_each_and_never_reach_one() -> None:
    shares = strata(20_000, 8, torch.Generator().manual_seed(0), torch.device("cpu"))
    assert ((shares * 8).floor() == torch.arange(8)).all()
    assert evenly(2**24).max() < 1
    torch.testing.assert_close(evenly(4), torch.tensor([[0.125, 0.375, 0.625, 0.875]]))


def test_a_share_next_to_one_lies_in_the_last_interval_with_weight() -> None:
    weights = torch.tensor([[1.0, 2.0, 3.0, 0.0]])
    (sample,) = resample(EDGES, weights, torch.tensor([[1 - 2.0**-24]]))[0]
    assert sample.item() == pytest.approx(3.0, abs=1e-6)
