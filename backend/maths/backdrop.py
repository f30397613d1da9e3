"""Finding an empty backdrop: one even colour behind the subject, at the picture's border and in its gaps."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor


def empty_backdrop(
    image_srgb: Float[Tensor, "3 height width"],
) -> Bool[Tensor, "height width"] | None:
    """Pixels that show nothing but the backdrop; None where the photograph has no such backdrop.

    A backdrop is there if half of the picture's border has one colour, to within a few grey levels: its
    median distance from the median colour says so. Pixels of that colour count if they belong to a 7x7
    square of it: specks do not.
    """
    border = torch.cat(
        [image_srgb[:, 0], image_srgb[:, -1], image_srgb[:, :, 0], image_srgb[:, :, -1]], dim=1
    )
    colour = border.median(dim=1).values
    apart = (border - colour[:, None]).abs().amax(dim=0)
    tolerance = max(3 * float(apart.median()), 4 / 255)
    if tolerance > 0.05:
        return None
    alike = (image_srgb - colour[:, None, None]).abs().amax(dim=0) < tolerance
    return _grown(~_grown(~alike, 3), 3)


def _grown(pixels: Bool[Tensor, "height width"], radius: int) -> Bool[Tensor, "height width"]:
    """Every pixel within a square of one that is set."""
    return F.max_pool2d(pixels.float()[None], 2 * radius + 1, 1, radius)[0] > 0
