"""Errors of surfaces whose distance is known, laws of the measures, and the independent yardstick."""

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from backend.errors import ErrorCode, ReconstructionError
from backend.maths.metrics import (
    TrueSurface,
    elsewhere_text,
    load_truth,
    psnr,
    surface_error,
    vertex_error_percent,
)
from backend.scene import Camera, SurfaceMesh

YARDSTICK = Path(__file__).resolve().parents[2] / ".." / "shared" / "tools" / "mesh_error.py"


@pytest.mark.parametrize(
    ("scale", "shift", "told"),
    [
        (1.0, 0.0, ""),
        (1.4, 0.3, ""),
        (1000.0, 0.0, "1e+03 times as large"),
        (0.5, 0.0, "0.5 times as large"),
        (1.0, 5.0, "1.4 of its diagonals beside"),
    ],
)
def test_a_truth_of_another_scale_or_place_is_told(scale: float, shift: float, told: str) -> None:
    vertices = scale * ball(1.0, 3).vertices + [shift, 0, 0]
    text = elsewhere_text(ball(1.0, 3), TrueSurface(vertices=vertices, faces=None))
    assert told in text
    assert bool(text) == bool(told)


def surface_mesh(vertices: np.ndarray, faces: np.ndarray) -> SurfaceMesh:
    return SurfaceMesh(
        vertices=np.asarray(vertices, np.float64),
        faces=np.asarray(faces, np.int64),
        normals=np.zeros((len(vertices), 3), np.float32),
        colours_srgb=np.zeros((len(vertices), 3), np.uint8),
        support=np.ones(len(vertices), np.float32),
    )


def ball(radius: float = 1.0, subdivisions: int = 5) -> SurfaceMesh:
    sphere = trimesh.creation.icosphere(subdivisions, radius)
    return surface_mesh(sphere.vertices, sphere.faces)


def truth_of(mesh: SurfaceMesh) -> TrueSurface:
    return TrueSurface(vertices=mesh.vertices, faces=mesh.faces)


def camera_before(distance: float, *, focal_px: float = 100.0) -> Camera:
    """At (0, -distance, 0), looking along +y, its image's right along +x."""
    camera_from_world = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, distance], [0, 0, 0, 1]])
    return Camera(
        camera_from_world=camera_from_world,
        fx_px=focal_px,
        fy_px=focal_px,
        cx_px=50.0,
        cy_px=50.0,
        width=100,
        height=100,
    )


def nearest_one_by_one(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    return np.array([min(np.linalg.norm(point - other) for other in others) for point in points])


def test_concentric_spheres_are_apart_by_the_difference_of_their_radii() -> None:
    """Analytic: every nearest distance is 0.1, the diagonal of the truth 2 sqrt 3."""
    found = surface_error(ball(1.1), truth_of(ball(1.0)), cameras=None, seed=0, num_samples=40_000)
    apart = 100 * 0.1 / (2 * np.sqrt(3))
    assert found.truth_diagonal_world == pytest.approx(2 * np.sqrt(3), rel=1e-3)
    assert found.whole.accuracy_percent == pytest.approx(apart, rel=0.03)
    assert found.whole.completeness_percent == pytest.approx(apart, rel=0.03)
    assert found.whole.chamfer_percent == pytest.approx(apart, rel=0.03)
    assert found.whole.normal_consistency == pytest.approx(1.0, abs=2e-3)
    assert (found.whole.f_score_at_half_percent, found.whole.f_score_at_one_percent) == (0.0, 0.0)
    assert found.visible is None


@pytest.mark.parametrize(
    ("off_percent", "at_half", "at_one"),
    [(0.36, 1.0, 1.0), (0.52, 0.0, 1.0), (0.94, 0.0, 1.0), (1.02, 0.0, 0.0)],
)
def test_thresholds_of_the_f_scores(off_percent: float, at_half: float, at_one: float) -> None:
    """Concentric spheres so many percent of the diagonal apart; sampling adds up to 0.05 to that."""
    mesh = ball(1.0 + off_percent / 100 * 2 * np.sqrt(3))
    found = surface_error(mesh, truth_of(ball()), cameras=None, seed=0, num_samples=100_000).whole
    assert found.f_score_at_half_percent == pytest.approx(at_half, abs=0.05)
    assert found.f_score_at_one_percent == pytest.approx(at_one, abs=0.05)


def test_a_surface_in_excess_is_inaccurate_and_a_missing_one_is_incomplete() -> None:
    """Law: mesh and truth exchanged, accuracy and completeness exchange (up to the diagonal)."""
    one, other = ball(subdivisions=3), ball(0.5, subdivisions=3)
    far = np.concatenate([one.vertices, other.vertices + np.array([3.0, 0, 0])])
    both = surface_mesh(far, np.concatenate([one.faces, other.faces + len(one.vertices)]))
    excess = surface_error(both, truth_of(one), cameras=None, seed=0, num_samples=60_000)
    missing = surface_error(one, truth_of(both), cameras=None, seed=0, num_samples=60_000)
    ratio = missing.truth_diagonal_world / excess.truth_diagonal_world
    assert excess.whole.accuracy_percent > 5 * excess.whole.completeness_percent
    assert missing.whole.completeness_percent * ratio == pytest.approx(
        excess.whole.accuracy_percent, rel=0.05
    )
    # A fifth of the area of `both` is the small ball's: precision 0.8, recall 1.
    assert excess.whole.f_score_at_one_percent == pytest.approx(2 * 0.8 / 1.8, abs=0.01)


def test_the_frame_and_the_unit_do_not_matter() -> None:
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 0, 1])[:3, :3] * 250.0
    mesh, truth = ball(1.05, subdivisions=3), ball(subdivisions=3)
    here = surface_error(mesh, truth_of(truth), cameras=None, seed=3, num_samples=5_000)
    there = surface_error(
        surface_mesh(mesh.vertices @ turn.T + 77.0, mesh.faces),
        TrueSurface(vertices=truth.vertices @ turn.T + 77.0, faces=truth.faces),
        cameras=None,
        seed=3,
        num_samples=5_000,
    )
    assert there.whole.accuracy_percent == pytest.approx(here.whole.accuracy_percent, rel=1e-6)
    assert there.whole.normal_consistency == pytest.approx(here.whole.normal_consistency, abs=1e-9)


