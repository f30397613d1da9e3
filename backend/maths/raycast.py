"""Rays against triangle meshes: the first hit, pictures of a mesh, and which camera sees a point.

All positions are in one frame, the world's; a ray is `origin + distance * direction` with a unit
direction, so that a distance is a length. Intel Embree finds the triangle in single precision; the
distance and the place inside the triangle are then computed in double precision from that triangle.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Bool, Float, Float32, Float64, Int, Int64

from ..scene import Camera, SurfaceMesh
from .bilinear import bilinear, shrunk
from .projection import in_picture, projected

EVERYTHING = slice(None)
GRAZING_COSINE = 0.05
"""A surface seen at a smaller cosine (87 degrees off its normal) shows too few pixels to count as seen."""

SELF_HIT_OFFSET = 2e-3
"""How far a point is lifted off the surface before asking what covers it, in diagonals of the mesh's box:
above the sag of a triangle under its vertex normals, below any detail a few photographs can resolve."""


@dataclass(frozen=True, kw_only=True)
class RayHits:
    """Where rays first meet a mesh."""

    distance: Float64[np.ndarray, "rays"]
    """Along the unit direction, world units; infinite where missed."""
    face: Int64[np.ndarray, "rays"]
    """-1 where missed."""
    barycentric: Float64[np.ndarray, "rays 3"]
    """Weights of the face's three corners, summing to 1; 0 where missed."""

    @property
    def hit(self) -> Bool[np.ndarray, "rays"]:
        """True where the ray meets the mesh."""
        return self.face >= 0


@dataclass(frozen=True, kw_only=True)
class MeshImage:
    """A mesh as a camera sees it, without light or shading; pictures of it are made when asked for."""

    mesh: SurfaceMesh
    coverage: Bool[np.ndarray, "height width"]
    """True where the pixel's centre shows the mesh."""
    face: Int64[np.ndarray, "covered"]
    """That the covered pixels show, row by row."""
    barycentric: Float64[np.ndarray, "covered 3"]
    """Weights of its corners there."""
    depths: Float64[np.ndarray, "covered"]
    """Along the optical axis, world units."""

    @cached_property
    def colour_srgb(self) -> Float32[np.ndarray, "height width 3"]:
        """Of the texture or, without one, of the vertices, 0 to 1; 0 where not covered."""
        texture = self.mesh.texture
        if texture is None:
            return self._picture(self._interpolated(self.mesh.colours_srgb) / 255.0)
        places = np.einsum("hk,hkd->hd", self.barycentric, texture.corners_px[self.face])
        times = _texels_a_pixel(places, self.coverage)
        texels = shrunk(texture.image_srgb, times)
        return self._picture(bilinear(texels, places / times) / 255.0)

    @cached_property
    def depth(self) -> Float32[np.ndarray, "height width"]:
        """Along the optical axis, world units; infinite where not covered."""
        return self._picture(self.depths, beside=np.inf)

    @cached_property
    def normal_world(self) -> Float32[np.ndarray, "height width 3"]:
        """Unit, interpolated vertex normals; 0 where not covered."""
        normals = self._interpolated(self.mesh.normals)
        lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
        return self._picture(normals / np.where(lengths > 0, lengths, 1.0))

    @cached_property
    def support(self) -> Float32[np.ndarray, "height width"]:
        """0 where not covered."""
        return self._picture(self._interpolated(self.mesh.support))

    def _interpolated(self, values: np.ndarray) -> np.ndarray:
        return interpolate(values, self.mesh.faces[self.face], self.barycentric)

    def _picture(
        self, values: Float[np.ndarray, "covered *channels"], beside: float = 0.0
    ) -> Float32[np.ndarray, "height width *channels"]:
        image = np.full((*self.coverage.shape, *values.shape[1:]), beside, np.float32)
        image[self.coverage] = values
        return image


