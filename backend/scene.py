"""The frozen records that pass between stages.

Conventions (docs/conventions.md): camera axes x right, y down, z forward; transforms are called
`b_from_a` and are 4x4 float64; the centre of the top left pixel is (0.5, 0.5); images are float32
in [0, 1], indexed [row, column].
Frames: `world` is the frame of the given or solved cameras, in which results leave; `object` has
the subject inside the unit sphere.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt8

Mask = Float32[np.ndarray, "height width"]
"""1 on the subject, 0 off it."""

Progress = Callable[[float, str], None]
"""Called with the share of the stage that is done (0 to 1) and a few words; may raise Cancelled."""


def no_progress(_fraction: float, _text: str) -> None:
    """A progress callback that shows nothing and never cancels."""


def within(progress: Progress, first: float, last: float) -> Progress:
    """Tells of a part of the work, which goes from `first` to `last` of the whole."""
    return lambda fraction, text: progress(first + (last - first) * fraction, text)


@dataclass(frozen=True, kw_only=True)
class Decision:
    """Something modelled or left out, and the measurement that decided it; shown in the report."""

    what: str
    choice: str
    because: str


@dataclass(frozen=True, kw_only=True)
class Photo:
    """A photograph, upright, at working size, before its camera is known."""

    name: str
    """File name, unique in the job."""
    path: Path
    image_srgb: Float32[np.ndarray, "height width 3"]
    mask: Mask | None
    """1 on the subject, 0 off it; None where nothing is known."""
    original_width: int
    """Upright, before scaling down, in pixels."""
    original_height: int
    focal_px: float | None
    """Focal length in pixels of the original size, from EXIF; None where there is none."""
    exif_orientation: int = 1
    """1 to 8: how the file's own pixels had to be turned; 1 where they stand upright."""


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A pinhole camera."""

    camera_from_world: Float64[np.ndarray, "4 4"]
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    width: int
    height: int

    @property
    def intrinsics(self) -> Float64[np.ndarray, "3 3"]:
        """Calibration matrix K: pixel = K @ point_in_camera, up to scale."""
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1]], np.float64)

    @property
    def position(self) -> Float64[np.ndarray, "3"]:
        """Centre of projection, world frame."""
        rotation = self.camera_from_world[:3, :3]
        centre: Float64[np.ndarray, "3"] = -rotation.T @ self.camera_from_world[:3, 3]
        return centre

    def resized(self, width: int, height: int) -> "Camera":
        """The same camera over an image of another size."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            fx_px=self.fx_px * sx,
            cx_px=self.cx_px * sx,
            fy_px=self.fy_px * sy,
            cy_px=self.cy_px * sy,
            width=width,
            height=height,
        )


@dataclass(frozen=True, kw_only=True)
class View:
    """An undistorted photograph with its camera; image, mask and camera agree in size."""

    name: str
    camera: Camera
    image_srgb: Float32[np.ndarray, "height width 3"]
    mask: Mask | None


@dataclass(frozen=True, kw_only=True)
class Lens:
    """The lens that took a photograph, over the photograph's original, upright size."""

    model: str
    """Name of a projection model of COLMAP."""
    width: int
    height: int
    params: tuple[float, ...]
    """In COLMAP's order for the model; lengths in pixels of the original size."""


@dataclass(frozen=True, kw_only=True)
class Unplaced:
    """A photograph without a camera."""

    name: str
    why: str
    """For a person: a phrase that may follow the name, without a full stop."""


@dataclass(frozen=True, kw_only=True)
class CameraEvidence:
    """What estimated cameras rest on. Photographs are all that were given, in their order."""

    names: tuple[str, ...]
    """Of the photographs."""
    num_features: Int64[np.ndarray, "photos"]
    num_matched: Int64[np.ndarray, "photos photos"]
    """Features of two photographs that look alike; symmetric, 0 on the diagonal."""
    num_verified: Int64[np.ndarray, "photos photos"]
    """Of these, those that one geometry of the two explains."""
    error_px: Float64[np.ndarray, "points views"]
    """How far beside its sparse point a feature lies, in pixels of the photograph; 0 where it is not seen."""
    pose_covariance: Float64[np.ndarray, "views 6 6"] | None
    """Of each camera's orientation (rotation vector, world axes, radians) and centre (world units), in the
    frame of the cameras as a whole (maths/gauge.py). None where nothing is left over to tell errors from."""
    lenses_free: bool
    """Whether that counts what photographs leave open of the lenses; not where they tell hardly anything."""
    point_sigma_world: Float64[np.ndarray, "points"] | None
    """Standard deviation of each sparse point where it is least sure, the cameras held."""


