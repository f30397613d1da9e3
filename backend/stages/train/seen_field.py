"""A field as the pixels of a photograph see it, and photographs made smaller for looking at it."""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from scipy.ndimage import binary_erosion
from torch import Tensor

from ...maths.geometry import Pinhole, pixel_centres, project, ray_directions
from ...maths.grid import locate, node_steps, spacing, value_and_gradient
from .silhouettes import grid_crossing, grid_entry


@dataclass(frozen=True, kw_only=True)
class SeenField:
    """Where the rays of some pixels meet a field; of those that miss it, `hit` alone means anything."""

    hit: Bool[Tensor, "pixels"]
    depth: Float[Tensor, "pixels"]
    """Along the camera's axis."""
    positions: Float[Tensor, "pixels 3"]
    normals: Float[Tensor, "pixels 3"]
    """Out of the surface."""
    directions: Float[Tensor, "pixels 3"]
    """Away from the camera, of unit length."""
    cosine: Float[Tensor, "pixels"]
    """Between the normal and the way back to the camera."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NearSurface:
    """What of a field photographs can show; found when first asked for: where masks tell, nobody does."""

    distance: Float[Tensor, "nodes nodes nodes"]

    @property
    def cell(self) -> float:
        """Side of a cell of the grid."""
        return spacing(len(self.distance))

    @cached_property
    def positions(self) -> Float[Tensor, "points 3"]:
        """Of nodes within two cells of the field's surface, and of all inside that lie next to outside."""
        # what is outside the cube counts as outside: rays come from there
        deep = torch.tensor(binary_erosion((self.distance < 0).cpu().numpy()), device=self.distance.device)
        steps = node_steps(len(self.distance), self.distance.device)
        return steps[torch.nonzero((self.distance < 2 * self.cell) & ~deep)]


def seen_field(
    camera: Pinhole, where: Bool[Tensor, "height width"], distance: Float[Tensor, "nodes nodes nodes"]
) -> SeenField:
    """The field, on the grid of the camera's frame, at those pixels; row by row, as `where` selects them."""
    along_axis = ray_directions(camera, pixel_centres(camera.width, camera.height, distance.device)[where])
    directions = F.normalize(along_axis, dim=-1)
    origins = camera.position.expand_as(directions)
    crossing = grid_crossing(distance, origins, directions, grid_entry(origins, directions))
    positions = origins + crossing.along[:, None] * directions
    _, gradient = value_and_gradient(distance, locate(positions, len(distance)))
    normals = F.normalize(gradient, dim=-1)
    return SeenField(
        hit=crossing.hit,
        depth=crossing.along / along_axis.norm(dim=-1),
        positions=positions,
        normals=normals,
        directions=directions,
        cosine=-(normals * directions).sum(dim=-1),
    )


def may_show(camera: Pinhole, near: NearSurface) -> Bool[Tensor, "height width"]:
    """Pixels whose rays may meet the field in its cube: those around what shows a node near its surface.

    Where there is no subject to ask about, most rays pass by the field, and are the longest to trace.
    """
    size = (camera.height, camera.width)
    pixels, depth = project(camera, near.positions)
    if not len(depth) or depth.min() < 2 * near.cell:
        return torch.full(size, bool(len(depth)), device=depth.device)
    # squares of a cell as it shows at most, and those around them
    side = math.ceil(near.cell * float(camera.intrinsics[:2, :2].amax() / depth.min()))
    rows, columns = math.ceil(camera.height / side) + 2, math.ceil(camera.width / side) + 2
    square = (pixels / side).floor().long() + 1
    x, y = square[:, 0].clamp(0, columns - 1), square[:, 1].clamp(0, rows - 1)
    shown = torch.zeros((1, 1, rows, columns), device=depth.device)
    shown[0, 0, y, x] = 1.0
    around = F.max_pool2d(shown, 3, stride=1, padding=1)[0, 0, 1:-1, 1:-1] > 0
    whole = around.repeat_interleave(side, dim=0).repeat_interleave(side, dim=1)
    return whole[: camera.height, : camera.width]


def smaller(camera: Pinhole, share: float) -> Pinhole:
    """The camera of the picture at that share of its size, of at least a pixel."""
    return camera.scaled(max(round(share * camera.width), 1), max(round(share * camera.height), 1))


def averaged(image: Float[Tensor, "3 height width"], camera: Pinhole) -> Float[Tensor, "3 rows columns"]:
    """Means over a smaller camera's pixels."""
    return F.interpolate(image[None], size=(camera.height, camera.width), mode="area")[0]


def at_size(image: Float[Tensor, "height width"], camera: Pinhole) -> Float[Tensor, "rows columns"]:
    """The nearest values, at a smaller camera's pixels."""
    size = (camera.height, camera.width)
    return F.interpolate(image[None, None], size=size, mode="nearest-exact")[0, 0]
