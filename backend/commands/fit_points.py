"""The command that makes a surface from points alone, for a terminal or for a program on the wire."""

import argparse
import json
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..loading import packages_that_stay
from ..point_methods import PointMethod
from ..wire import protocol
from .argument_types import seed
from .cancelling import catch_signals
from .reconstruct import converse_or_show

if TYPE_CHECKING:
    from ..maths.metrics import ErrorAgainstTruth, TrueSurface
    from ..pipeline import Listener, Outcome
    from ..scene import SurfaceMesh
    from ..workspace import Workspace

_STAGES = ("points", "surface", "mesh")


def add_fit_points(parser: argparse.ArgumentParser) -> None:
    """The command's words."""
    add = parser.add_argument
    add("cloud", metavar="CLOUD", type=Path, help="PLY, or text with the columns x y z [nx ny nz]")
    add(
        "--output",
        metavar="DIR",
        type=Path,
        required=True,
        help="new or empty folder, or of an earlier fit",
    )
    add("--normals-known", action="store_true", help="the file's normals point outwards: meet them")
    methods = [method.value for method in PointMethod]
    add("--method", choices=methods, default=methods[0], help=f"how the field is found ({methods[0]})")
    add("--truth", metavar="MESH", type=Path, help="true mesh to measure the result against")
    add("--device", choices=protocol.DEVICES, default="auto", help="where to compute (auto)")
    add("--seed", type=seed, metavar="N", default=0, help="random seed (0)")
    add("--wire", action="store_true", help="for programs: messages on stdout")


def fit_points_command(parsed: argparse.Namespace) -> int:
    """Fit and leave mesh.ply and report.json; the exit code."""
    cancelled = protocol.Failed(
        code=protocol.CANCELLED, text="The fit was stopped; nothing was written.", remedy="Start it again."
    )
    return converse_or_show(
        lambda listener: _fit(parsed, listener), parsed.output, wire=parsed.wire, cancelled=cancelled
    )


def _fit(parsed: argparse.Namespace, listener: "Listener") -> "Outcome":
    """Raises ReconstructionError for what the user can mend, and Cancelled; then nothing is written."""
    with packages_that_stay():
        from .. import pipeline  # noqa: F401 - with pycolmap; torch may be missing, and --help must still work
        from ..maths.metrics import load_truth
    from ..workspace import open_workspace

    catch_signals()
    truth = None if parsed.truth is None else load_truth(parsed.truth)
    with open_workspace(parsed.output) as workspace:
        try:
            workspace.claim("points")
            return _fit_into(workspace, parsed, listener, truth)
        finally:
            workspace.discard_if_nothing_done()


def _fit_into(
    workspace: "Workspace", parsed: argparse.Namespace, listener: "Listener", truth: "TrueSurface | None"
) -> "Outcome":
    import torch

    from ..machine import choose_device, set_up_torch
    from ..maths.metrics import elsewhere_text, samples_worth_it, surface_error
    from ..mesh_files import write_mesh
    from ..pipeline import Outcome
    from ..stages.mesh.extraction import MeshConfig
    from ..stages.points.point_cloud import read_cloud
    from ..stages.points.point_fit import PointFitConfig, fit_points
    from ..stages.points.point_mesh import mesh_of_points
    from ..stages.report import ReportConfig

    device = choose_device(parsed.device, listener.warned)
    set_up_torch(device)
    began_s = time.perf_counter()
    stages = _Stages(listener)
    stages.next()
    cloud = read_cloud(parsed.cloud)
    for decision in cloud.decisions:
        listener.warned(f"{decision.what}: {decision.choice}")
    stages.next()
    config = PointFitConfig(method=PointMethod(parsed.method), normals_known=parsed.normals_known)
    generator = torch.Generator().manual_seed(parsed.seed)
    surface = fit_points(cloud, config, device=device, generator=generator, progress=listener.progressed)
    stages.next()
    mesh = mesh_of_points(surface, cloud, MeshConfig(), progress=listener.progressed)
    seconds = time.perf_counter() - began_s
    error = None
    if truth is not None:
        if text := elsewhere_text(mesh, truth):
            listener.warned(text)
        listener.progressed(0.9, "comparing with the truth")
        num_samples = samples_worth_it(mesh, truth, ReportConfig().error_samples)
        error = surface_error(mesh, truth, cameras=None, seed=parsed.seed, num_samples=num_samples)
    stages.end()
    report = _report(parsed, len(cloud.positions), mesh, seconds, error)
    text = json.dumps(report, indent=2) + "\n"
    workspace.write_results(
        {
            "mesh.ply": partial(write_mesh, mesh=mesh),
            "report.json": lambda path: path.write_text(text, encoding="utf-8"),
        }
    )
    return Outcome(files=("mesh.ply", "report.json"), summary=_summary(report, error))


class _Stages:
    """Tells the listener of the stages, one after the other."""

    def __init__(self, listener: "Listener") -> None:
        self._listener = listener
        self._index = 0
        self._began_s = time.perf_counter()

    def next(self) -> None:
        """End the stage that runs and begin the next."""
        self.end()
        self._began_s = time.perf_counter()
        self._listener.stage_started(_STAGES[self._index], self._index + 1, len(_STAGES))
        self._index += 1

    def end(self) -> None:
        """End the stage that runs, if one does."""
        from ..workspace import StageCost

        if self._index:
            seconds = time.perf_counter() - self._began_s
            self._listener.stage_finished(StageCost(seconds=seconds, peak_memory_bytes=None))


def _report(
    parsed: argparse.Namespace,
    num_points: int,
    mesh: "SurfaceMesh",
    seconds: float,
    error: "ErrorAgainstTruth | None",
) -> dict[str, Any]:
    """The numbers for report.json, where a reconstruction has them; the unit is the last word of a key."""
    import trimesh

    from ..stages.report import error_numbers

    closed = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).is_watertight
    return {
        "method": parsed.method,
        "normals_known": parsed.normals_known,
        "num_points": num_points,
        "mesh": {"num_faces": len(mesh.faces), "watertight": bool(closed)},
        "total_seconds": round(seconds, 2),
        "decisions": [{"what": d.what, "choice": d.choice, "because": d.because} for d in mesh.decisions],
        "error": None if error is None else error_numbers(error),
    }


def _summary(report: dict[str, Any], error: "ErrorAgainstTruth | None") -> tuple[str, ...]:
    mesh = report["mesh"]
    closed = "closed" if mesh["watertight"] else "open"
    told = f"{mesh['num_faces']} triangles, {closed}; {report['num_points']} points"
    lines = [f"{told}; {report['total_seconds']} s"]
    if error is not None:
        lines.append(
            f"Error against the truth: Chamfer {error.whole.chamfer_percent:.3f} % of the diagonal, "
            f"F-score at 1 %: {error.whole.f_score_at_one_percent:.3f}"
        )
    return tuple(lines)
