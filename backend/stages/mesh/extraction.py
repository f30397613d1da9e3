"""From the distance field to a mesh: level set, clean-up, fewer faces, colour and support.

`support` tells measured surface from guesses: 0.7 for being measured by stereo points, 0.3 for
being seen, both growing with how much evidence there is and saturating.
"""

from dataclasses import dataclass, field, replace

import fast_simplification
import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float32, Float64, Int64
from skimage.measure import marching_cubes

from ...errors import ErrorCode, ReconstructionError
from ...maths.beside_mask import FEWEST_MASKS
from ...maths.clipping import clipped
from ...maths.faces import area_vectors, face_areas
from ...maths.grid import near_surface, refined, spacing
from ...maths.nearest import nearest_tree
from ...maths.pieces import connected_pieces
from ...maths.raycast import RayCaster, visible_from
from ...scene import (
    Decision,
    DepthMap,
    Progress,
    Region,
    StereoResult,
    SurfaceMesh,
    View,
    transform_points,
)
from ..measurements import SURE
from ..surface import Surface
from .originals import Original
from .texture import TextureConfig, paint
from .vertex_colours import colour_vertices

Vertices = Float64[np.ndarray, "vertices 3"]
Faces = Int64[np.ndarray, "faces 3"]
KeptVertices = Float64[np.ndarray, "kept_vertices 3"]
KeptFaces = Int64[np.ndarray, "kept_faces 3"]

MEASURED_EDGES = 0.03
"""Share of the pictures' edges. Measured: 0 to 0.001 for objects, 0.06 to 0.5 for facades and floors."""

_LEAST_CELLS = 1e-3
"""How near to a node, in cells, the level set may cross an edge: through a node it has faces without area."""

_SHORTEST = 1e-6
"""Edges of a simplified mesh, in shares of its size: on sides that are exactly flat some have no length."""

_MORE_FACES = 1.2
"""Times as many as were asked for, where so few can not be closed; its square after that, and so on."""

_SMALLEST_STANDING = 0.1
"""Where the ground was left out, pieces with a smaller share of the largest one's area are of its edges, or
of what stands behind."""

_LOOSE_REACHES = 5.0
"""How far surface goes on beyond what was measured, in what a measurement reaches, in a larger scene."""

_MOST_OF_IT = 0.9
"""Share of the faces that are kept, with which their number is about what was asked for."""

PREVIEW_NODES, PREVIEW_FACES = 64, 20_000
"""Of a mesh that is only looked at: at most so many nodes along each axis, and faces."""


@dataclass(frozen=True, kw_only=True)
class MeshConfig:
    """What the mesh may look like."""

    max_faces: int = 50_000
    smallest_piece: float = 0.02
    """Pieces with a smaller share of the largest one's area are dropped as floating."""
    textured: bool = True
    """Whether colours are finer than the vertices."""
    texture: TextureConfig = field(default_factory=TextureConfig)
    exposures_evened: bool = True
    """Whether photographs of other exposure or white balance are brought to the mean of all, for colour."""


def extract_mesh(
    views: tuple[View, ...],
    region: Region,
    stereo: StereoResult,
    surface: Surface,
    config: MeshConfig,
    *,
    originals: tuple[Original, ...] | None = None,
    progress: Progress,
) -> SurfaceMesh:
    """The zero level as a coloured mesh in the world frame.

    `originals`, one for each view, are read again for the texture. Raises ReconstructionError(NO_SURFACE) if
    the field has no zero level, and PHOTO_UNREADABLE.
    """
    progress(0.0, "level set")
    if stereo.ground is not None:
        config = replace(config, smallest_piece=max(config.smallest_piece, _SMALLEST_STANDING))
    whole = _without_floating(surface, config)
    progress(0.2, "simplifying")
    points = transform_points(region.world_from_object, stereo.points.positions.astype(np.float64))
    kept = _kept(*simplified(*whole, config.max_faces), views, points, stereo, surface.reach_world)
    progress(0.4, "support")
    if len(whole[1]) > config.max_faces and 0 < kept.share < _MOST_OF_IT:
        # what is cut off takes none of the faces
        more = round(config.max_faces / kept.share)
        kept = _kept(*simplified(*whole, more), views, points, stereo, surface.reach_world)
    vertices, faces, normals, seen = kept.vertices, kept.faces, kept.normals, kept.seen
    progress(0.6, "colour")
    coloured = colour_vertices(vertices, normals, seen, views, exposures_evened=config.exposures_evened)
    mesh = SurfaceMesh(
        vertices=vertices,
        faces=faces,
        normals=normals.astype(np.float32),
        colours_srgb=coloured.colours_srgb,
        support=kept.support,
        decisions=(*kept.decisions, coloured.decision),
    )
    if not config.textured:
        return mesh
    progress(0.7, "texture")
    texture, decision = paint(mesh, seen, views, originals, coloured.log_exposures, config.texture)
    return replace(mesh, texture=texture, decisions=(*mesh.decisions, decision))


