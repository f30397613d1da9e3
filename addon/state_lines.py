"""The state of each step in one line: an icon and a few words."""

from dataclasses import dataclass
from pathlib import Path

import bpy

from .frames import chosen_job_or_none
from .job_folder import CAMERAS, results_in
from .operators.images import list_problems
from .properties import FEWVIEW_PG_settings
from .scenes import in_scene
from .solved import SolvedScene, read_solved

READY, TODO, TROUBLE, AUTOMATIC = "CHECKMARK", "RADIOBUT_OFF", "ERROR", "DOT"
FEWEST_IMAGES = 2
"""Two photographs are reconstructed, though three are better."""


@dataclass(frozen=True, kw_only=True)
class StepState:
    """How a step stands."""

    icon: str
    text: str


def images_state(settings: FEWVIEW_PG_settings) -> StepState:
    """Step 1."""
    num_used = sum(image.use for image in settings.images)
    if not settings.images:
        return StepState(icon=TODO, text="No photographs yet")
    num_missing = sum(image.use and "missing" in image.problem for image in settings.images)
    if num_missing:
        files = "file" if num_used == 1 else "files"
        return StepState(icon=TROUBLE, text=f"{num_missing} of {num_used} {files} missing")
    if num_used < FEWEST_IMAGES:
        photographs = "photograph" if num_used == 1 else "photographs"
        return StepState(icon=TROUBLE, text=f"{num_used} {photographs} in use")
    icon = TROUBLE if list_problems(settings) else READY
    return StepState(icon=icon, text=f"{num_used} photographs")


def cameras_state(settings: FEWVIEW_PG_settings) -> StepState:
    """Step 2."""
    solved = solved_or_none(settings)
    if solved is not None:
        icon = TROUBLE if solved.unplaced else READY
        num_all = len(solved.cameras) + len(solved.unplaced)
        return StepState(icon=icon, text=f"{len(solved.cameras)} of {num_all} photographs placed")
    if settings.camera_source == "KNOWN":
        if not settings.cameras_path:
            return StepState(icon=TODO, text="No file chosen")
        if not Path(bpy.path.abspath(settings.cameras_path)).exists():
            return StepState(icon=TROUBLE, text="The file is missing")
        return StepState(icon=READY, text="Known")
    return StepState(icon=AUTOMATIC, text="Estimated when you reconstruct")


def region_state(settings: FEWVIEW_PG_settings) -> StepState:
    """Step 3."""
    if in_scene(settings.id_data, settings.region) is None:
        return StepState(icon=AUTOMATIC, text="Found automatically")
    return StepState(icon=READY, text="Set by the sphere in the scene")


def reconstruct_state(settings: FEWVIEW_PG_settings) -> StepState:
    """Step 4."""
    if sum(image.use for image in settings.images) < FEWEST_IMAGES:
        return StepState(icon=TODO, text="Add photographs in step 1 first")
    if in_scene(settings.id_data, settings.result) is None:
        return StepState(icon="PLAY", text="Ready to start")
    return StepState(icon=READY, text="Done; start again as you like")


def result_state(result: bpy.types.Object | None) -> StepState:
    """Step 5, for the result that is meant."""
    if result is None:
        return StepState(icon=TODO, text="No mesh yet")
    return StepState(icon=READY, text=result.name)


def solved_or_none(settings: FEWVIEW_PG_settings) -> SolvedScene | None:
    """What step 2 found or loaded; None where it has not run as it is set, or its files are gone."""
    folder = chosen_job_or_none(settings)
    if folder is None:
        return None
    path = results_in(folder) / CAMERAS
    try:
        key = (path, path.stat().st_mtime_ns)
        if key not in _read:
            _read.clear()  # one is shown at a time
            _read[key] = read_solved(path)
        return _read[key]
    except (OSError, ValueError):
        return None


_read: dict[tuple[Path, int], SolvedScene] = {}
"""The file that was read last: a panel is drawn many times a second."""