def test_the_same_seed_gives_the_same_numbers_and_another_seed_others() -> None:
    mesh, truth = ball(1.05, subdivisions=2), truth_of(ball(subdivisions=2))
    first, again, other = (
        surface_error(mesh, truth, cameras=None, seed=seed, num_samples=1_000) for seed in (5, 5, 6)
    )
    assert first == again
    assert first != other


def test_a_surface_against_itself_is_not_measured_with_its_own_samples() -> None:
    """Both sides are drawn independently, so half a spacing is left instead of a flattering zero."""
    itself = surface_error(ball(), truth_of(ball()), cameras=None, seed=0, num_samples=10_000).whole
    half_spacing = 0.5 * np.sqrt(4 * np.pi / 10_000) / (2 * np.sqrt(3)) * 100
    assert itself.chamfer_percent == pytest.approx(half_spacing, rel=0.05)


def test_only_what_a_camera_sees_counts_as_visible() -> None:
    """A ball dented at its back is right where a camera looks; its cap is (1 - 1 / D) / 2."""
    round_ball, distance = ball(), 4.0
    back = round_ball.vertices[:, 1] > 0.3
    dented = replace(round_ball, vertices=np.where(back[:, None], [1.0, 0.3, 1.0], 1.0) * round_ball.vertices)
    found = surface_error(
        dented, truth_of(round_ball), cameras=[camera_before(distance)], seed=0, num_samples=40_000
    )
    assert found.visible is not None
    assert found.visible_share_of_truth is not None
    # 0.05 is taken from the cosine at the rim, which costs up to 0.02 of the sphere.
    assert (1 - 1 / distance) / 2 - 0.025 < found.visible_share_of_truth < (1 - 1 / distance) / 2
    assert found.whole.chamfer_percent > 2.5
    assert found.visible.chamfer_percent < 0.4
    behind = replace(
        camera_before(4.0), camera_from_world=np.diag([1.0, -1, -1, 1]) @ camera_before(9.0).camera_from_world
    )
    nothing = surface_error(dented, truth_of(round_ball), cameras=[behind], seed=0, num_samples=1_000)
    assert nothing.visible is None
    assert nothing.visible_share_of_truth == 0.0


def test_what_hides_the_mesh_does_not_hide_the_truth() -> None:
    """A plate before the camera hides the whole mesh; the truth is seen as if there were no plate."""
    plate = np.array([[-1.5, -3.0, -1.5], [1.5, -3, -1.5], [1.5, -3, 1.5], [-1.5, -3, 1.5]])
    hidden = ball(subdivisions=3)
    mesh = surface_mesh(
        np.concatenate([hidden.vertices, plate]),
        np.concatenate([hidden.faces, len(hidden.vertices) + np.array([[0, 1, 2], [0, 2, 3]])]),
    )
    cameras = [camera_before(4.0)]
    found = surface_error(mesh, truth_of(hidden), cameras=cameras, seed=0, num_samples=5_000)
    assert found.visible_share_of_truth == pytest.approx((1 - 1 / 4) / 2, abs=0.04)
    # The camera's picture is one unit wide there, of the plate's nine square units, beside the ball's 4 pi.
    assert found.visible_share_of_mesh == pytest.approx(1 / (9 + 4 * np.pi), abs=0.01)


