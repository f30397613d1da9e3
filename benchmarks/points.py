"""Surfaces from points alone beside screened Poisson; run by the backend's Python.

    python -m benchmarks.points --data ../shared/data --output DIR

The clouds of the shared data as they are, and 1024 points drawn from their true surfaces with noise. Poisson
(that of pycolmap) gets normals from neighbours, made consistent along a spanning tree, where none are given.
Leaves table.md and results.json, written anew after every fit; called again with the same folder it goes on,
and measures again only what depends on something that has changed.
"""

import argparse
import hashlib
import json
import logging
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
import PIL.Image  # noqa: F401 - must be loaded before pycolmap
import pycolmap
import torch
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from backend.benchmark.measuring import Measurement, measuring_fingerprint, runs_written
from backend.benchmark.record import write_record
from backend.benchmark.summary import Summary, aggregate, markdown
from backend.benchmark.writing import machine_facts
from backend.errors import ReconstructionError
from backend.machine import choose_device, set_up_torch
from backend.maths.metrics import TrueSurface, load_truth, surface_error
from backend.maths.nearest import nearest_tree
from backend.maths.neighbours import neighbour_planes
from backend.point_methods import PointMethod
from backend.provenance import versions
from backend.scene import SurfaceMesh, no_progress
from backend.stages.mesh.extraction import MeshConfig, vertex_normals
from backend.stages.points import point_network
from backend.stages.points.point_cloud import PointCloud, clean_cloud, read_cloud
from backend.stages.points.point_fit import PointFitConfig, fit_points
from backend.stages.points.point_mesh import mesh_of_points
from backend.stages.points.point_network import NetworkConfig
from backend.workspace import fingerprint

NAMES = ("anchor", "00011084", "00016513", "00994122")
NOISE_PERCENT = (0.0, 0.5, 2.5)
METHODS = ("poisson", *(method.value for method in PointMethod))
_SPARSE = 1024
_SAMPLES = 50_000
"""On either side: two equal surfaces differ by about 0.2 % of the diagonal then."""
_POISSON_DEPTH = 8
"""Its default, 13, is for clouds of millions of points."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Case:
    """A cloud and what it should become."""

    name: str
    cloud: PointCloud
    normals_known: bool
    truth: TrueSurface


def cases(data: Path, names: list[str]) -> list[Case]:
    """Each shape as it was scanned, then sparse with more and more noise."""
    made = []
    for name in names:
        if name == "anchor":
            cloud = read_cloud(data / "cloud_srb/scans/anchor.ply")
            truth = load_truth(data / "cloud_srb/gt_mesh/anchor.off")
            made.append(Case(name="anchor, its normals", cloud=cloud, normals_known=True, truth=truth))
        else:
            folder = data / "cloud_points2surf_abc"
            cloud = clean_cloud(np.load(folder / f"{name}_scan.npy")[:, :3].astype(np.float64), None)
            truth = load_truth(folder / f"{name}_gt.ply")
        made.append(Case(name=name, cloud=cloud, normals_known=False, truth=truth))
        for noise in NOISE_PERCENT:
            sparse = clean_cloud(_drawn(truth, noise), None)
            made.append(
                Case(name=f"{name}, 1024, {noise:g} %", cloud=sparse, normals_known=False, truth=truth)
            )
    return sorted(made, key=lambda case: len(case.cloud.positions))  # the quick ones first


def _drawn(truth: TrueSurface, noise_percent: float) -> np.ndarray:
    """Points drawn evenly from a surface, with Gaussian noise in percent of its diagonal."""
    rng = np.random.default_rng(0)
    shape = trimesh.Trimesh(truth.vertices, truth.faces, process=False)
    positions, _ = trimesh.sample.sample_surface(shape, _SPARSE, seed=rng)
    return np.asarray(positions + noise_percent / 100 * truth.diagonal * rng.normal(size=positions.shape))


def poisson(case: Case) -> SurfaceMesh:
    """Screened Poisson of pycolmap, not trimmed."""
    positions = case.cloud.positions
    normals = case.cloud.normals if case.normals_known else consistent_normals(positions)
    assert normals is not None
    fields = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    fields += [(name, "u1") for name in ("red", "green", "blue")]
    table = np.zeros(len(positions), fields)
    for name, column in zip(
        ("x", "y", "z", "nx", "ny", "nz"), np.hstack([positions, normals]).T, strict=True
    ):
        table[name] = column
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in fields]
    with tempfile.TemporaryDirectory() as folder:
        given, made = Path(folder) / "given.ply", Path(folder) / "made.ply"
        given.write_bytes("\n".join([*header, "end_header\n"]).encode() + table.tobytes())
        options = pycolmap.PoissonMeshingOptions(depth=_POISSON_DEPTH, trim=0.0, num_threads=1)
        pycolmap.poisson_meshing(given, made, options)
        loaded = trimesh.load(made, process=False)
    vertices, faces = np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces, np.int64)
    return SurfaceMesh(
        vertices=vertices,
        faces=faces,
        normals=vertex_normals(vertices, faces).astype(np.float32),
        colours_srgb=np.zeros((len(vertices), 3), np.uint8),
        support=np.zeros(len(vertices), np.float32),
    )


def consistent_normals(positions: np.ndarray) -> np.ndarray:
    """Planes of neighbours, turned alike along the spanning tree of least turning (Hoppe et al., 1992)."""
    normals = neighbour_planes(positions).normals.copy()
    count = len(positions)
    _, index = nearest_tree(positions).query(positions, k=20)
    start, end = np.repeat(np.arange(count), 19), index[:, 1:].ravel()
    cost = 1 - np.abs((normals[start] * normals[end]).sum(axis=1)) + 1e-4
    links = coo_array((cost, (start, end)), shape=(count, count)).tocsr()
    tree = minimum_spanning_tree(links.maximum(links.T))
    tree = tree + tree.T
    pieces, piece = connected_components(tree, directed=False)
    for number in range(pieces):
        members = np.flatnonzero(piece == number)
        top = members[positions[members, 2].argmax()]
        normals[top] *= 1 if normals[top, 2] >= 0 else -1
        order, parent = breadth_first_order(tree, top, directed=False)
        for at in order[1:]:
            if normals[at] @ normals[parent[at]] < 0:
                normals[at] *= -1
    return normals


def inputs_of(case: Case, method: str, steps: int) -> str:
    """Changes with the code, the cloud, the truth and, where it is a network's, the number of steps."""
    arrays = (case.cloud.positions, case.cloud.normals, case.truth.vertices, case.truth.faces)
    data = [
        hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
        for array in arrays
        if array is not None
    ]
    of_network = steps if method in point_network.METHODS else None
    return fingerprint(measuring_fingerprint(), Path(__file__), data, case.normals_known, method, of_network)


