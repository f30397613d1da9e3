"""The surface as a field on a grid: what a fit returns, however it was found."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor

from ..errors import ErrorCode, ReconstructionError
from ..maths.grid import spacing
from ..scene import Decision, to_unit_sphere
from .radiance import Radiance

COARSEST = 48
"""Nodes along each axis of the grid that finds the surface's extent."""


@dataclass(frozen=True, kw_only=True)
class Surface:
    """The field at its finest level."""

    distance: Float32[np.ndarray, "nodes nodes nodes"]
    """Signed, on nodes over the cube [-1, 1]^3 of the grid frame and in its units; > 0 outside."""
    grid_from_world: Float64[np.ndarray, "4 4"]
    """A similarity: the cube is laid tightly around the surface."""
    radiance: Radiance | None = None
    """The field to render from, where one was fitted."""
    reach_cells: float = 1.0
    """How far around it a measurement speaks: more than a cell where only detail is on so fine a grid."""
    decisions: tuple[Decision, ...] = ()

    @property
    def reach_world(self) -> float:
        """The same in world units."""
        cell = spacing(len(self.distance)) / np.cbrt(np.linalg.det(self.grid_from_world[:3, :3]))
        return float(self.reach_cells * cell)


ShowSurface = Callable[[Surface], None]
"""Called with the field as it is so far; must not change it."""


def show_nothing(_surface: Surface) -> None:
    """A callback for those who do not want to look at unfinished surfaces."""


def tight_frame(distance: Float[Tensor, "nodes nodes nodes"]) -> Float64[np.ndarray, "4 4"]:
    """frame_from_object: the cube around the inside of a coarse field becomes the unit cube of its own frame.

    Raises ReconstructionError(NO_SURFACE) if there is no inside.
    """
    cell = spacing(len(distance))
    inside = torch.nonzero(distance < 0).float() * cell - 1
    if not len(inside):
        raise ReconstructionError(
            ErrorCode.NO_SURFACE,
            "No surface was found in the region.",
            "Check that the photographs show the same thing, and that masks, if any, are white on it.",
        )
    low, high = inside.amin(dim=0), inside.amax(dim=0)
    half = float((high - low).max()) / 2 + 2.5 * cell
    centre = ((low + high) / 2).cpu().double().numpy()
    return to_unit_sphere(centre, half)
