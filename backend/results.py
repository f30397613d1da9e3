"""What a run leaves in the output folder, and what it says of it in a few lines."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

from .errors import ErrorCode, ReconstructionError
from .maths.sampling import mean_colours
from .mesh_files import SPARSE, TEXTURE, png_of, write_glb, write_mesh, write_points, write_sparse
from .records import save_record
from .scene import Region, SolvedCameras
from .stages.cameras.camera_report import CameraReport, camera_report_html, camera_report_numbers
from .stages.cameras.nerfstudio import CAMERAS, transforms_json
from .stages.radiance import Radiance
from .stages.report import Report, render_report_html, report_numbers
from .workspace import LOG, Workspace

Writers = dict[str, Callable[[Path], object]]
"""How each result is written, by its name."""


RADIANCE = "radiance.npz"
"""A radiance field that was fitted, to render from: no pickle, arrays and JSON."""
_OF_WHOLE_RUNS = ("mesh.ply", TEXTURE, "mesh.glb", "points.ply", "report.json", "report.html", RADIANCE)
_CAMERA_PAGES = ("cameras_report.json", "cameras.html")


def write_all(
    report: Report, radiance: Radiance | None, workspace: Workspace, *, frame: str
) -> tuple[str, ...]:
    """Put all results in place; their names. `frame` is the fingerprint of the cameras.

    Pages about other cameras, which an earlier run left, are removed.
    """
    inputs = report.inputs
    texture_png = None if inputs.mesh.texture is None else png_of(inputs.mesh.texture)
    writers: Writers = {
        "mesh.ply": partial(write_mesh, mesh=inputs.mesh),
        "mesh.glb": partial(write_glb, mesh=inputs.mesh, texture_png=texture_png),
        "points.ply": partial(write_points, points=inputs.points, region=inputs.region),
        **_camera_writers(inputs.solved, inputs.region),
        "report.json": _text(_json(report_numbers(report))),
        "report.html": _text(render_report_html(report)),
    }
    if texture_png is not None:
        writers[TEXTURE] = partial(Path.write_bytes, data=texture_png)
    if radiance is not None:
        writers[RADIANCE] = partial(save_record, record=radiance, hint=Radiance)
    outdated = () if workspace.frame == frame else _CAMERA_PAGES
    workspace.write_results(writers, replaced=(RADIANCE, TEXTURE, *outdated), frame=frame)
    return (*writers, LOG)


def check_no_mesh_of_others(workspace: Workspace, frame: str) -> None:
    """ReconstructionError(OUTPUT_UNUSABLE) where cameras of their own would stand beside an earlier mesh.

    `frame` is the fingerprint of the cameras to come.
    """
    if workspace.frame == frame or not any((workspace.folder / name).exists() for name in _OF_WHOLE_RUNS):
        return
    raise ReconstructionError(
        ErrorCode.OUTPUT_UNUSABLE,
        f"{workspace.folder} holds a mesh of other cameras, photographs or settings; these would not fit it.",
        "Choose another output folder, or reconstruct into this one, which replaces the mesh as well.",
    )


def write_cameras(report: CameraReport, workspace: Workspace, *, frame: str) -> tuple[str, ...]:
    """Put in place what is known once the cameras are; the names. `frame` is their fingerprint."""
    writers: Writers = {
        **_camera_writers(report.solved, report.region),
        "cameras_report.json": _text(_json(camera_report_numbers(report))),
        "cameras.html": _text(camera_report_html(report)),
    }
    workspace.write_results(writers, frame=frame)
    return (*writers, LOG)


def summary(report: Report) -> tuple[str, ...]:
    """The result in a few lines."""
    mesh = report.mesh
    closed = "closed" if mesh.watertight else "open"
    lines = [
        f"{mesh.num_faces} triangles, {closed}; {mesh.measured_share:.0%} of the surface measured, "
        f"{mesh.guessed_share:.0%} guessed; {report.total_seconds:.0f} s of computing"
    ]
    if report.mean_psnr_db is not None:
        lines.append(f"PSNR against the photographs: {report.mean_psnr_db:.1f} dB")
    if report.error is not None:
        parts = {"the whole truth": report.error.whole, "its visible part": report.error.visible}
        lines += [
            f"Error against {name}: Chamfer {part.chamfer_percent:.3f} % of the diagonal, "
            f"F-score at 1 %: {part.f_score_at_one_percent:.3f}"
            for name, part in parts.items()
            if part is not None
        ]
    return tuple(lines)


def cameras_summary(report: CameraReport) -> tuple[str, ...]:
    """The cameras in a few lines, and what would make them better."""
    solved = report.solved
    placed, num_points = len(solved.views), len(solved.sparse_positions)
    total = placed + len(solved.unplaced)
    lines = [f"{placed} of {total} photographs have a camera; they share {num_points} points"]
    if solved.reprojection_error_px is not None:
        lines.append(f"Error of the estimated cameras: {solved.reprojection_error_px:.2f} pixels on average")
    return (*lines, *report.remarks)


def _camera_writers(solved: SolvedCameras, region: Region) -> Writers:
    positions, visibility = solved.sparse_positions, solved.sparse_visibility
    colours = mean_colours(solved.views, positions, visibility)
    return {
        CAMERAS: _text(_json(transforms_json(solved, region))),
        SPARSE: partial(write_sparse, positions=positions, colours_srgb=colours, visibility=visibility),
    }


def _json(content: dict[str, object]) -> str:
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def _text(content: str) -> Callable[[Path], object]:
    # the names of files need not be valid text
    return lambda path: path.write_text(content, encoding="utf-8", errors="backslashreplace")
