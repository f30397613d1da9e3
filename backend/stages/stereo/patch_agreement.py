"""How well the patches of a view agree with other views, at depths to be tried."""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ...kernels.compiled import floats
from ...kernels.patch_correlation import correlate, soft_maximum
from ...kernels.side_by_side import side_by_side
from ...maths.correlation import correlation
from ...maths.geometry import epipolar_map, inside, pixel_centres, sample_image, warp_pixels
from .windows import Window

_SELECTIVITY = 0.15
"""Temperature of the soft maximum over sources."""
_TILE = (64, 128)
"""Rows and columns that a thread compares at a time: few enough for a core's cache."""


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
    on_cpu = inverse_depth.device.type == "cpu"
    return (_compiled if on_cpu else in_torch)(window, sources, inverse_depth, asked)


def in_torch(
    window: Window,
    sources: list[Window],
    inverse_depth: Float[Tensor, "planes height width"],
    asked: Bool[Tensor, "height width"],
) -> Float[Tensor, "planes height width"]:
    """`agreement` on any device; on the CPU the reference for what is compiled."""
    pixels = pixel_centres(window.camera.width, window.camera.height, window.grey.device)
    per_source = []
    for source in sources:
        a, b = epipolar_map(source.camera, window.camera)
        where = warp_pixels(a, b, pixels, inverse_depth)
        warped = sample_image(source.grey[None], where)[:, 0]
        score = correlation(window.patches, warped, max(window.noise, source.noise))
        seen = inside(where, source.camera.width, source.camera.height)
        per_source.append(torch.where(seen, score, -1.0))
    stacked = torch.stack(per_source)
    return torch.where(asked, (stacked * torch.softmax(stacked / _SELECTIVITY, dim=0)).sum(dim=0), -1.0)


def _compiled(
    window: Window,
    sources: list[Window],
    inverse_depth: Float[Tensor, "planes height width"],
    asked: Bool[Tensor, "height width"],
) -> Float[Tensor, "planes height width"]:
    """`agreement` on the CPU, tiles side by side."""
    of = window.patches
    patches = (floats(of.image), floats(of.subject), floats(of.count), floats(of.mean), floats(of.variance))
    compared = []
    for source in sources:
        a, b = epipolar_map(source.camera, window.camera)
        floor = np.float32(max(window.noise, source.noise) ** 2)
        compared.append((floats(source.grey), (floats(a), floats(b)), floor))
    depths = floats(inverse_depth)
    scores = np.full(depths.shape, -1, np.float32)

    def compare(tile: tuple[int, int, int, int]) -> None:
        top, bottom, left, right = tile
        per_source = np.empty((len(sources), len(depths), bottom - top, right - left), np.float32)
        for (grey, epipolar, floor), found in zip(compared, per_source, strict=True):
            correlate(tile, of.radius, patches, grey, epipolar, floor, depths, found)
        soft_maximum(per_source, np.float32(_SELECTIVITY))
        scores[:, top:bottom, left:right] = per_source[0]

    side_by_side(compare, _tiles(asked), torch.get_num_threads())
    return torch.from_numpy(scores)


def _tiles(asked: Bool[Tensor, "height width"]) -> Iterator[tuple[int, int, int, int]]:
    """(top, bottom, left, right) around what is asked in each tile of the image."""
    height, width = asked.shape
    whole = asked.numpy()
    for top in range(0, height, _TILE[0]):
        for left in range(0, width, _TILE[1]):
            part = whole[top : top + _TILE[0], left : left + _TILE[1]]
            rows, columns = np.flatnonzero(part.any(axis=1)), np.flatnonzero(part.any(axis=0))
            if len(rows):
                first, last = top + int(rows[0]), top + int(rows[-1])
                yield first, last + 1, left + int(columns[0]), left + int(columns[-1]) + 1
