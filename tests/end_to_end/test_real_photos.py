"""Real photographs through the whole command line, with the quickest preset.

The bounds are what a run of today reaches, with room for another machine's rounding; a change that
breaks one has made results worse. What a good result is stands in docs/benchmarks.md.
"""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from backend.mesh_files import read_mesh
from backend.scene import SurfaceMesh
from backend.wire.client import clean_environment

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT / ".." / "shared" / "data"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not DATA.is_dir(), reason="the photographs of ../shared/data are not here"),
]


@dataclass(frozen=True, kw_only=True)
class Result:
    report: dict[str, Any]
    mesh: SurfaceMesh
    cameras: dict[str, Any]


def reconstructed(output: Path, *arguments: Path | str) -> Result:
    """With the preset `fast`, on the CPU."""
    command = [sys.executable, "-m", "backend", "reconstruct", *map(str, arguments)]
    command += ["--output", str(output), "--preset", "fast", "--device", "cpu"]
    environment = clean_environment(os.environ)
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=400, check=False
    )
    assert done.returncode == 0, done.stderr
    report, cameras = (json.loads((output / name).read_text()) for name in ("report.json", "cameras.json"))
    return Result(report=report, cameras=cameras, mesh=read_mesh(output / "mesh.ply"))


def least(result: Result, what: str) -> float:
    """Over all photographs."""
    return float(min(photo[what] for photo in result.report["photos"]))


# a statuette, known cameras, masks


@pytest.fixture(scope="module")
def statuette(tmp_path_factory: pytest.TempPathFactory) -> Result:
    folder = DATA / "photos_dtu_scan118_3view"
    options: list[Path | str] = ["--masks", folder / "mask", "--cameras", folder / "transforms.json"]
    return reconstructed(tmp_path_factory.mktemp("dtu") / "out", folder / "image", *options)


def test_the_statuette_fills_its_masks(statuette: Result) -> None:
    assert least(statuette, "silhouette_overlap") > 0.95


def test_the_statuette_looks_like_its_photographs(statuette: Result) -> None:
    assert least(statuette, "psnr_db") > 24
    # each stands for four pixels: `fast` compares photographs at half their size
    assert 4 * statuette.report["num_stereo_points"] > 240_000


def test_the_statuette_is_closed_and_of_its_size(statuette: Result) -> None:
    """In the cameras' frame: millimetres, and where all three axes meet."""
    solid = trimesh.Trimesh(statuette.mesh.vertices, statuette.mesh.faces, process=False)
    assert solid.is_watertight
    assert 10_000 < len(statuette.mesh.faces) <= 100_000
    assert 250 < solid.extents.max() < 450
    assert statuette.report["mesh"]["measured_share"] > 0.3
    largest = max(solid.split(only_watertight=False), key=lambda piece: float(piece.area))
    assert largest.area > 0.97 * solid.area


# a fountain, cameras unknown, no masks


@pytest.fixture(scope="module")
def fountain(tmp_path_factory: pytest.TempPathFactory) -> Result:
    photos = [DATA / "photos_fountain_p11" / "images" / f"000{number}.jpg" for number in (3, 4, 5)]
    return reconstructed(tmp_path_factory.mktemp("fountain") / "out", *photos)


def test_the_fountain_covers_its_photographs(fountain: Result) -> None:
    assert least(fountain, "covered_share") > 0.65
    assert least(fountain, "psnr_db") > 22


def test_the_fountain_is_a_piece_of_a_larger_scene(fountain: Result) -> None:
    choices = {entry["what"]: entry["choice"] for entry in fountain.report["decisions"]}
    assert choices["back side"] == "cut off"
    assert fountain.report["mesh"]["watertight"] is False
    assert 10_000 < len(fountain.mesh.faces) <= 100_000
    assert fountain.report["mesh"]["measured_share"] > 0.5


def test_the_fountain_s_cameras_are_the_surveyed_ones(fountain: Result) -> None:
    """Angles between pairs of photographs: they do not depend on the frame."""
    assert fountain.report["cameras"]["num_placed"] == 3
    surveyed = json.loads((DATA / "photos_fountain_p11" / "transforms.json").read_text())
    true_rotation, rotation = rotations(surveyed), rotations(fountain.cameras)
    for first, second in (("0003.jpg", "0004.jpg"), ("0004.jpg", "0005.jpg")):
        found = rotation[first].T @ rotation[second]
        truth = true_rotation[first].T @ true_rotation[second]
        cosine = (np.trace(found.T @ truth) - 1) / 2
        assert np.rad2deg(np.arccos(np.clip(cosine, -1, 1))) < 0.1


def rotations(transforms: dict[str, Any]) -> dict[str, np.ndarray]:
    """Camera to world, by file name."""
    return {
        Path(frame["file_path"]).name: np.array(frame["transform_matrix"])[:3, :3]
        for frame in transforms["frames"]
    }


# a walnut, known cameras, dark and grey, no masks, with a reference


@pytest.fixture(scope="module")
def walnut(tmp_path_factory: pytest.TempPathFactory) -> Result:
    folder = DATA / "photos_robovision_1"
    photos = [folder / "images" / f"image_camera0{number}.png" for number in range(1, 7)]
    output = tmp_path_factory.mktemp("walnut") / "out"
    return reconstructed(output, *photos, "--cameras", folder / "transforms.json")


@pytest.fixture(scope="module")
def reference() -> np.ndarray:
    """A dense cloud from all twelve photographs, cleaned by hand, metres."""
    cloud = trimesh.load(DATA / "photos_robovision_1" / "reference.ply")
    assert isinstance(cloud, trimesh.PointCloud)
    return np.asarray(cloud.vertices)


def test_the_walnut_s_measured_surface_is_near_the_reference(walnut: Result, reference: np.ndarray) -> None:
    """In percent of the reference's diagonal; its points are 0.2 % apart."""
    diagonal = np.linalg.norm(np.ptp(reference, axis=0))
    sure = walnut.mesh.vertices[walnut.mesh.support > 0.7]
    apart = 100 * cKDTree(reference).query(sure)[0] / diagonal
    assert len(sure) > 0.2 * len(walnut.mesh.vertices)
    assert np.median(apart) < 0.5
    assert np.quantile(apart, 0.75) < 1.2


def test_half_of_the_walnut_is_there(walnut: Result, reference: np.ndarray) -> None:
    """Six cameras stand on one half of the ring."""
    diagonal = np.linalg.norm(np.ptp(reference, axis=0))
    samples, _ = trimesh.sample.sample_surface(
        trimesh.Trimesh(walnut.mesh.vertices, walnut.mesh.faces, process=False), 100_000, seed=0
    )
    apart = 100 * cKDTree(samples).query(reference)[0] / diagonal
    assert (apart < 1.5).mean() > 0.5
    assert least(walnut, "psnr_db") > 28
