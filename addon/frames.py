"""In which frame a job's results are, and where that lies in the scene.

Known cameras stand in the world. Estimated ones have a frame of their own, placed by a root empty; a job
that was given the cameras of an earlier one is in the frame of that one.
"""

from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from .camera_objects import root_or_none, world_from_solved
from .job_folder import CAMERAS, JOB_FILE, RESULT, PastJob


def frame_owner(job: PastJob) -> Path:
    """Folder of the job whose cameras made the frame of this one's results: itself, or an earlier one."""
    if job.job.cameras is not None:
        path = Path(job.job.cameras)
        folder = path.parent.parent
        if (path.name, path.parent.name) == (CAMERAS, RESULT) and (folder / JOB_FILE).is_file():
            return folder
    return job.folder


def has_own_frame(job: PastJob) -> bool:
    """Whether the job estimates its cameras itself."""
    return job.job.cameras is None


def world_from_solved_or_none(scene: bpy.types.Scene, job: PastJob) -> NDArray[np.float64] | None:
    """(4, 4) similarity; None where the cameras are estimated and not in the scene yet."""
    owner = frame_owner(job)
    if not has_own_frame(job) and owner == job.folder:
        return np.eye(4)
    root = root_or_none(scene, str(owner.absolute()))
    return None if root is None else world_from_solved(root)
