"""The body on a textured ground, without masks: the whole program with the ground left out."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from backend.mesh_files import read_mesh
from backend.wire.client import clean_environment
from tests.synthetic_scene import GROUND_Z, SIZE, camera_at, photographed, write_scene

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]


def test_the_subject_is_alone_and_closed(tmp_path: Path) -> None:
    cameras = [camera_at(azimuth, 2.5, 400) for azimuth in (-45.0, -15.0, 15.0, 45.0)]
    place = tmp_path / "body"
    write_scene(photographed(cameras, ground=True, wall=True).without_masks(), place)
    command = [sys.executable, "-m", "backend", "reconstruct", str(place / "images"), "--without-ground"]
    command += ["--cameras", str(place / "images" / "transforms.json"), "--truth", str(place / "truth.ply")]
    command += ["--output", str(place / "result"), "--preset", "fast", "--device", "cpu"]
    environment = {**clean_environment(os.environ), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        command, cwd=ROOT, env=environment, timeout=300, check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    report = json.loads((place / "result" / "report.json").read_text())
    (ground,) = [decision for decision in report["decisions"] if decision["what"] == "ground"]
    assert ground["choice"] == "left out"
    mesh = read_mesh(place / "result" / "mesh.ply")
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.is_watertight
    assert solid.body_count == 1
    assert mesh.vertices[:, 2].min() > GROUND_Z - 0.05 * SIZE
    assert np.linalg.norm(solid.extents) < 1.15 * report["error"]["truth_diagonal_world"]
    assert report["error"]["visible"]["chamfer_percent"] < 1.0
    assert report["error"]["visible"]["f_score_at_one_percent"] > 0.8
