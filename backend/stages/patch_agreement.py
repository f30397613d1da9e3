"""How well the patches of a view agree with other views, at depths to be tried."""

from collections.abc import Iterator
from itertools import repeat

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..maths.correlation import correlation
from ..maths.geometry import epipolar_map, inside, pixel_centres, sample_image, warp_pixels
from .stereo_windows import Window

_AT_ONCE = 2**18
"""Values compared at once on the CPU: few enough for its caches."""
_SELECTIVITY = 0.15
"""Temperature of the soft maximum over sources."""


def agreement(
    window: Window,
    sources: list[Window],
    inverse_depth: Float[Tensor, "planes height width"],
    asked: Bool[Tensor, "height width"],
) -> Float[Tensor, "planes height width"]:
    """Normalised cross-correlation of each asked pixel's patch with the sources, in [-1, 1].

    A soft maximum over sources: where one of them is hidden behind something, the others decide. Other
    pixels get -1, or, where it costs nothing, what they would get if they were asked.
    """
    pixels = pixel_centres(window.camera.width, window.camera.height, window.grey.device)
    scores = torch.full_like(inverse_depth, -1.0)
    for piece in _pieces(asked, len(inverse_depth)):
        around = tuple(map(_widened, piece, asked.shape, repeat(window.patches.radius)))
        patches = window.patches.part(*around)
        per_source = []
        for source in sources:
            a, b = epipolar_map(source.camera, window.camera)
            where = warp_pixels(a, b, pixels[around], inverse_depth[:, *around])
            warped = sample_image(source.grey[None], where)[:, 0]
            score = correlation(patches, warped, max(window.noise, source.noise))
            seen = inside(where, source.camera.width, source.camera.height)
            per_source.append(torch.where(seen, score, -1.0))
        inner = tuple(
            slice(part.start - wide.start, part.stop - wide.start)
            for part, wide in zip(piece, around, strict=True)
        )
        scores[:, *piece] = _soft_maximum(per_source)[:, *inner]
    return scores


def _soft_maximum(scores: list[Float[Tensor, "planes height width"]]) -> Float[Tensor, "planes height width"]:
    if len(scores) == 1:
        return scores[0]
    stacked = torch.stack(scores)
    return (stacked * torch.softmax(stacked / _SELECTIVITY, dim=0)).sum(dim=0)


def _pieces(asked: Bool[Tensor, "height width"], num_planes: int) -> Iterator[tuple[slice, slice]]:
    """Rows and columns around what is asked, band by band: a band's numbers fit a processor's caches."""
    height, width = asked.shape
    # elsewhere than on the CPU many small pieces only wait for each other
    rows = max(_AT_ONCE // (num_planes * width), 1) if asked.device.type == "cpu" else height
    for top in range(0, height, rows):
        band = slice(top, min(top + rows, height))
        columns = torch.nonzero(asked[band].any(dim=0))
        if len(columns):
            yield band, slice(int(columns[0]), int(columns[-1]) + 1)


def _widened(part: slice, size: int, radius: int) -> slice:
    """The same and what patches reach on either side."""
    return slice(max(part.start - radius, 0), min(part.stop + radius, size))
