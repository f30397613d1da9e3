"""Semi-global matching: smooth depth through weak texture, sharp at edges.

After Hirschmueller, "Stereo processing by semiglobal matching and mutual information" (PAMI 2008):
along each scan line the cost of a plane is its own plus the cheapest way to come from the pixel
before, where a step of one plane costs `small_step` and any other `large_step`.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def aggregate(
    cost: Float[Tensor, "height width planes"], small_step: float, large_step: Float[Tensor, "height width"]
) -> Float[Tensor, "height width planes"]:
    """Sum of the path costs along four directions; lowest at the plane to choose.

    `small_step` is what it costs to go to the next plane, `large_step` to any other, in the cost's unit; the
    latter may vary over the image (cheaper across its edges).
    """
    down, up = _scan_both_ways(cost, small_step, large_step)
    right, left = _scan_both_ways(cost.transpose(0, 1), small_step, large_step.T)
    return down.add_(up).add_(right.transpose(0, 1)).add_(left.transpose(0, 1))


def _scan_both_ways(
    cost: Float[Tensor, "steps lines planes"], small_step: float, large_step: Float[Tensor, "steps lines"]
) -> tuple[Float[Tensor, "steps lines planes"], Float[Tensor, "steps lines planes"]]:
    """`_scan_rows` of the lines from their first step and from their last, side by side."""
    both = torch.cat([cost, cost.flip(0)], dim=1)
    path = _scan_rows(both, small_step, torch.cat([large_step, large_step.flip(0)], dim=1))
    one, other = path.chunk(2, dim=1)
    return one, other.flip(0)


def _scan_rows(
    cost: Float[Tensor, "steps lines planes"], small_step: float, large_step: Float[Tensor, "steps lines"]
) -> Float[Tensor, "steps lines planes"]:
    """Path costs of scan lines along the first axis; kept bounded by subtracting each step's best."""
    path = cost.clone()
    for step in range(1, len(cost)):
        before = path[step - 1]
        before = before - before.min(dim=-1, keepdim=True).values
        come = torch.minimum(before, large_step[step][:, None])
        torch.minimum(come[:, 1:], before[:, :-1] + small_step, out=come[:, 1:])
        torch.minimum(come[:, :-1], before[:, 1:] + small_step, out=come[:, :-1])
        path[step] += come
    return path
