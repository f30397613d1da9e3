"""The command line with small stages in place of the real ones, run as a program by test_cli.py.

Arguments: the trouble to make, the stage to make it in, the duration of each of a stage's 10 steps in
seconds, and then what the command line itself takes. The file in DONE_LOG gets the name of each stage that
is computed.
"""

import dataclasses
import errno
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from backend.__main__ import main
from backend.commands import reconstruct
from backend.scene import (
    Camera,
    Lens,
    Photo,
    Progress,
    Region,
    SolvedCameras,
    SurfaceMesh,
    SurfacePoints,
    Unplaced,
    View,
    to_unit_sphere,
)
from backend.stages.region import RegionConfig
from backend.stages.surface import ShowSurface, Surface
from backend.wire.photographs import photographs_in


@dataclasses.dataclass(frozen=True, kw_only=True)
class FakeStereo:
    points: SurfacePoints
    refined_cameras: tuple[Camera, ...] | None = None
    beside_lines_px: None = None
    doubt: None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class FakeSurface:
    values: np.ndarray
    radiance: None = None


def fail(error: Exception) -> None:
    raise error


TROUBLES: dict[str, Callable[[], object]] = {
    "none": lambda: None,
    "internal": lambda: fail(ZeroDivisionError("on purpose")),
    "memory": lambda: fail(MemoryError()),
    "torch_memory": lambda: fail(RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried")),
    "disk": lambda: fail(OSError(errno.ENOSPC, "No space left on device")),
    "import": lambda: fail(ImportError("No module named 'pycolmap'", name="pycolmap")),
    "hang": lambda: time.sleep(60),
}
TROUBLE, WHERE, STEP_S = TROUBLES[sys.argv[1]], sys.argv[2], float(sys.argv[3])


def work(name: str, progress: Progress) -> None:
    os.write(1, b"noise of a C library\n")
    sys.stdout.write("noise of a Python library\n")
    with Path(os.environ["DONE_LOG"]).open("a") as log:
        log.write(name + "\n")
    for step in range(10):
        progress(step / 10, f"{name} {step}")
        time.sleep(STEP_S)
        if name == WHERE and step == 5:
            TROUBLE()


def load_photos(
    sources: tuple[Path, ...], _masks: Path | None, _config: Any, *, progress: Progress
) -> tuple[Photo, ...]:
    work("photos", progress)
    image = np.zeros((4, 6, 3), np.float32)
    sizes: dict[str, Any] = {"original_width": 6, "original_height": 4, "focal_px": None}
    paths = sorted(
        path for source in sources for path in (photographs_in(source) if source.is_dir() else [source])
    )
    return tuple(Photo(name=path.name, path=path, image_srgb=image, mask=None, **sizes) for path in paths)


def solve_cameras(
    photos: tuple[Photo, ...],
    _given: Path | None,
    _config: Any,
    *,
    workdir: Path,
    seed: int,
    progress: Progress,
) -> SolvedCameras:
    (workdir / f"database {seed}").touch(exist_ok=False)
    work("cameras", progress)
    camera = Camera(
        camera_from_world=np.eye(4), fx_px=5.0, fy_px=5.0, cx_px=3.0, cy_px=2.0, width=6, height=4
    )
    views = tuple(View(name=p.name, camera=camera, image_srgb=p.image_srgb, mask=None) for p in photos[1:])
    return SolvedCameras(
        views=views,
        lenses=(Lens(model="PINHOLE", width=6, height=4, params=(5.0, 5.0, 3.0, 2.0)),) * len(views),
        unplaced=(Unplaced(name=photos[0].name, why="on purpose"),),
        estimated=True,
        sparse_positions=np.array([[0.0, 0.0, 2.0], [0.1, 0.0, 2.0]]),
        sparse_visibility=np.ones((2, len(views)), bool),
        reprojection_error_px=None,
    )


def find_region(_solved: SolvedCameras, config: RegionConfig, *, progress: Progress) -> Region:
    work("region", progress)
    if config.centre_world is None or config.radius_world is None:
        return Region(object_from_world=np.eye(4))
    return Region(object_from_world=to_unit_sphere(np.array(config.centre_world), config.radius_world))


def match_views(
    _solved: SolvedCameras, _region: Region, _config: Any, *, device: torch.device, progress: Progress
) -> FakeStereo:
    assert device.type == "cpu"
    work("stereo", progress)
    ones = np.ones((5, 3), np.float32)
    points = SurfacePoints(
        positions=ones,
        normals=ones,
        colours_srgb=ones,
        confidence=ones[:, 0],
        num_views=np.full(5, 2),
        view_index=np.arange(5) % 2,
    )
    return FakeStereo(points=points)


def fit_surface(
    *_earlier: Any, device: torch.device, generator: torch.Generator, progress: Progress, show: ShowSurface
) -> FakeSurface:
    work("train", progress)
    show(ball())
    return FakeSurface(values=torch.rand(3, generator=generator, device=device).numpy())


def ball() -> Surface:
    """A ball with half the radius of the grid."""
    steps = np.linspace(-1, 1, 16, dtype=np.float32)
    x, y, z = np.meshgrid(steps, steps, steps, indexing="ij")
    return Surface(distance=np.sqrt(x**2 + y**2 + z**2) - np.float32(0.5), grid_from_world=np.eye(4))


def extract_mesh(*earlier: Any, originals: Any, progress: Progress) -> SurfaceMesh:
    work("mesh", progress)
    vertices = np.eye(3) * earlier[3].values
    return SurfaceMesh(
        vertices=vertices,
        faces=np.array([[0, 1, 2]]),
        normals=np.eye(3, dtype=np.float32),
        colours_srgb=np.zeros((3, 3), np.uint8),
        support=np.ones(3, np.float32),
    )


def resolve_and_replace(job: Any, base: Path) -> Any:
    """Put the small stages in place as late as can be: the real ones are loaded when a run loads them."""
    from backend import pipeline

    pipeline.STAGES = pipeline.Stages(
        load_photos=load_photos,
        solve_cameras=solve_cameras,
        find_region=find_region,
        match_views=match_views,  # type: ignore[arg-type]
        fit_surface=fit_surface,  # type: ignore[arg-type]
        extract_mesh=extract_mesh,
    )
    return real_resolve(job, base)


if __name__ == "__main__":
    real_resolve = reconstruct.resolve
    reconstruct.resolve = resolve_and_replace
    sys.exit(main(sys.argv[4:]))
