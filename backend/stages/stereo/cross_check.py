"""Two views' depth maps held against each other: whether they have found the same surface."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ...kernels import cross_check as kernel
from ...kernels.compiled import floats
from ...kernels.side_by_side import bands_side_by_side
from ...maths.geometry import (
    Pinhole,
    epipolar_map,
    inside,
    pixel_centres,
    project,
    sample_image,
    unproject,
)

_LARGEST_SHARE = 0.01
"""Of the depth, between what two views find."""


def cross_check(
    camera: Pinhole,
    inverse_depth: Float[Tensor, "height width"],
    other_camera: Pinhole,
    other: Float[Tensor, "2 rows columns"],
    *,
    least_score: float,
    largest_px: float,
) -> tuple[Bool[Tensor, "height width"], Bool[Tensor, "height width"]]:
    """Whether the other view agrees with each pixel's depth, and whether it has found something else there.

    It agrees where its own point, seen from here, falls within `largest_px` of the pixel that was asked for
    and has its depth. `other` is its inverse depth and the score of that, and it says nothing below
    `least_score`.
    """
    on_cpu = inverse_depth.device.type == "cpu"
    check = _compiled if on_cpu else in_torch
    return check(camera, inverse_depth, other_camera, other, least_score=least_score, largest_px=largest_px)


def in_torch(
    camera: Pinhole,
    inverse_depth: Float[Tensor, "height width"],
    other_camera: Pinhole,
    other: Float[Tensor, "2 rows columns"],
    *,
    least_score: float,
    largest_px: float,
) -> tuple[Bool[Tensor, "height width"], Bool[Tensor, "height width"]]:
    """`cross_check` on any device; on the CPU the reference for what is compiled."""
    pixels = pixel_centres(camera.width, camera.height, inverse_depth.device)
    depth = 1 / inverse_depth.clamp(min=1e-6)
    seen_at, in_front = project(other_camera, unproject(camera, pixels, depth))
    found, score = sample_image(other, seen_at[None])[0]
    told = inside(seen_at, other_camera.width, other_camera.height) & (in_front > 0) & (score > least_score)
    there = unproject(other_camera, seen_at, 1 / found.clamp(min=1e-6))
    back_at, back_depth = project(camera, there)
    moved = torch.hypot(*(back_at - pixels).unbind(dim=-1))
    same = (moved < largest_px) & ((back_depth / depth - 1).abs() < _LARGEST_SHARE)
    return told & same, told & ~same


def _compiled(
    camera: Pinhole,
    inverse_depth: Float[Tensor, "height width"],
    other_camera: Pinhole,
    other: Float[Tensor, "2 rows columns"],
    *,
    least_score: float,
    largest_px: float,
) -> tuple[Bool[Tensor, "height width"], Bool[Tensor, "height width"]]:
    """`cross_check` on the CPU, bands of rows side by side."""
    to_there, to_here = epipolar_map(other_camera, camera), epipolar_map(camera, other_camera)
    there, back = (floats(to_there[0]), floats(to_there[1])), (floats(to_here[0]), floats(to_here[1]))
    own, (found, score) = floats(inverse_depth), floats(other)
    agrees, denies = np.empty(own.shape, np.bool_), np.empty(own.shape, np.bool_)
    limits = (np.float32(largest_px), np.float32(_LARGEST_SHARE))

    def check(rows: tuple[int, int]) -> None:
        kernel.cross_check(
            rows, own, there, back, found, score, np.float32(least_score), limits, agrees, denies
        )

    bands_side_by_side(check, len(own), torch.get_num_threads())
    return torch.from_numpy(agrees), torch.from_numpy(denies)