def measured(case: Case, method: str, steps: int) -> Measurement:
    """A method's seconds and error on a case, or why there are none."""
    done = partial(
        Measurement,
        case=case.name,
        preset=method,
        seed=0,
        versions=versions(),
        device="cpu",
        inputs=inputs_of(case, method, steps),
    )
    began_s = time.perf_counter()
    try:
        mesh = poisson(case) if method == "poisson" else _fitted(case, method, steps)
    except ReconstructionError as error:
        return done(numbers={}, failure=error.text)
    seconds = time.perf_counter() - began_s
    whole = surface_error(mesh, case.truth, cameras=None, seed=0, num_samples=_SAMPLES).whole
    closed = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).is_watertight
    numbers = {
        "seconds": round(seconds, 1),
        "chamfer_percent": whole.chamfer_percent,
        "f_score_at_one_percent": whole.f_score_at_one_percent,
        "normal_consistency": whole.normal_consistency,
        "closed": float(closed),
    }
    return done(numbers=numbers)


def _fitted(case: Case, method: str, steps: int) -> SurfaceMesh:
    config = PointFitConfig(
        method=PointMethod(method), normals_known=case.normals_known, network=NetworkConfig(steps=steps)
    )
    surface = fit_points(
        case.cloud,
        config,
        device=choose_device("cpu"),
        generator=torch.Generator().manual_seed(0),
        progress=no_progress,
    )
    return mesh_of_points(surface, case.cloud, MeshConfig(), progress=no_progress)


def table(summaries: Sequence[Summary]) -> str:
    """Markdown: Chamfer %, F@1% and seconds, a row for each case, a column for each method."""
    methods = [method for method in METHODS if any(s.preset == method for s in summaries)]
    by_place = {(summary.case, summary.preset): summary for summary in summaries}
    rows = []
    for case in dict.fromkeys(summary.case for summary in summaries):
        rows.append([case, *(_cell(by_place.get((case, method))) for method in methods)])
    return markdown(["cloud", *methods], rows)


def _cell(summary: Summary | None) -> str:
    if summary is None:
        return "-"
    if summary.failures:
        return "no surface"
    found = summary.median
    told = f"{found['chamfer_percent']:.3f}, {found['f_score_at_one_percent']:.3f}; {found['seconds']:.0f} s"
    return told + ("" if found["closed"] else ", open")


def main() -> int:
    """The exit code."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = words.add_argument
    add("--data", metavar="DIR", type=Path, required=True, help="the shared data")
    add("--output", metavar="DIR", type=Path, required=True)
    add("--clouds", nargs="+", choices=NAMES, default=list(NAMES))
    add("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    steps = NetworkConfig.steps
    add("--steps", type=int, metavar="N", default=steps, help=f"of the networks ({steps}, as fit-points)")
    add("--record", metavar="DIR", type=Path, help="where to leave points.json and points.md")
    parsed = words.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    set_up_torch(choose_device("cpu"))
    parsed.output.mkdir(parents=True, exist_ok=True)
    before = {run.inputs: run for run in runs_written(parsed.output) if run.failure is None}
    runs: list[Measurement] = []
    for case in cases(parsed.data, parsed.clouds):
        for method in parsed.methods:
            inputs = inputs_of(case, method, parsed.steps)
            runs.append(before.pop(inputs, None) or measured(case, method, parsed.steps))
            logger.info("%s, %s: %s", case.name, method, runs[-1].failure or runs[-1].numbers)
            written = {"runs": [asdict(run) for run in (*runs, *before.values())]}
            (parsed.output / "results.json").write_text(
                json.dumps(written, indent=2) + "\n", encoding="utf-8"
            )
            (parsed.output / "table.md").write_text(table(aggregate(runs)), encoding="utf-8")
    if parsed.record is not None:
        about = {"suite": "points", "steps": parsed.steps, "samples": _SAMPLES, "machine": machine_facts()}
        today = datetime.now(UTC).date().isoformat()
        write_record(parsed.record, about, runs, code=measuring_fingerprint(), date=today, shown=table)
    sys.stdout.write(table(aggregate(runs)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