@dataclass(frozen=True, kw_only=True)
class _Kept:
    """What photographs show of a mesh, and know of it."""

    vertices: KeptVertices
    faces: KeptFaces
    normals: Float64[np.ndarray, "kept_vertices 3"]
    seen: Bool[np.ndarray, "kept_vertices views"]
    support: Float32[np.ndarray, "kept_vertices"]
    share: float
    """Of the faces."""
    decisions: tuple[Decision, ...]


def _kept(
    vertices: Vertices,
    faces: Faces,
    views: tuple[View, ...],
    points: Float64[np.ndarray, "points 3"],
    stereo: StereoResult,
    reach: float,
) -> _Kept:
    """The mesh without pieces that no photograph shows, and of a larger scene without what none measured.

    `points` are those of stereo, world frame.
    """
    normals = vertex_normals(vertices, faces)
    seen = visible_from(vertices, normals, [view.camera for view in views], RayCaster(vertices, faces))
    support = support_of(vertices, seen, points, stereo.points.confidence, reach)
    # photographs without masks, among others that have some, show what is beside the subject as well
    telling = np.array([view.mask is not None for view in views])
    shown = seen[:, telling] if telling.sum() >= FEWEST_MASKS else seen
    whole, faces = len(faces), faces[in_seen_pieces(faces, shown)]
    decisions: tuple[Decision, ...] = ()
    if len(points) and all(view.mask is None for view in views):
        beyond, decision = _open_or_closed(vertices, support, stereo.depth_maps, reach)
        decisions = (decision,)
        if beyond is not None:
            scene = clipped(faces, beyond)
            vertices, support = scene.extended(vertices), scene.extended(support)
            normals = _unit(scene.extended(normals))
            seen, faces = np.concatenate([seen, seen[scene.ends].all(axis=1)]), scene.faces
    used = np.unique(faces)
    vertices, kept_faces = only_used(vertices, faces)
    return _Kept(
        vertices=vertices,
        faces=kept_faces,
        normals=normals[used],
        seen=seen[used],
        support=support[used],
        share=len(kept_faces) / whole,
        decisions=decisions,
    )


def preview_mesh(
    surface: Surface, points: Float64[np.ndarray, "points 3"], colours_srgb: Float32[np.ndarray, "points 3"]
) -> SurfaceMesh | None:
    """The zero level of an unfinished field at modest resolution, world frame; None where it has none.

    A vertex has the colour of the nearest of the points (world frame), and no support: none is known yet.
    """
    nodes = min(len(surface.distance), PREVIEW_NODES)
    while True:
        coarse = refined(torch.from_numpy(surface.distance), nodes).numpy()
        if not coarse.min() < 0 < coarse.max():
            return None
        vertices, faces = level_set(replace(surface, distance=coarse))
        if len(faces) <= PREVIEW_FACES:
            break
        # The number of faces grows with the square of the nodes.
        nodes = min(nodes - 1, int(nodes * (PREVIEW_FACES / len(faces)) ** 0.5))
    colours = np.full((len(vertices), 3), 128, np.uint8)
    if len(points):
        _, nearest = nearest_tree(points).query(vertices)
        colours = np.clip(colours_srgb[nearest] * 255 + 0.5, 0, 255).astype(np.uint8)
    return SurfaceMesh(
        vertices=vertices,
        faces=faces,
        normals=vertex_normals(vertices, faces).astype(np.float32),
        colours_srgb=colours,
        support=np.zeros(len(vertices), np.float32),
    )


