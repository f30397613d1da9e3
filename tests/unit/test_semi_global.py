"""Semi-global path costs against their definition, pixel by pixel."""

import torch
from torch import Tensor

from backend.maths.semi_global import aggregate


def random_cost(height: int, width: int, planes: int) -> Tensor:
    return torch.rand(height, width, planes, generator=torch.Generator().manual_seed(0))


def path_cost(cost: list[list[float]], small_step: float, large_step: list[float]) -> list[list[float]]:
    """Hirschmueller's recursion along one scan line; the step's price is that of the pixel arrived at."""
    path = [cost[0]]
    for here, large in zip(cost[1:], large_step[1:], strict=True):
        before = path[-1]
        best = min(before)
        row = []
        for plane, own in enumerate(here):
            ways = [before[plane], best + large]
            ways += [
                before[other] + small_step for other in (plane - 1, plane + 1) if 0 <= other < len(before)
            ]
            row.append(own + min(ways) - best)
        path.append(row)
    return path


def aggregate_one_by_one(cost: Tensor, small_step: float, large_step: Tensor) -> Tensor:
    total = torch.zeros_like(cost)
    for row in range(cost.shape[0]):
        line, steps = cost[row].tolist(), large_step[row].tolist()
        total[row] += torch.tensor(path_cost(line, small_step, steps))
        total[row] += torch.tensor(path_cost(line[::-1], small_step, steps[::-1])[::-1])
    for column in range(cost.shape[1]):
        line, steps = cost[:, column].tolist(), large_step[:, column].tolist()
        total[:, column] += torch.tensor(path_cost(line, small_step, steps))
        total[:, column] += torch.tensor(path_cost(line[::-1], small_step, steps[::-1])[::-1])
    return total


def test_matches_the_definition() -> None:
    cost = random_cost(6, 8, 5)
    large_step = 0.2 + 0.5 * random_cost(6, 8, 1)[..., 0]
    torch.testing.assert_close(
        aggregate(cost, 0.15, large_step), aggregate_one_by_one(cost, 0.15, large_step)
    )


def test_free_steps_leave_every_pixel_to_itself() -> None:
    cost = random_cost(6, 8, 5)
    torch.testing.assert_close(aggregate(cost, 0.0, torch.zeros(6, 8)), 4 * cost)


def test_a_single_outlier_is_outvoted_and_an_edge_is_kept() -> None:
    """Left half on plane 1, right half on plane 4, one wrong pixel in either."""
    truth = torch.full((9, 12), 1)
    truth[:, 6:] = 4
    seen = truth.clone()
    seen[4, 2], seen[4, 9] = 3, 0
    cost = 1 - torch.nn.functional.one_hot(seen, 6).float()
    chosen = aggregate(cost, 0.8, torch.full((9, 12), 1.5)).argmin(dim=-1)
    assert (chosen == truth).all()


def test_a_cheap_step_at_an_edge_keeps_a_weak_one() -> None:
    """One column of weak evidence survives only where the step onto and off it costs nothing."""
    cost = 1 - torch.nn.functional.one_hot(torch.zeros(1, 9, dtype=torch.int64), 4).float()
    cost[0, 4] = torch.tensor([0.3, 1.0, 1.0, 0.0])
    dear = torch.full((1, 9), 0.9)
    cheap = dear.clone()
    cheap[0, 4] = 0.0
    assert aggregate(cost, 0.4, dear)[0, 4].argmin() == 0
    assert aggregate(cost, 0.4, cheap)[0, 4].argmin() == 3


def test_turning_the_image_turns_the_result() -> None:
    cost, large_step = random_cost(6, 8, 5), torch.full((6, 8), 0.4)
    turned = aggregate(cost.transpose(0, 1), 0.1, large_step.T)
    torch.testing.assert_close(turned, aggregate(cost, 0.1, large_step).transpose(0, 1))


def test_costs_stay_bounded_along_long_lines_and_the_input_is_kept() -> None:
    cost = random_cost(3, 500, 4)
    before = cost.clone()
    total = aggregate(cost, 0.1, torch.full((3, 500), 0.3))
    assert (total <= 4 * cost + 4 * 0.3 + 1e-5).all()
    torch.testing.assert_close(cost, before)
