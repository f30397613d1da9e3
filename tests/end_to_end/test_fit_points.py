"""The command `fit-points` as a process: its words, its exit code and its files."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh

from backend.mesh_files import read_mesh
from backend.point_methods import PointMethod
from backend.stages.points.point_network import METHODS
from backend.wire.protocol import Failed, Finished, Hello, Stage, decode
from backend.workspace import open_workspace

ROOT = Path(__file__).resolve().parents[2]


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "backend", "fit-points", *map(str, arguments)]


def finished(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(*arguments), capture_output=True, text=True, timeout=300, cwd=ROOT, check=False
    )


@pytest.fixture
def cloud(tmp_path: Path) -> Path:
    """Of a sphere, with two that are no numbers."""
    points = np.random.default_rng(0).normal(size=(400, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    path = tmp_path / "cloud.xyz"
    np.savetxt(path, [[np.nan] * 3, *points, [0, np.inf, 0]])
    return path


@pytest.mark.slow
def test_a_cloud_becomes_a_mesh_with_its_numbers(cloud: Path, tmp_path: Path) -> None:
    truth, output = tmp_path / "truth.ply", tmp_path / "out"
    trimesh.creation.icosphere(subdivisions=4).export(truth)
    run = finished(cloud, "--output", output, "--truth", truth)
    assert run.returncode == 0, run.stderr
    assert {path.name for path in output.iterdir()} == {".fewview", "mesh.ply", "report.json"}
    assert str(output / "mesh.ply") in run.stdout
    report = json.loads((output / "report.json").read_text())
    assert report["mesh"]["watertight"]
    assert report["mesh"]["num_faces"] == len(read_mesh(output / "mesh.ply").faces)
    assert report["error"]["whole"]["chamfer_percent"] < 0.5
    assert 0 < report["total_seconds"] < 100
    assert report["num_points"] == 400
    told = {decision["what"]: decision["choice"] for decision in report["decisions"]}
    assert told["points that are not finite"] == "2 of 402 left out"
    assert told["the sides' network"] == "300 steps"
    refused = finished(cloud, "--output", tmp_path)
    assert refused.returncode == 2
    assert "FewView did not make" in refused.stderr


@pytest.mark.slow
def test_on_the_wire_it_says_its_stages_and_ends_once(cloud: Path, tmp_path: Path) -> None:
    process = subprocess.Popen(
        command(cloud, "--output", tmp_path / "out", "--wire"),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        cwd=ROOT,
    )
    with process:
        assert process.stdout is not None
        said = [decode(line) for line in process.stdout]
    assert process.returncode == 0
    assert isinstance(said[0], Hello)
    assert [m.name for m in said if isinstance(m, Stage)] == ["points", "surface", "mesh"]
    assert isinstance(said[-1], Finished)
    assert said[-1].files == ("mesh.ply", "report.json")
    assert not any(isinstance(m, Failed) for m in said)


def test_a_cloud_without_points_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "cloud.xyz"
    path.write_text("nan nan nan\n" * 100)
    run = finished(path, "--output", tmp_path / "out")
    assert run.returncode == 2
    assert "0 different points" in run.stderr
    assert not (tmp_path / "out").exists()


def test_a_reconstruction_is_not_replaced(cloud: Path, tmp_path: Path) -> None:
    with open_workspace(tmp_path / "out") as workspace:
        workspace.claim("photographs", ["1"])
        workspace.write_results({"mesh.ply": lambda path: path.write_text("a mesh")})
    run = finished(cloud, "--output", tmp_path / "out")
    assert run.returncode == 2
    assert "a reconstruction from photographs" in run.stderr
    assert (tmp_path / "out/mesh.ply").read_text() == "a mesh"


@pytest.mark.slow
def test_a_truth_of_another_scale_is_told_in_seconds(cloud: Path, tmp_path: Path) -> None:
    """As one in millimetres: all points of a sphere are equally far from its middle; none is found soon."""
    truth = trimesh.creation.icosphere(subdivisions=4)
    truth.apply_scale(1000)
    truth.export(tmp_path / "truth.ply")
    run = finished(cloud, "--output", tmp_path / "out", "--truth", tmp_path / "truth.ply")
    assert run.returncode == 0, run.stderr
    assert "Warning: The true surface is 1e+03 times as large as the mesh" in run.stderr


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize("asked", [signal.SIGINT, signal.SIGTERM])
def test_stopped_it_leaves_nothing(cloud: Path, tmp_path: Path, asked: signal.Signals) -> None:
    with subprocess.Popen(
        command(cloud, "--output", tmp_path / "out", "--method", "nap"), stderr=subprocess.PIPE, cwd=ROOT
    ) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if b"points done" in line:
                break
        time.sleep(1)
        process.send_signal(asked)
        process.stderr.read()
    assert process.returncode == 130
    assert not (tmp_path / "out").exists()


def test_the_methods_offered_are_those_there_are() -> None:
    """Each is the grid's or has a network."""
    assert set(PointMethod) == {PointMethod.LINEAR, *METHODS}