def test_what_one_of_two_cameras_sees_is_visible() -> None:
    front = camera_before(4.0)
    back = replace(front, camera_from_world=front.camera_from_world @ np.diag([-1.0, -1, 1, 1]))
    one, other, both = (
        surface_error(
            ball(), truth_of(ball()), cameras=cameras, seed=0, num_samples=5_000
        ).visible_share_of_truth
        for cameras in ([front], [back], [front, back])
    )
    assert one is not None
    assert other is not None
    assert both == pytest.approx(one + other, abs=1e-9), "opposite caps do not overlap"


def test_a_cloud_is_compared_by_nearest_points_alone() -> None:
    mesh = ball(subdivisions=1)
    cloud = TrueSurface(vertices=mesh.vertices[::2] * 1.2, faces=None)
    found = surface_error(mesh, cloud, cameras=[camera_before(4.0)], seed=1, num_samples=300)
    assert found.visible is None
    assert found.whole.normal_consistency is None
    # To the mesh there are only 300 samples; none may be nearer than the true surface is.
    inner = np.linalg.norm(cloud.vertices, axis=1).mean() - 1.0
    assert found.whole.completeness_percent * cloud.diagonal / 100 > inner


def test_vertex_errors_match_the_definition() -> None:
    mesh, rng = ball(subdivisions=1), np.random.default_rng(0)
    cloud = TrueSurface(vertices=rng.normal(size=(50, 3)), faces=None)
    expected = nearest_one_by_one(mesh.vertices, cloud.vertices) / cloud.diagonal * 100
    np.testing.assert_allclose(vertex_error_percent(mesh, cloud, seed=0), expected, rtol=1e-5)


def test_vertex_errors_of_a_sphere_too_large_are_its_excess() -> None:
    found = vertex_error_percent(ball(1.1, 3), truth_of(ball()), seed=0, num_samples=100_000)
    np.testing.assert_allclose(found, 10 / (2 * np.sqrt(3)), rtol=0.02)


