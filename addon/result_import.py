"""The result of a job on disk in the scene: its mesh, and the cameras and points it was made from."""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from . import camera_lens, undo_step
from .camera_objects import (
    POINTS,
    ROLE,
    CameraImport,
    import_steps,
    objects_of,
    read_import,
    root_or_none,
    upright,
)
from .frames import finds_cameras, frame_owner, world_from_solved_or_none
from .job_folder import CAMERAS, MESH, TEXTURE, PastJob, inside, read_job, results_in
from .mesh_import import MeshImport, import_mesh, read_in_steps
from .scenes import scene_named
from .solved import SolvedScene, read_solved

_SAME_PLACE = 1e-4
"""Of a camera's axes, and of its place in what all cameras span."""


def import_result_steps(
    folder: Path,
    *,
    scene_name: str,
    cameras: bool = True,
    undo: bool = True,
    warnings: list[str] | None = None,
) -> Iterator[None]:
    """Import the mesh of a job, and its cameras, in steps short enough for a timer, as one undo step.

    What the user should know is added to the warnings.
    The cameras of an earlier job that this one was given are left as they are, and so are cameras of the
    user's that the views were rendered from. Give `undo` False where an operator makes the undo step
    itself. The mesh is read first: where it cannot be used, the scene is left as it is. Raises
    FolderError, ValueError or OSError with a sentence for the user.
    """
    job = read_job(folder)
    if job.of_points:
        yield from import_fit_steps(job.folder, scene_name=scene_name, undo=undo)
        return
    mesh = yield from read_in_steps(inside(job.folder, job.result / MESH))
    found = _cameras_or_none(job)
    yield
    scene = scene_named(scene_name)
    if (
        cameras
        and found is not None
        and frame_owner(job) == job.folder
        and not _are_there(scene, found.solved)
    ):
        yield from import_steps(scene_name, found, [] if warnings is None else warnings)
        scene = scene_named(scene_name)
    root = root_or_none(scene, str(frame_owner(job).absolute()))
    wanted = MeshImport(
        job=str(job.folder.absolute()),
        scene_name=scene_name,
        texture=inside(job.folder, job.result / TEXTURE),
        world_from_solved=world_from_solved(scene, job, None if found is None else found.solved),
        parent_uid=None if root is None else root.session_uid,
    )
    yield from import_mesh(mesh, wanted)
    _settle(scene_named(scene_name), job)
    if undo:
        undo_step.push(f"Import {job.folder.name}")


def import_fit_steps(folder: Path, *, scene_name: str, name: str = "", undo: bool = True) -> Iterator[None]:
    """Import the surface of points, which lie in the world frame, as `import_result_steps` does a job's."""
    mesh = yield from read_in_steps(inside(folder, results_in(folder) / MESH))
    wanted = MeshImport(
        job=str(folder.absolute()), scene_name=scene_name, world_from_solved=np.eye(4), name=name
    )
    yield from import_mesh(mesh, wanted)
    if undo:
        undo_step.push(f"Import {name or folder.name}")


def show_estimated_cameras(path: Path, job: PastJob, scene_name: str, warnings: list[str]) -> Iterator[None]:
    """Show cameras that a running job has found, so that its previews have a place; none that were known.

    What the user should know is added to the warnings.
    """
    solved = read_solved(path)
    yield
    if solved.estimated and frame_owner(job) == job.folder:
        wanted = CameraImport(
            job=str(job.folder.absolute()), solved=solved, photographs=_photographs(job), points=None
        )
        yield from import_steps(scene_name, wanted, warnings)


def world_from_solved(
    scene: bpy.types.Scene, job: PastJob, solved: SolvedScene | None
) -> NDArray[np.float64]:
    """(4, 4): where the job's frame lies in the scene.

    Estimated cameras are placed by their root, which the user may have moved; without one they are put
    upright, as a root would be.
    """
    placed = world_from_solved_or_none(scene, job, estimated=solved is not None and solved.estimated)
    if placed is not None:
        return placed
    assert solved is not None
    if solved.region_centre is None or solved.region_radius is None:
        return np.eye(4)
    return upright(solved)


def _settle(scene: bpy.types.Scene, job: PastJob) -> None:
    """Hide the points, which would cover the mesh; let the next job use the cameras that this one found."""
    for points in objects_of(scene, str(frame_owner(job).absolute()), POINTS):
        points.hide_viewport = True
    if finds_cameras(job):
        scene.fewview.cameras_job = str(job.folder.absolute())


def _are_there(scene: bpy.types.Scene, solved: SolvedScene) -> bool:
    """Whether the user has a camera wherever a known one stands, as after a render of generated views."""
    own = [made for made in scene.objects if made.type == "CAMERA" and ROLE not in made]
    poses = [] if solved.estimated else [*_poses(own)]
    if not poses:
        return False
    stand = np.array(poses)
    size = float(np.ptp(stand[:, :3, 3], axis=0).max()) or 1.0
    off = np.abs(stand[None] - solved.poses[:, None])
    off[..., :3, 3] /= size
    return bool((off.max(axis=(-2, -1)).min(axis=1) < _SAME_PLACE).all())


def _poses(cameras: Iterable[bpy.types.Object]) -> Iterator[NDArray[np.float64]]:
    """`world_from_camera` (4, 4) of those that have one: a mirrored or sheared camera is none of a job's."""
    for camera in cameras:
        with suppress(ValueError):
            yield camera_lens.world_from_camera(camera)


def _cameras_or_none(job: PastJob) -> CameraImport | None:
    """The job's cameras and points, as far as there are any."""
    if not inside(job.folder, job.result / CAMERAS).is_file():
        return None
    return read_import(job.folder, _photographs(job))


def _photographs(job: PastJob) -> tuple[Path, ...]:
    return () if job.job is None else tuple(job.folder / image for image in job.job.images)
