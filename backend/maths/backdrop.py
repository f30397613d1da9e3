"""Finding an empty backdrop: one even colour behind the subject, at the picture's border and in its gaps."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Backdrop:
    """What an even backdrop tells; what is neither empty nor subject may be either."""

    empty: Bool[Tensor, "height width"]
    """Shows nothing but the backdrop."""
    subject: Bool[Tensor, "height width"]
    """So unlike the backdrop that something stands before it."""


def find_backdrop(
    image_srgb: Float[Tensor, "3 height width"], region: Bool[Tensor, "height width"]
) -> Backdrop | None:
    """The even backdrop of a photograph; None where it has none.

    A backdrop is there if half of the picture's border has one colour, to within a few grey levels: its
    median distance from the median colour says so. Pixels of that colour count if they belong to a 7x7
    square of it: specks do not. Where what stands in the `region` is hardly unlike the
    backdrop, as in a very dark photograph, nothing is sure.
    """
    border = torch.cat(
        [image_srgb[:, 0], image_srgb[:, -1], image_srgb[:, :, 0], image_srgb[:, :, -1]], dim=1
    )
    colour = border.median(dim=1).values
    apart = (border - colour[:, None]).abs().amax(dim=0)
    tolerance = max(3 * float(apart.median()), 4 / 255)
    if tolerance > 0.05:
        return None
    apart = (image_srgb - colour[:, None, None]).abs().amax(dim=0)
    alike = apart < tolerance
    unlike = apart > 10 * tolerance
    before = apart[region & ~alike]
    if not len(before) or float(before.mean()) < 10 * tolerance:
        return None
    return Backdrop(empty=_opened(alike), subject=_opened(unlike))


def _opened(pixels: Bool[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """The pixels that belong to a 7x7 square of such pixels."""
    return _grown(~_grown(~pixels, 3), 3)


def _grown(pixels: Bool[Tensor, "height width"], radius: int) -> Bool[Tensor, "height width"]:
    """Every pixel within a square of one that is set."""
    return F.max_pool2d(pixels.float()[None], 2 * radius + 1, 1, radius)[0] > 0
