"""Triangulation and bundle adjustment in plain torch, dense and in float64: slow, short, the tests' oracle.

Nothing is eliminated and no gauge is fixed: all cameras and points move, the damping of Levenberg and
Marquardt passes over the seven directions that change nothing, and the covariance is the pseudo-inverse.
Poses are moved from the left by the exponential of a twist (omega, v) in camera axes: T <- exp(twist) T.

Hartley and Zisserman, Multiple View Geometry (2004), 12.2 and A6.3; Triggs, McLauchlan, Hartley and
Fitzgibbon, "Bundle adjustment: a modern synthesis" (1999), 9.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor
from torch.func import jacrev, vmap

NUM_GAUGE = 7
"""Directions in which cameras and points can move together unseen: shift, turn, scale."""


@dataclass(frozen=True, kw_only=True)
class Observations:
    """Which camera saw which point where, all through one SIMPLE_RADIAL lens."""

    lens: Float64[Tensor, "4"]
    """Focal length, principal point x, y (pixels), radial coefficient."""
    camera: Int64[Tensor, "observations"]
    point: Int64[Tensor, "observations"]
    pixels: Float64[Tensor, "observations 2"]


@dataclass(frozen=True, kw_only=True)
class Adjusted:
    """Cameras, points and lens with the smallest sum of squares."""

    camera_from_world: Float64[Tensor, "cameras 4 4"]
    points: Float64[Tensor, "points 3"]
    lens: Float64[Tensor, "4"]
    residuals: Float64[Tensor, "observations 2"]
    covariance: Float64[Tensor, "parameters parameters"]
    """For errors of one pixel, of each camera's twist, then of each point, then of the lens; 0 for what was
    held. Of all gauges the one with the smallest trace."""


def cross_matrix(vectors: Float64[Tensor, "*batch 3"]) -> Float64[Tensor, "*batch 3 3"]:
    """[a], so that [a] b is the cross product of a and b."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))


def twist_matrix(twists: Float64[Tensor, "*batch 6"]) -> Float64[Tensor, "*batch 4 4"]:
    """The element of se(3), whose matrix exponential is the motion."""
    top = torch.cat([cross_matrix(twists[..., :3]), twists[..., 3:, None]], dim=-1)
    return torch.cat([top, torch.zeros_like(top[..., :1, :])], dim=-2)


def projected(
    lens: Float64[Tensor, "4"],
    camera_from_world: Float64[Tensor, "*batch 4 4"],
    points: Float64[Tensor, "*batch 3"],
) -> Float64[Tensor, "*batch 2"]:
    """Pixels of world points."""
    in_camera = (camera_from_world[..., :3, :3] @ points[..., None])[..., 0] + camera_from_world[..., :3, 3]
    flat = in_camera[..., :2] / in_camera[..., 2:]
    focal, centre, radial = lens[0], lens[1:3], lens[3]
    return focal * (1 + radial * flat.square().sum(-1, keepdim=True)) * flat + centre


def triangulated_linearly(
    matrices: Float64[Tensor, "cameras 3 4"], pixels: Float64[Tensor, "cameras 2"]
) -> Float64[Tensor, "3"]:
    """The point of the smallest algebraic error: the last right singular vector of the equations."""
    rows = pixels[:, :, None] * matrices[:, 2:] - matrices[:, :2]
    solution = torch.linalg.svd(rows.reshape(-1, 4))[2][-1]
    return solution[:3] / solution[3]


def adjusted(
    seen: Observations,
    camera_from_world: Float64[Tensor, "cameras 4 4"],
    points: Float64[Tensor, "points 3"],
    *,
    cameras_free: bool = True,
    lens_free: bool = False,
    rounds: int = 12,
) -> Adjusted:
    """From a start nearby to the least squares, by Levenberg and Marquardt on the dense normal equations."""
    num_twists, num_motions = 6 * len(camera_from_world), 6 * len(camera_from_world) + 3 * len(points)
    columns = torch.arange(0 if cameras_free else num_twists, num_motions + (4 if lens_free else 0))
    state = camera_from_world, points, seen.lens
    residuals, jacobian = _linearised(seen, *state)
    damping = 1e-4
    for _ in range(rounds):
        free = jacobian[:, columns]
        normal = free.T @ free
        damped = normal + damping * torch.diag(normal.diagonal())
        step = torch.zeros(num_motions + 4, dtype=torch.float64)
        step[columns] = -torch.linalg.solve(damped, free.T @ residuals.flatten())
        moved = _moved(state, step)
        there = _linearised(seen, *moved)
        if there[0].square().sum() <= residuals.square().sum():
            state, (residuals, jacobian) = moved, there
            damping = max(damping / 10, 1e-12)
        else:
            damping *= 10
    free = jacobian[:, columns]
    covariance = torch.zeros(num_motions + 4, num_motions + 4, dtype=torch.float64)
    num_unknowable = NUM_GAUGE if cameras_free else 0
    covariance[columns[:, None], columns] = _pseudo_inverse(free.T @ free, num_unknowable)
    return Adjusted(
        camera_from_world=state[0],
        points=state[1],
        lens=state[2],
        residuals=residuals,
        covariance=covariance,
    )


def _moved(state: tuple[Tensor, Tensor, Tensor], step: Float64[Tensor, "parameters"]) -> tuple[Tensor, ...]:
    camera_from_world, points, lens = state
    twists, shifts, change = step.split([6 * len(camera_from_world), 3 * len(points), 4])
    motions = torch.linalg.matrix_exp(twist_matrix(twists.unflatten(0, (-1, 6))))
    return motions @ camera_from_world, points + shifts.unflatten(0, (-1, 3)), lens + change


def _linearised(
    seen: Observations,
    camera_from_world: Float64[Tensor, "cameras 4 4"],
    points: Float64[Tensor, "points 3"],
    lens: Float64[Tensor, "4"],
) -> tuple[Float64[Tensor, "observations 2"], Float64[Tensor, "rows parameters"]]:
    """Residuals in pixels and their dense Jacobian by twists, points and lens, derived by torch."""

    def pixel(
        motion: Float64[Tensor, "13"], pose: Float64[Tensor, "4 4"], point: Float64[Tensor, "3"]
    ) -> Float64[Tensor, "2"]:
        moved = pose + twist_matrix(motion[:6]) @ pose  # the exponential to first order: exact at 0
        return projected(lens + motion[9:], moved, point + motion[6:9])

    poses, positions = camera_from_world[seen.camera], points[seen.point]
    still = torch.zeros(13, dtype=torch.float64)
    slopes = vmap(lambda pose, point: jacrev(pixel)(still, pose, point))(poses, positions)
    count, num_twists = len(seen.pixels), 6 * len(camera_from_world)
    jacobian = torch.zeros(count, 2, num_twists + 3 * len(points) + 4, dtype=torch.float64)
    every = torch.arange(count)
    for axis in range(6):
        jacobian[every, :, 6 * seen.camera + axis] = slopes[..., axis]
    for axis in range(3):
        jacobian[every, :, num_twists + 3 * seen.point + axis] = slopes[..., 6 + axis]
    jacobian[..., -4:] = slopes[..., 9:]
    return projected(lens, poses, positions) - seen.pixels, jacobian.flatten(0, 1)


def _pseudo_inverse(normal: Float64[Tensor, "n n"], num_unknowable: int) -> Float64[Tensor, "n n"]:
    """The inverse where the normal equations have one: without so many smallest eigenvalues."""
    values, vectors = torch.linalg.eigh(normal)
    kept = vectors[:, num_unknowable:]
    return (kept / values[num_unknowable:]) @ kept.T