class RayCaster:
    """A triangle mesh prepared for many batches of rays."""

    def __init__(self, vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]) -> None:
        self.vertices: Float64[np.ndarray, "vertices 3"] = np.asarray(vertices, np.float64)
        self.faces: Int64[np.ndarray, "faces 3"] = np.asarray(faces, np.int64)
        used = self.vertices[self.faces.ravel()] if self.faces.size else np.zeros((1, 3))
        self._centre = (used.min(0) + used.max(0)) / 2
        self.diagonal = float(np.linalg.norm(np.ptp(used, axis=0)))
        """Of the mesh's bounding box, world units."""
        # Single precision resolves a mesh of size 1 at the origin best, whatever the world's units.
        self._scale = 1.0 / self.diagonal if self.diagonal > 0 else 1.0
        # Without `robust`, one in eight rays aimed exactly at a shared edge slips through; with it, none.
        self._scene = EmbreeScene(robust=True)
        TriangleMesh(self._scene, self._single(self.vertices), self.faces.astype(np.int32))

    def cast(self, origins: Float[np.ndarray, "rays 3"], directions: Float[np.ndarray, "rays 3"]) -> RayHits:
        """First hit of each ray, from either side of a face; `directions` are of unit length."""
        distance, barycentric = np.full(len(origins), np.inf), np.zeros((len(origins), 3))
        face = self._scene.run(self._single(origins), _contiguous(directions)).astype(np.int64)
        hit = face >= 0
        corners = self.vertices[self.faces[face[hit]]]
        distance[hit], barycentric[hit] = intersect_planes(corners, origins[hit], directions[hit])
        return RayHits(distance=distance, face=face, barycentric=barycentric)

    def blocked(
        self,
        origins: Float[np.ndarray, "rays 3"],
        directions: Float[np.ndarray, "rays 3"],
        reach: Float[np.ndarray, "rays"],
    ) -> Bool[np.ndarray, "rays"]:
        """True where something lies on the ray nearer than `reach` (world units, unit directions)."""
        lengths = np.ascontiguousarray(reach * self._scale, np.float32)
        run = self._scene.run(self._single(origins), _contiguous(directions), dists=lengths, query="OCCLUDED")
        return np.asarray(run >= 0)

    def _single(self, points: Float[np.ndarray, "points 3"]) -> Float32[np.ndarray, "points 3"]:
        return _contiguous((points - self._centre) * self._scale)


def _contiguous(array: Float[np.ndarray, "rows 3"]) -> Float32[np.ndarray, "rows 3"]:
    return np.ascontiguousarray(array, np.float32)


def intersect_planes(
    corners: Float[np.ndarray, "rays 3 3"],
    origins: Float[np.ndarray, "rays 3"],
    directions: Float[np.ndarray, "rays 3"],
) -> tuple[Float[np.ndarray, "rays"], Float[np.ndarray, "rays 3"]]:
    """Distance to each ray's own triangle and the weights of its corners there.

    Moeller and Trumbore, "Fast, minimum storage ray/triangle intersection" (1997), equation 6, for rays
    known to hit; weights are clamped to the triangle, because a hit on an edge may fall outside by rounding.
    """
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    offset = origins - corners[:, 0]
    across, along = np.cross(directions, edge2), np.cross(offset, edge1)
    determinant = _dot(edge1, across)
    flat = determinant == 0
    inverse = 1.0 / np.where(flat, 1.0, determinant)
    distance = _dot(edge2, along) * inverse
    u, v = _dot(offset, across) * inverse, _dot(directions, along) * inverse
    weights = np.clip(np.stack([1.0 - u - v, u, v], -1), 0.0, 1.0)
    weights /= weights.sum(-1, keepdims=True)
    # A ray within a triangle's plane meets it in a segment: its nearest corner stands for it.
    weights[flat] = [1.0, 0.0, 0.0]
    return np.where(flat, -_dot(offset, directions), distance), weights


def _dot(a: Float[np.ndarray, "rays 3"], b: Float[np.ndarray, "rays 3"]) -> Float64[np.ndarray, "rays"]:
    return np.asarray(np.einsum("rd,rd->r", a, b), np.float64)  # three times as fast as (a * b).sum(-1)


