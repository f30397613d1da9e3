"""What a run leaves in the output folder, and what it says of it in a few lines."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

from .maths.sampling import mean_colours
from .mesh_files import write_glb, write_mesh, write_points, write_sparse
from .records import save_record
from .scene import Region, SolvedCameras
from .stages.nerfstudio import transforms_json
from .stages.radiance_field import Radiance
from .stages.report import Report, render_report_html, report_numbers
from .workspace import LOG, Workspace

Writers = dict[str, Callable[[Path], object]]
"""How each result is written, by its name."""


RADIANCE = "radiance.npz"
"""A radiance field that was fitted, to render from: no pickle, arrays and JSON."""


def write_all(report: Report, radiance: Radiance | None, workspace: Workspace) -> tuple[str, ...]:
    """Put all results in place; their names."""
    inputs = report.inputs
    writers: Writers = {
        "mesh.ply": partial(write_mesh, mesh=inputs.mesh),
        "mesh.glb": partial(write_glb, mesh=inputs.mesh),
        "points.ply": partial(write_points, points=inputs.points, region=inputs.region),
        **_camera_writers(inputs.solved, inputs.region),
        "report.json": _text(_json(report_numbers(report))),
        "report.html": _text(render_report_html(report)),
    }
    if radiance is not None:
        writers[RADIANCE] = partial(save_record, record=radiance, hint=Radiance)
    workspace.write_results(writers, replaced=(RADIANCE,))
    return (*writers, LOG)


def write_cameras(solved: SolvedCameras, region: Region, workspace: Workspace) -> tuple[str, ...]:
    """Put in place what is known once the cameras are; the names."""
    writers = _camera_writers(solved, region)
    workspace.write_results(writers)
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


def cameras_summary(solved: SolvedCameras) -> tuple[str, ...]:
    """The cameras in a line."""
    placed, num_points = len(solved.views), len(solved.sparse_positions)
    total = placed + len(solved.unplaced)
    lines = [f"{placed} of {total} photographs have a camera; they share {num_points} points"]
    if solved.reprojection_error_px is not None:
        lines.append(f"Error of the estimated cameras: {solved.reprojection_error_px:.2f} pixels on average")
    return tuple(lines)


def _camera_writers(solved: SolvedCameras, region: Region) -> Writers:
    colours = mean_colours(solved.views, solved.sparse_positions, solved.sparse_visibility)
    return {
        "cameras.json": _text(_json(transforms_json(solved, region))),
        "sparse.ply": partial(write_sparse, positions=solved.sparse_positions, colours_srgb=colours),
    }


def _json(content: dict[str, object]) -> str:
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def _text(content: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(content, encoding="utf-8")
