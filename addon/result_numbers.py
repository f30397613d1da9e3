"""What a job's report.json says, in lines for a panel; no Blender needed."""

import json
import math
from functools import lru_cache
from pathlib import Path
from typing import Any

from .job_folder import REPORT_NUMBERS, results_in

_LARGEST_BYTES = 10_000_000


def result_lines(job_folder: Path) -> tuple[str, ...]:
    """A few lines about the mesh and, where a truth was given, its error; () where there is no report."""
    path = results_in(job_folder) / REPORT_NUMBERS
    try:
        stat = path.stat()
    except OSError:
        return ()
    return _lines_of(path, stat.st_mtime_ns) if stat.st_size <= _LARGEST_BYTES else ()


@lru_cache(maxsize=8)
def _lines_of(path: Path, _mtime_ns: int) -> tuple[str, ...]:
    """Read once: a panel is drawn many times a second."""
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return ()
    lines = []
    num_faces = _number(report, "mesh", "num_faces")
    if num_faces is not None:
        lines.append(f"{num_faces:,.0f} triangles{_closed_words(report)}")
    measured, guessed = _number(report, "mesh", "measured_share"), _number(report, "mesh", "guessed_share")
    if measured is not None and guessed is not None:
        lines.append(f"{measured:.0%} measured, {guessed:.0%} guessed")
    for part, words in (("visible", "visible part"), ("whole", "whole")):
        chamfer = _number(report, "error", part, "chamfer_percent")
        if chamfer is not None:
            lines.append(f"Error of the {words}: {chamfer:.2f} % of the size")
    seconds = _number(report, "total_seconds")
    if seconds is not None:
        lines.append(f"Computed in {seconds:.0f} s")
    return tuple(lines)


def _closed_words(report: Any) -> str:
    """What to add to the triangles: whether the mesh is closed, or nothing where the report does not say."""
    mesh = report.get("mesh") if isinstance(report, dict) else None
    closed = mesh.get("watertight") if isinstance(mesh, dict) else None
    return {True: ", closed", False: ", open"}[closed] if isinstance(closed, bool) else ""


def _number(found: Any, *keys: str) -> float | None:
    """The finite number under the keys; None where there is none."""
    for key in keys:
        if not isinstance(found, dict):
            return None
        found = found.get(key)
    if isinstance(found, bool) or not isinstance(found, int | float):
        return None
    try:
        number = float(found)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None