@dataclass(frozen=True, kw_only=True)
class SolvedCameras:
    """What the camera stage found."""

    views: tuple[View, ...]
    lenses: tuple[Lens, ...]
    """One for each view: what its photograph was taken with before the distortion was removed."""
    unplaced: tuple[Unplaced, ...]
    estimated: bool
    """False where the cameras were given, but for those that FewView estimated in an earlier job."""
    sparse_positions: Float64[np.ndarray, "points 3"]
    """Triangulated features, world frame; empty where the cameras were given without any."""
    sparse_visibility: Bool[np.ndarray, "points views"]
    reprojection_error_px: float | None
    """Mean over the sparse points, in pixels of the photographs as placed; None where not estimated."""
    evidence: CameraEvidence | None = None
    """None where the cameras were given."""
    masks_cut_out: bool = False
    """Whether FewView made masks of its own, which show the subject to a pixel or two and no finer."""
    suit_outlines: bool = False
    """Whether estimated cameras were moved until the subject's outlines suit each other."""
    way_up_told: bool = False
    """Whether the photographs told which way up given cameras are."""
    decisions: tuple[Decision, ...] = ()


@dataclass(frozen=True, kw_only=True)
class CutOut:
    """Masks that FewView made."""

    masks: tuple[Mask | None, ...]
    """One per view; None for one that has a mask already, or whose mask would contradict the others."""
    doubt: str | None = None
    """For a person: where the subject could not be cut out, and what helps; None if it could everywhere."""
    decisions: tuple[Decision, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Region:
    """The part of the world to reconstruct: the sphere that `object_from_world` maps to the unit sphere."""

    object_from_world: Float64[np.ndarray, "4 4"]
    """A similarity: uniform scale, rotation, translation."""
    given: bool = False
    """By the user, rather than found."""
    decisions: tuple[Decision, ...] = ()
    doubt: str | None = None
    """For a person: what speaks against it, and what helps; None if nothing does."""

    @property
    def world_from_object(self) -> Float64[np.ndarray, "4 4"]:
        """Inverse of object_from_world."""
        return np.linalg.inv(self.object_from_world)

    @property
    def centre_world(self) -> Float64[np.ndarray, "3"]:
        """Centre of the sphere, world frame."""
        return self.world_from_object[:3, 3]

    @property
    def radius_world(self) -> float:
        """Radius of the sphere, world units."""
        return float(np.cbrt(np.linalg.det(self.world_from_object[:3, :3])))

    def part(self, part_from_object: Float64[np.ndarray, "4 4"]) -> "Region":
        """The sphere that a similarity maps from the object frame to the unit sphere of its own."""
        return Region(object_from_world=part_from_object @ self.object_from_world)


@dataclass(frozen=True, kw_only=True)
class SurfacePoints:
    """Points on the surface as stereo saw them, object frame; ValueError where one of them is not finite."""

    positions: Float32[np.ndarray, "points 3"]
    normals: Float32[np.ndarray, "points 3"]
    """Unit, pointing out of the object."""
    colours_srgb: Float32[np.ndarray, "points 3"]
    confidence: Float32[np.ndarray, "points"]
    """0 to 1."""
    num_views: Int64[np.ndarray, "points"]
    """Photographs that agree on the point, at least 2."""
    view_index: Int64[np.ndarray, "points"]
    """The photograph whose depth map the point comes from."""
    decisions: tuple[Decision, ...] = ()

    def __post_init__(self) -> None:
        for name in ("positions", "normals", "colours_srgb", "confidence"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"{name} of surface points hold numbers that are not finite")

    def chosen(self, which: Bool[np.ndarray, "points"]) -> "SurfacePoints":
        """Those of the points, with the same decisions."""
        kept = {f.name: getattr(self, f.name)[which] for f in fields(self) if f.name != "decisions"}
        return replace(self, **kept)


@dataclass(frozen=True, kw_only=True)
class DepthMap:
    """What one photograph measured; full image size, object frame."""

    depth: Float32[np.ndarray, "height width"]
    """Along the camera's axis, object units; 0 where nothing was measured."""
    confidence: Float32[np.ndarray, "height width"]
    """0 to 1."""
    empty: Bool[np.ndarray, "height width"] | None
    """Where the photograph, if it has no mask, shows nothing but an even backdrop; None where it has none."""
    subject: Bool[np.ndarray, "height width"] | None
    """Where something surely stands before that backdrop."""
    behind: Bool[np.ndarray, "height width"] | None = None
    """Where patches agree better behind the region than anywhere in it; None where a mask or an even backdrop
    tells what is not the subject."""

    def measured_where(self, kept: Bool[np.ndarray, "height width"]) -> "DepthMap":
        """What was measured there; elsewhere nothing was."""
        depth, confidence = (np.where(kept, of, np.float32(0)) for of in (self.depth, self.confidence))
        return replace(self, depth=depth, confidence=confidence)


@dataclass(frozen=True, kw_only=True)
class Ground:
    """What the subject stands on, object frame: all x with normal . x = offset; nothing of it is below."""

    normal: Float64[np.ndarray, "3"]
    """Unit, upwards."""
    offset: float
    thickness: float
    """Up to this height what was measured is the ground's."""

    def height(self, points: Float64[np.ndarray, "*batch 3"]) -> Float64[np.ndarray, "*batch"]:
        """Above the plane; < 0 below it."""
        return np.asarray(points @ self.normal - self.offset)


@dataclass(frozen=True, kw_only=True)
class StereoResult:
    """Points of the surface and the depth maps they come from, one per view."""

    points: SurfacePoints
    depth_maps: tuple[DepthMap, ...]
    refined_cameras: tuple[Camera, ...] | None = None
    """One per view; None where those that stereo was given are as good."""
    beside_lines_px: float | None = None
    """How far patches of surface lie beside their epipolar lines for the worst of given cameras; None where
    these were estimated, or too few patches tell."""
    ground: Ground | None = None
    """Left out of points and depth maps; None where it is not, or there is none."""
    doubt: str | None = None
    """For a person: what was asked for and could not be done, or could be asked for; None if nothing is."""
    decisions: tuple[Decision, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Texture:
    """A picture that is laid on a mesh."""

    image_srgb: UInt8[np.ndarray, "height width 3"]
    corners_px: Float32[np.ndarray, "faces 3 2"]
    """Where in the picture each face's corners lie: (x, y), from the outer corner of its top left pixel."""


@dataclass(frozen=True, kw_only=True)
class SurfaceMesh:
    """A triangle mesh, world frame; faces are counter-clockwise seen from outside."""

    vertices: Float64[np.ndarray, "vertices 3"]
    faces: Int64[np.ndarray, "faces 3"]
    normals: Float32[np.ndarray, "vertices 3"]
    colours_srgb: UInt8[np.ndarray, "vertices 3"]
    support: Float32[np.ndarray, "vertices"]
    """How well the photographs back the vertex: 0 seen by none, a guess; 1 seen and measured by several."""
    texture: Texture | None = None
    """Finer than the colours of the vertices; None where there is none."""
    decisions: tuple[Decision, ...] = ()


def to_unit_sphere(centre: Float64[np.ndarray, "3"], radius: float) -> Float64[np.ndarray, "4 4"]:
    """The similarity, without rotation, that maps a sphere to the unit sphere."""
    unit_from_frame = np.eye(4)
    unit_from_frame[:3, :3] /= radius
    unit_from_frame[:3, 3] = -centre / radius
    return unit_from_frame


def transform_points(
    b_from_a: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """Points given in frame a, in frame b."""
    transformed: Float[np.ndarray, "*batch 3"] = points @ b_from_a[:3, :3].T + b_from_a[:3, 3]
    return transformed
