"""In which frame a job's results are, and where that lies in the scene.

Known cameras stand in the world. Estimated ones have a frame of their own, placed by a root empty; a job
that was given the cameras of an earlier one is in the frame of that one.
"""

from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from .arguments import absolute
from .camera_objects import BAKED, JOB, ROLE, ROOT, kept_similarity, root_or_none, world_from_solved
from .job_folder import (
    CAMERAS,
    JOB_FILE,
    MESH,
    RESULT,
    FolderError,
    PastJob,
    inside,
    read_job_file,
    results_in,
)
from .placing import similarity_between
from .ply import read_ply
from .properties import FEWVIEW_PG_settings
from .solved import read_solved


def frame_owner(job: PastJob) -> Path:
    """Folder of the job whose cameras made the frame of this one's results: itself, or an earlier one."""
    if job.job is not None and job.job.cameras is not None:
        path = Path(job.job.cameras)
        folder = path.parent.parent
        if (path.name, path.parent.name) == (CAMERAS, RESULT) and (folder / JOB_FILE).is_file():
            return folder
    return job.folder


def finds_cameras(job: PastJob) -> bool:
    """Whether the job estimates its cameras itself, rather than being given known or estimated ones."""
    return job.job is not None and job.job.cameras is None


def world_from_solved_or_none(
    scene: bpy.types.Scene, job: PastJob, *, estimated: bool
) -> NDArray[np.float64] | None:
    """(4, 4) similarity; None where the cameras were estimated and are not in the scene yet."""
    root = root_or_none(scene, str(frame_owner(job).absolute()))
    if root is not None:
        return world_from_solved(root)
    return None if estimated else np.eye(4)


def chosen_job_or_none(settings: FEWVIEW_PG_settings) -> Path | None:
    """Folder of the job that found, or loaded, the cameras that step 2 is set to; None where none did."""
    if not settings.cameras_job:
        return None
    folder = Path(absolute(settings.cameras_job))
    known = absolute(settings.cameras_path) if settings.camera_source == "KNOWN" else None
    try:
        return folder if read_job_file(folder).cameras == known else None
    except FolderError:  # the user has moved or removed it
        return None


def world_from_cameras_or_none(scene: bpy.types.Scene, cameras: Path) -> NDArray[np.float64] | None:
    """(4, 4): where the frame of a file of cameras lies in the scene; None where they were estimated and no
    root places them.

    Known cameras stand in the world. Of several roots that place the same cameras, the scene's counts.
    """
    roots = [made for made in scene.objects if made.get(ROLE) == ROOT and _places(made, cameras)]
    if roots:
        return world_from_solved(max(roots, key=lambda root: root == scene.fewview.root))
    try:
        # the folder of a finished run stands for the cameras in it
        file = cameras / CAMERAS if cameras.is_dir() else cameras
        return None if read_solved(file).estimated else np.eye(4)
    except ValueError:  # another program's, as a COLMAP model
        return np.eye(4)


def world_from_result(result: bpy.types.Object, folder: Path) -> NDArray[np.float64]:
    """(4, 4): where the frame of a job's files lies in the scene, as its imported mesh is placed now.

    As long as the mesh has the vertices of the job's file, they tell it, so that a transform that was
    applied counts; after a remesh, what the import kept. Raises ValueError where the mesh has become
    another, or the file is damaged, OSError where it cannot be read.
    """
    path = inside(folder, results_in(folder) / MESH)
    solved = read_ply(path).positions if path.is_file() else np.empty((0, 3))
    return np.array(result.matrix_world, np.float64) @ _object_from_solved(result, solved)


def _places(root: bpy.types.Object, cameras: Path) -> bool:
    """Whether the root's job found the cameras of the file, or was given them."""
    folder = Path(str(root.get(JOB, "")))
    if results_in(folder) / CAMERAS == cameras:
        return True
    try:
        return read_job_file(folder).cameras == str(cameras)
    except FolderError:
        return False


def _object_from_solved(result: bpy.types.Object, solved: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, 4), by the positions (vertices, 3) of the job's mesh."""
    if not len(solved) or len(solved) != len(result.data.vertices):
        return kept_similarity(result, BAKED)
    flat = np.empty(3 * len(solved), np.float32)
    result.data.attributes["position"].data.foreach_get("vector", flat)
    try:
        return similarity_between(solved, flat.reshape(-1, 3).astype(np.float64))
    except ValueError as error:
        text = f"{result.name} has another shape than the job's mesh: import it again from Past Jobs"
        raise ValueError(text) from error