def simplified_level_set(
    surface: Surface, config: MeshConfig, *, progress: Progress
) -> tuple[Vertices, Faces]:
    """The zero level without small pieces, of `max_faces` at most, world frame.

    Raises ReconstructionError(NO_SURFACE) if the field has no zero level.
    """
    progress(0.0, "level set")
    whole = _without_floating(surface, config)
    progress(0.5, "simplifying")
    return simplified(*whole, config.max_faces)


def _without_floating(surface: Surface, config: MeshConfig) -> tuple[Vertices, Faces]:
    """The zero level without small pieces."""
    vertices, faces = level_set(surface)
    return only_used(vertices, without_small_pieces(vertices, faces, config.smallest_piece))


def level_set(surface: Surface) -> tuple[Vertices, Faces]:
    """Vertices (world frame) and faces (outward) of the zero level; only cells around it are visited."""
    distance = surface.distance
    nodes = distance.shape[0]
    if not (distance.min() < 0 < distance.max()):
        raise ReconstructionError(
            ErrorCode.NO_SURFACE,
            "The field has no surface.",
            "Check that the photographs show the same thing, and that masks, if any, are white on it.",
        )
    near = near_surface(torch.from_numpy(distance), 2).numpy()
    least = np.float32(_LEAST_CELLS * spacing(nodes))
    apart = np.where(distance < 0, np.minimum(distance, -least), np.maximum(distance, least))
    vertices, faces, _, _ = marching_cubes(  # type: ignore[no-untyped-call]
        apart, 0.0, spacing=(spacing(nodes),) * 3, gradient_direction="descent", mask=near
    )
    world_from_grid = np.linalg.inv(surface.grid_from_world)
    return transform_points(world_from_grid, vertices.astype(np.float64) - 1), faces.astype(np.int64)


def without_small_pieces(vertices: Vertices, faces: Faces, smallest: float) -> KeptFaces:
    """Faces of the connected pieces whose area is at least a share of the largest piece's."""
    piece = _piece_of_faces(faces, len(vertices))
    area = np.bincount(piece, weights=face_areas(vertices, faces))
    return np.asarray(faces[area[piece] >= smallest * area.max()])


def in_seen_pieces(
    faces: Faces, seen: Bool[np.ndarray, "vertices views"], least: float = 0.05
) -> Bool[np.ndarray, "faces"]:
    """True for faces of pieces of which a share is seen; of the largest piece always.

    Silhouettes leave room behind the subject; what fills it there, hidden from all, is no object.
    """
    piece = _piece_of_faces(faces, len(seen))
    count = np.bincount(piece)
    num_seen = np.bincount(piece, weights=np.asarray(seen.any(axis=1))[faces].mean(axis=1))
    real = num_seen >= least * count
    real[count.argmax()] = True
    return np.asarray(real[piece])


def _piece_of_faces(faces: Faces, num_vertices: int) -> Int64[np.ndarray, "faces"]:
    """Number of each face's connected piece."""
    edges = faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    piece: Int64[np.ndarray, "faces"] = connected_pieces(edges.T, num_vertices)[faces[:, 0]]
    return piece


def only_used(vertices: Vertices, faces: Faces) -> tuple[KeptVertices, Faces]:
    """Without the vertices that no face uses; the others keep their order."""
    used, renumbered = np.unique(faces, return_inverse=True)
    return vertices[used], renumbered.reshape(-1, 3).astype(np.int64)


def simplified(vertices: Vertices, faces: Faces, max_faces: int) -> tuple[KeptVertices, KeptFaces]:
    """At most about `max_faces` faces by quadric edge collapse; a closed mesh stays closed.

    Where the collapse would open a closed mesh, more faces are kept: a few more, and where that does not
    help, as of a foam, soon many more.
    """
    closed = trimesh.Trimesh(vertices, faces, process=False).is_watertight
    target, growth = max_faces, _MORE_FACES
    # single precision resolves a mesh of unit size at the origin best
    middle, size = vertices.mean(axis=0), float(np.ptp(vertices, axis=0).max())
    unit = ((vertices - middle) / size).astype(np.float32)
    while target < len(faces):
        points, fewer = fast_simplification.simplify(
            unit, faces.astype(np.int32), target_count=target, agg=5, lossless=False
        )
        fewer = without_short_edges(points.astype(np.float64), fewer.astype(np.int64), _SHORTEST)
        if not closed or trimesh.Trimesh(points, fewer, process=False).is_watertight:
            return only_used(points.astype(np.float64) * size + middle, fewer)
        target, growth = round(growth * target), growth**2
    return vertices, faces