def test_psnr_of_a_known_difference_inside_the_mask_only() -> None:
    image = np.random.default_rng(0).random((8, 9, 3)).astype(np.float32)
    mask = np.zeros((8, 9), bool)
    mask[2:5, 3:7] = True
    rendered = np.where(mask[..., None], image + 0.1, 0.0).astype(np.float32)
    assert psnr(image, rendered, mask) == pytest.approx(20.0, abs=1e-4)
    assert psnr(image, image, mask) == float("inf")
    assert psnr(image, image, np.zeros((8, 9), bool)) is None


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".glb"])
def test_truth_survives_a_file(tmp_path: Path, suffix: str) -> None:
    """glTF's y axis is up: a box tall in z is written tall in y and read tall in z again."""
    box = trimesh.creation.box(extents=(1.0, 2.0, 4.0))
    box.apply_translation([0.5, 0.0, 3.0])
    written = box.copy()
    if suffix == ".glb":
        written.vertices = written.vertices[:, [0, 2, 1]] * [1, 1, -1]
    written.export(tmp_path / f"truth{suffix}")
    truth = load_truth(tmp_path / f"truth{suffix}")
    np.testing.assert_allclose(truth.vertices.min(0), [0.0, -1.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(truth.vertices.max(0), [1.0, 1.0, 5.0], atol=1e-6)
    assert truth.faces is not None
    assert len(truth.faces) == 12
    corners = truth.vertices[truth.faces]
    assert np.linalg.det(corners).sum() / 6 == pytest.approx(8.0, rel=1e-6), "volume, so windings kept"


def test_a_file_of_points_is_a_cloud(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    trimesh.PointCloud(points).export(tmp_path / "cloud.ply")
    truth = load_truth(tmp_path / "cloud.ply")
    assert truth.faces is None
    np.testing.assert_allclose(truth.vertices, points, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("missing.ply", None),
        ("empty.ply", b""),
        ("empty.obj", b""),
        ("garbage.glb", b"hello"),
        ("empty.glb", b""),
        ("garbage.obj", bytes(range(256)) * 4),
        ("half.ply", b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n1\n"),
        ("picture.png", b"\x89PNG"),
        ("swapped.ply", b"ply\nformat ascii 1.0\nproperty float x\nelement vertex 1\nend_header\n1\n"),
        ("far.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"),
        ("point.xyz", b"1 1 1\n1 1 1\n1 1 1\n"),
        ("nan.xyz", b"1 1 1\n1 nan 1\n1 2 1\n"),
    ],
)
def test_an_unusable_truth_is_refused_in_words(tmp_path: Path, name: str, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ReconstructionError) as caught:
        load_truth(tmp_path / name)
    assert caught.value.code is ErrorCode.TRUTH_UNREADABLE
    assert name in caught.value.text
    assert ("does not exist" in caught.value.text) == (content is None)
    assert "PLY" in caught.value.remedy


def test_truth_of_neither_faces_nor_points_is_refused(tmp_path: Path) -> None:
    (tmp_path / "grid.binvox").write_bytes(
        trimesh.voxel.VoxelGrid(np.ones((2, 2, 2), bool)).export(file_type="binvox")
    )
    with pytest.raises(ReconstructionError) as caught:
        load_truth(tmp_path / "grid.binvox")
    assert caught.value.code is ErrorCode.TRUTH_UNREADABLE


def test_faces_of_vertices_that_are_not_there_are_refused(tmp_path: Path) -> None:
    header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    faces = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "far.ply").write_text(header + faces + "0 0 0\n1 0 0\n0 1 0\n3 0 1 9\n")
    with pytest.raises(ReconstructionError, match="broken"):
        load_truth(tmp_path / "far.ply")


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_a_file_cut_short_is_refused(tmp_path: Path, suffix: str) -> None:
    whole, cut = tmp_path / f"whole{suffix}", tmp_path / f"cut{suffix}"
    trimesh.creation.icosphere(1).export(whole)
    for share in (0.3, 0.6, 0.9):
        cut.write_bytes(whole.read_bytes()[: int(whole.stat().st_size * share)])
        with pytest.raises(ReconstructionError, match=r"cut\.(ply|glb)"):
            load_truth(cut)


def yardstick(*arguments: str) -> list[float]:
    """accuracy, completeness, chamfer, F at 1 %, normals as the independent tool prints them."""
    run = subprocess.run(
        [sys.executable, str(YARDSTICK), *arguments, "-n", "300000"],
        capture_output=True,
        text=True,
        check=True,
    )
    line = run.stdout.splitlines()[-1]
    names = ("accuracy", "completeness", "chamfer", "F@1%", "normals")
    return [float(match[1]) for name in names if (match := re.search(rf"{re.escape(name)} ([\d.]+)", line))]


@pytest.mark.slow
@pytest.mark.skipif(not YARDSTICK.is_file(), reason="the independent yardstick is not beside this checkout")
@pytest.mark.parametrize("visible", [False, True])
def test_agrees_with_the_independent_yardstick(tmp_path: Path, visible: bool) -> None:
    """A torus, wavy and cut open at its back, against the true one, seen by two cameras."""
    torus = trimesh.creation.torus(1.0, 0.4, major_sections=96, minor_sections=48)
    wavy = np.asarray(torus.vertices) * (1 + 0.02 * np.sin(9 * torus.vertices[:, [0]]))
    faces = np.asarray(torus.faces)[torus.triangles_center[:, 1] < 0.9]
    trimesh.Trimesh(wavy, faces, process=False).export(tmp_path / "mesh.ply")
    torus.export(tmp_path / "truth.ply")
    turn = np.eye(4)
    turn[:3, :3] = trimesh.transformations.rotation_matrix(0.8, [1, 0, 0])[:3, :3]
    front = camera_before(4.0)
    cameras = [front, replace(front, camera_from_world=front.camera_from_world @ turn)]
    frames = [
        {"transform_matrix": (np.linalg.inv(c.camera_from_world) @ np.diag([1, -1, -1, 1])).tolist()}
        for c in cameras
    ]
    size = {"fl_x": 100.0, "fl_y": 100.0, "cx": 50.0, "cy": 50.0, "w": 100, "h": 100}
    (tmp_path / "transforms.json").write_text(json.dumps({**size, "frames": frames}))
    where = ["--visible", str(tmp_path)] if visible else []
    expected = yardstick(str(tmp_path / "mesh.ply"), str(tmp_path / "truth.ply"), *where)
    truth = load_truth(tmp_path / "truth.ply")
    found = surface_error(surface_mesh(wavy, faces), truth, cameras=cameras, seed=7, num_samples=300_000)
    part = found.visible if visible else found.whole
    assert part is not None
    assert part.normal_consistency is not None
    np.testing.assert_allclose(
        [part.accuracy_percent, part.completeness_percent, part.chamfer_percent],
        expected[:3],
        rtol=0.015,
        atol=2e-3,
    )
    assert part.f_score_at_one_percent == pytest.approx(expected[3], abs=0.005)
    assert part.normal_consistency == pytest.approx(expected[4], abs=0.004)