def camera_rays(
    camera: Camera, rows: slice = EVERYTHING, columns: slice = EVERYTHING
) -> tuple[Float64[np.ndarray, "pixels 3"], Float64[np.ndarray, "pixels 3"]]:
    """Origin and unit direction, world frame, through the centres of all or some pixels, row by row."""
    x = (np.arange(camera.width)[columns] + 0.5 - camera.cx_px)[:, None] / camera.fx_px
    y = (np.arange(camera.height)[rows] + 0.5 - camera.cy_px)[:, None, None] / camera.fy_px
    right, down, forward = camera.camera_from_world[:3, :3]
    directions = x * right + (y * down + forward)
    directions /= np.sqrt(1.0 + x * x + y * y)  # their length, because the three are orthonormal
    directions = directions.reshape(-1, 3)
    return np.broadcast_to(camera.position, directions.shape), directions


def render_mesh(mesh: SurfaceMesh, camera: Camera, *, caster: RayCaster | None = None) -> MeshImage:
    """The mesh's own colours, normals and support at every pixel's centre of a camera.

    `caster` is one built from this mesh, to draw it from several cameras.
    """
    caster = caster or RayCaster(mesh.vertices, mesh.faces)
    window = part_that_may_show(caster.vertices, camera)
    origins, directions = camera_rays(camera, *window)
    hits = caster.cast(origins, directions)
    hit, shape = hits.hit, (camera.height, camera.width)
    coverage = np.zeros(shape, bool)
    coverage[window] = hit.reshape(coverage[window].shape)
    along = directions[hit] @ camera.camera_from_world[2, :3]
    return MeshImage(
        mesh=mesh,
        coverage=coverage,
        face=hits.face[hit],
        barycentric=hits.barycentric[hit],
        depths=hits.distance[hit] * along,
    )


def _texels_a_pixel(
    places: Float64[np.ndarray, "covered 2"], coverage: Bool[np.ndarray, "height width"]
) -> int:
    """How many texels most pixels are apart: where they are several, their mean is what a pixel shows."""
    rows, columns = np.nonzero(coverage)
    beside = (np.diff(columns) == 1) & (np.diff(rows) == 0)
    apart = np.linalg.norm(np.diff(places, axis=0)[beside], axis=-1)
    return max(1, round(float(np.median(apart)))) if len(apart) else 1


def part_that_may_show(points: Float[np.ndarray, "points 3"], camera: Camera) -> tuple[slice, slice]:
    """(rows, columns) around what a camera sees of a surface with these corners; all if one is behind it."""
    pixels, depth = projected(points, camera)
    if not len(points) or (depth <= 0).any():
        return EVERYTHING, EVERYTHING
    first, last = np.floor(pixels.min(axis=0)), np.ceil(pixels.max(axis=0)) + 1
    size = [camera.width, camera.height]
    (left, top), (right, bottom) = np.clip([first, last], 0, size).astype(int)
    return slice(top, bottom), slice(left, right)


def interpolate(
    values: np.ndarray, corners: Int64[np.ndarray, "hits 3"], weights: Float64[np.ndarray, "hits 3"]
) -> np.ndarray:
    """Values of the vertices, of any shape, mixed by the weights of each hit's three corners."""
    return np.asarray(np.einsum("hk,hk...->h...", weights, values[corners].astype(np.float64)))


def visible_from(
    points: Float[np.ndarray, "points 3"],
    normals: Float[np.ndarray, "points 3"],
    cameras: Sequence[Camera],
    caster: RayCaster,
) -> Bool[np.ndarray, "points cameras"]:
    """True where a camera sees a point of the caster's surface: in its picture, facing it, and not covered.

    `normals` are unit, outwards. Points and their mesh may differ slightly (samples, vertices).
    """
    seen = np.zeros((len(points), len(cameras)), bool)
    lifted = points + SELF_HIT_OFFSET * caster.diagonal * normals
    for column, camera in enumerate(cameras):
        towards = camera.position - points
        facing = _dot(towards, normals) > GRAZING_COSINE * np.linalg.norm(towards, axis=-1)
        candidates = np.flatnonzero(facing & in_picture(points, camera))
        # From the lifted point, so that a camera nearer than what lies behind it is not hidden by that.
        ray = camera.position - lifted[candidates]
        reach = np.linalg.norm(ray, axis=-1)
        covered = caster.blocked(lifted[candidates], ray / reach[:, None], reach)
        seen[candidates[~covered], column] = True
    return seen