def without_short_edges(vertices: Vertices, faces: Faces, shortest: float) -> KeptFaces:
    """Faces where the ends of each edge that is not longer than `shortest` are one vertex.

    The faces at such an edge have no area, and go; those around close over it.
    """
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    short = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1) <= shortest
    if not short.any():
        return faces
    piece = connected_pieces(edges[short].T, len(vertices))
    _, first = np.unique(piece, return_index=True)
    joined = first[piece][faces]
    apart = (joined != np.roll(joined, 1, axis=1)).all(axis=1)
    return np.asarray(joined[apart], np.int64)


def vertex_normals(vertices: Vertices, faces: Faces) -> Float64[np.ndarray, "vertices 3"]:
    """Unit normals, the mean of the faces around weighted by their area."""
    across = area_vectors(vertices, faces)
    normals = np.stack(
        [
            np.bincount(faces.ravel(), weights=np.repeat(across[:, axis], 3), minlength=len(vertices))
            for axis in range(3)
        ],
        axis=1,
    )
    return _unit(normals)


def _unit(vectors: Float64[np.ndarray, "vectors 3"]) -> Float64[np.ndarray, "vectors 3"]:
    """Of length 1, but for those without any."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0, length, 1.0))


def support_of(
    vertices: Vertices,
    seen: Bool[np.ndarray, "vertices views"],
    points: Float64[np.ndarray, "points 3"],
    confidence: Float32[np.ndarray, "points"],
    reach: float,
) -> Float32[np.ndarray, "vertices"]:
    """How well photographs back every vertex, 0 to 1 (see the module's first lines)."""
    measured = measured_share(vertices, points, confidence, reach)
    looked_at = -np.expm1(-seen.sum(axis=1).astype(np.float64))
    return np.asarray(0.7 * measured + 0.3 * looked_at, np.float32)


def measured_share(
    vertices: Vertices,
    points: Float64[np.ndarray, "points 3"],
    confidence: Float32[np.ndarray, "points"],
    reach: float,
) -> Float64[np.ndarray, "vertices"]:
    """How well points near every vertex back it, 0 to 1: saturates with their number and confidence."""
    if not len(points):
        return np.zeros(len(vertices))
    # beyond, the bell is less than 1e-10; a search without a bound is slow where no point is near
    distance, nearest = nearest_tree(points).query(
        vertices, k=min(8, len(points)), distance_upper_bound=7.5 * reach, workers=-1
    )
    near = np.exp(-((np.atleast_2d(distance.T).T / (1.5 * reach)) ** 2))
    near *= np.append(confidence, 0.0)[np.atleast_2d(nearest.T).T]  # the last for those that found none
    return np.asarray(-np.expm1(-near.sum(axis=1)))


def _open_or_closed(
    vertices: Vertices,
    support: Float32[np.ndarray, "vertices"],
    depth_maps: tuple[DepthMap, ...],
    reach: float,
) -> tuple[Float64[np.ndarray, "vertices"] | None, Decision]:
    """How far a vertex lies beyond the end of the surface, < 0 before it, where there are no masks.

    If measured surface runs out of the pictures, they show a piece of a larger scene, whose back does not
    exist: surface far from any measurement is cut off. Otherwise the object stays closed: None.
    """
    at_edges = float(np.mean([measured_at_edges(map_) for map_ in depth_maps]))
    because = f"{at_edges:.1%} of the pictures' edges show measured surface"
    measured = support > 0.5
    if at_edges < MEASURED_EDGES or not measured.any():
        decision = Decision(what="back side", choice="closed smoothly", because=because)
        return None, decision
    distance, _ = nearest_tree(vertices[measured]).query(vertices, workers=-1)
    decision = Decision(what="back side", choice="cut off", because=f"{because}: a piece of a larger scene")
    return distance - _LOOSE_REACHES * reach, decision


def measured_at_edges(map_: DepthMap) -> float:
    """Share of a frame just inside the picture where the surface was surely measured."""
    sure = map_.confidence > SURE
    inset = max(4, round(0.02 * min(sure.shape)))
    frame = [sure[inset], sure[-inset - 1], sure[:, inset], sure[:, -inset - 1]]
    return float(np.concatenate(frame).mean())
