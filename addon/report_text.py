"""What a developer needs to know about a job, as text."""

import platform
from pathlib import Path

import bpy

from . import jobs

_MOST_LOG_BYTES = 200_000


def report_text(context: bpy.types.Context) -> str:
    """Versions, how the last job ended, and its logs."""
    lines = [
        f"Blender {bpy.app.version_string} on {platform.platform()}, Python {platform.python_version()}",
        f"FewView in {__package__}, Blender in the background: {bpy.app.background}",
    ]
    end = jobs.ended()
    if end is not None:
        lines.append(
            f"{end.title}: {'finished' if end.failure is None else end.failure.code}, {end.seconds:.1f} s"
        )
        lines += [f"{check.name}: {check.found}" for check in end.checks]
        lines += [f"Warning: {text}" for text in end.warnings]
        if end.failure is not None:
            lines += [end.failure.text, end.failure.remedy]
    path = jobs.log_path()
    for log in (path, path.parent / "result" / "log.txt") if path is not None else ():
        lines += ["", f"--- {log.name}", _end_of(log)]
    return "\n".join(lines) + "\n"


def _end_of(path: Path) -> str:
    try:
        with path.open("rb") as file:
            file.seek(max(path.stat().st_size - _MOST_LOG_BYTES, 0))
            return file.read().decode("utf-8", "replace")
    except OSError as error:
        return f"(not readable: {error.strerror or error})"
