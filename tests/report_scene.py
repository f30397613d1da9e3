"""A made-up finished run: a patterned ball on a foot, "photographed" by drawing a finer, true one."""

from dataclasses import dataclass, replace

import numpy as np
import trimesh

from backend.maths.metrics import TrueSurface
from backend.maths.raycast import render_mesh
from backend.scene import (
    Camera,
    Decision,
    Region,
    SolvedCameras,
    SurfaceMesh,
    SurfacePoints,
    Unplaced,
    View,
)
from backend.stages.report import ReportInputs, StageTiming
from tests.synthetic_scene import pinhole_lens


@dataclass(frozen=True, kw_only=True)
class InnerSettings:
    num_planes: int = 128
    margin: float | None = None


@dataclass(frozen=True, kw_only=True)
class Settings:
    preset: str = "balanced"
    stereo: InnerSettings = InnerSettings()


def figure_mesh(resolution: int = 4, wobble: float = 0.0) -> SurfaceMesh:
    """A ball with a ring around it; z is up; the back (+y) is unsupported."""
    ball = trimesh.creation.icosphere(resolution)
    ring = trimesh.creation.torus(1.0, 0.28, major_sections=16 * resolution, minor_sections=8 * resolution)
    ring.apply_transform(trimesh.transformations.rotation_matrix(0.5, [1, 0.3, 0]))
    solid = trimesh.util.concatenate([ball, ring])
    vertices, normals = np.asarray(solid.vertices, np.float64), np.asarray(solid.vertex_normals, np.float32)
    waves = np.sin(7 * vertices[:, 0]) * np.sin(6 * vertices[:, 1] + 1) * np.sin(8 * vertices[:, 2])
    checks = np.sign(np.sin(9 * vertices)).prod(axis=1)
    colours = 0.5 + 0.28 * vertices / 1.3 + 0.13 * checks[:, None]
    return SurfaceMesh(
        vertices=vertices + wobble * waves[:, None] * normals,
        faces=np.asarray(solid.faces, np.int64),
        normals=normals,
        colours_srgb=np.round(colours.clip(0, 1) * 255).astype(np.uint8),
        support=np.clip(0.45 - 0.8 * vertices[:, 1], 0, 1).astype(np.float32),
    )


def camera_at(azimuth: float, height: float, width: int = 320) -> Camera:
    """Four units from the origin, looking at it; azimuth 0 is at -y."""
    position = np.array([np.sin(azimuth) * 4, -np.cos(azimuth) * 4, height])
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0.0, 0, 1])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3], camera_from_world[:3, 3] = rotation, -rotation @ position
    focal_px, rows = 1.15 * width, width * 3 // 4
    return Camera(
        camera_from_world=camera_from_world,
        fx_px=focal_px,
        fy_px=focal_px,
        cx_px=width / 2,
        cy_px=rows / 2,
        width=width,
        height=rows,
    )


def photograph(name: str, truth: SurfaceMesh, camera: Camera, *, masked: bool) -> View:
    """The true mesh in its colours before a wall."""
    image = render_mesh(truth, camera)
    wall = np.array([0.33, 0.30, 0.28], np.float32)
    mask = image.coverage.astype(np.float32) if masked else None
    colours = np.where(image.coverage[..., None], image.colour_srgb, wall)
    return View(name=name, camera=camera, image_srgb=colours, mask=mask)


def finished_run(
    *, num_photos: int = 5, wobble: float = 0.03, masked: bool = True, width: int = 320, resolution: int = 4
) -> ReportInputs:
    """A run on as many photographs, one more not placed, its mesh off by the wobble; no truth given."""
    truth = figure_mesh(resolution)
    azimuths = np.linspace(-0.8, 0.8, num_photos)
    views = tuple(
        photograph(f"IMG_{4021 + index}.JPG", truth, camera_at(azimuth, 1.2, width), masked=masked)
        for index, azimuth in enumerate(azimuths)
    )
    none = np.zeros((0, 3))
    mesh = figure_mesh(resolution, wobble)
    return ReportInputs(
        job_name="Ball & ring <study>",
        settings=Settings(),
        seed=7,
        timings=(
            StageTiming(name="photos", seconds=0.42, peak_memory_bytes=310_000_000),
            StageTiming(name="cameras", seconds=11.3, peak_memory_bytes=640_000_000),
            StageTiming(name="region", seconds=0.1, peak_memory_bytes=640_000_000),
            StageTiming(name="stereo", seconds=14.8, peak_memory_bytes=1_120_000_000),
            StageTiming(name="train", seconds=26.1, peak_memory_bytes=1_480_000_000),
            StageTiming(name="mesh", seconds=3.9, peak_memory_bytes=None),
        ),
        warnings=("1 of 6 photographs could not be placed: IMG_4030.JPG.",),
        decisions=(
            Decision(what="region", choice="the masked subject", because="5 photographs have masks"),
            Decision(
                what="background", choice="left out", because="masks cover what lies behind the subject"
            ),
            Decision(
                what="view-dependent colour",
                choice="left out",
                because="points differ by only 1.4 of 255 between photographs, so the surface is matt",
            ),
        ),
        solved=SolvedCameras(
            views=views,
            lenses=tuple(pinhole_lens(view.camera) for view in views),
            unplaced=(Unplaced(name="IMG_4030.JPG", why="it shares no features with the others"),),
            estimated=True,
            sparse_positions=none,
            sparse_visibility=np.zeros((0, num_photos), bool),
            reprojection_error_px=0.47,
        ),
        region=Region(object_from_world=np.diag([0.5, 0.5, 0.5, 1.0])),
        points=SurfacePoints(
            positions=mesh.vertices.astype(np.float32),
            normals=mesh.normals,
            colours_srgb=mesh.colours_srgb.astype(np.float32) / 255,
            confidence=mesh.support,
            num_views=np.full(len(mesh.vertices), 2),
            view_index=np.zeros(len(mesh.vertices), np.int64),
        ),
        mesh=mesh,
        truth=None,
        versions={"FewView": "0.1.0", "torch": "2.13.0", "pycolmap": "4.2.1", "Python": "3.11"},
    )


def with_truth(inputs: ReportInputs, *, resolution: int = 4) -> ReportInputs:
    """The same run, with the true mesh."""
    truth = figure_mesh(resolution)
    return replace(inputs, truth=TrueSurface(vertices=truth.vertices, faces=truth.faces))
