"""A rehearsal's files against the real ones: the same dialects, written twice."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from backend.commands import rehearsed_files
from backend.mesh_files import read_mesh, read_sparse, write_mesh, write_sparse
from backend.scene import no_progress
from backend.stages.cameras.nerfstudio import read_frames, world_from_camera
from backend.stages.report import ReportConfig, build_report, mesh_facts, report_numbers
from tests.report_scene import finished_run


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, write in rehearsed_files.RESULTS.items():
        write(tmp_path / name)
    return tmp_path


def test_the_mesh_is_to_the_byte_what_a_run_would_write(folder: Path) -> None:
    mesh = read_mesh(folder / "mesh.ply")
    write_mesh(folder / "again.ply", mesh)
    assert (folder / "again.ply").read_bytes() == (folder / "mesh.ply").read_bytes()
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.is_watertight
    assert solid.volume == pytest.approx(8 / 3)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, rtol=1e-6)
    assert (mesh.normals * mesh.vertices).sum(axis=1).min() > 0


def test_sparse_points_too(folder: Path) -> None:
    mesh = read_mesh(folder / "mesh.ply")
    positions, visibility = read_sparse(folder / "sparse.ply", num_photos=3)
    assert visibility.shape == (4, 3)
    assert visibility.all()
    what = {"positions": positions, "colours_srgb": mesh.colours_srgb, "visibility": visibility}
    write_sparse(folder / "again.ply", **what)
    assert (folder / "again.ply").read_bytes() == (folder / "sparse.ply").read_bytes()


def test_cameras_look_at_the_origin_from_five_away(folder: Path) -> None:
    frames = read_frames(folder / "cameras.json")
    assert len(frames) == 3
    for frame in frames:
        pose = np.linalg.inv(world_from_camera(frame, "a.png"))
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
        np.testing.assert_allclose(pose[:3, 3], [0, 0, 5], atol=1e-12)
        assert pose[1, 2] < 0, "z is up, and rows grow downwards"
    assert {"estimated", "reprojection_error_px", "region", "unplaced"} == frames[0]["fewview"].keys()


def test_the_numbers_have_the_keys_of_a_run_s_and_are_true(folder: Path) -> None:
    numbers = json.loads((folder / "report.json").read_text())
    run = finished_run(num_photos=1, wobble=0.0, masked=True, width=60, resolution=1)
    config = ReportConfig(num_photos_shown=1, num_turntable=1, picture_px=30)
    real: dict[str, Any] = report_numbers(build_report(run, config, progress=no_progress))
    assert set(real) - set(numbers) == {"versions", "settings"}
    for key in ("mesh", "cameras", "region"):
        assert numbers[key].keys() == real[key].keys()
    facts = dataclasses.asdict(mesh_facts(read_mesh(folder / "mesh.ply")))
    for key, value in numbers["mesh"].items():
        assert value == pytest.approx(facts[key]) if key != "watertight" else value is facts[key]
