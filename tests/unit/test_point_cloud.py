"""Clouds as files, and what is said of those that can not be used."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from backend.errors import ErrorCode, ReconstructionError
from backend.stages.points.point_cloud import FEWEST_POINTS, clean_cloud, read_cloud


def some_points(count: int = 100) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(count, 3))


def refusal(path: Path) -> str:
    with pytest.raises(ReconstructionError) as caught:
        read_cloud(path)
    assert caught.value.code == ErrorCode.CLOUD_UNUSABLE
    return caught.value.text


@pytest.mark.parametrize("separator", [" ", ",", "\t"])
@pytest.mark.parametrize("columns", [3, 6])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_text_files(tmp_path: Path, separator: str, columns: int, encoding: str) -> None:
    table = np.random.default_rng(0).normal(size=(50, columns))
    path = tmp_path / "cloud.xyz"
    np.savetxt(path, table, delimiter=separator, header="a remark")
    path.write_text(path.read_text(), encoding=encoding)
    cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.positions, table[:, :3])
    if columns == 3:
        assert cloud.normals is None
    else:
        assert cloud.normals is not None
        lengths = np.linalg.norm(table[:, 3:], axis=1, keepdims=True)
        np.testing.assert_allclose(cloud.normals, table[:, 3:] / lengths)


@pytest.mark.parametrize("with_normals", [False, True])
@pytest.mark.parametrize("binary", [False, True])
def test_ply_files(tmp_path: Path, with_normals: bool, binary: bool) -> None:
    points = some_points()
    names = ["x", "y", "z", *(["nx", "ny", "nz"] if with_normals else [])]
    table = np.hstack([points, -points])[:, : len(names)]
    form = "binary_little_endian" if binary else "ascii"
    head = ["ply", f"format {form} 1.0", f"element vertex {len(table)}"]
    head += [*(f"property double {name}" for name in names), "end_header\n"]
    text = "\n".join(" ".join(map(repr, row)) for row in table.tolist()).encode()
    path = tmp_path / "cloud.ply"
    path.write_bytes("\n".join(head).encode() + (table.astype("<f8").tobytes() if binary else text))
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.positions, points)
    assert (cloud.normals is not None) == with_normals
    if cloud.normals is not None:
        np.testing.assert_allclose(cloud.normals, -points / np.linalg.norm(points, axis=1, keepdims=True))


def test_of_a_mesh_the_vertices_are_taken(tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    mesh = trimesh.creation.icosphere(subdivisions=2)
    mesh.export(path)
    np.testing.assert_allclose(read_cloud(path).positions, mesh.vertices, atol=1e-6)


def test_points_that_say_nothing_are_left_out_and_counted() -> None:
    points = np.concatenate([some_points(), some_points()[:7], [[np.nan, 0, 0], [0, np.inf, 0]]])
    cloud = clean_cloud(points, None)
    np.testing.assert_array_equal(cloud.positions, some_points())
    assert [(d.what, d.choice) for d in cloud.decisions] == [
        ("points that are not finite", "2 of 109 left out"),
        ("points that are repeated", "7 of 109 left out"),
    ]


@pytest.mark.parametrize("stray", [1e7, 1e30, 1e99])
def test_a_point_far_away_does_not_make_a_plane_of_a_cloud(stray: float) -> None:
    """By the plain principal axes it does."""
    points = some_points()
    points[7] = stray, -stray, stray
    assert clean_cloud(points, None).decisions == ()
    sizes = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    assert sizes[2] < 1e-6 * sizes[0]
    points[:, 2] = 3 * points[:, 0] - points[:, 1] + 5
    with pytest.raises(ReconstructionError, match="one plane"):
        clean_cloud(points, None)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, 1e200, -1e308])
def test_points_that_can_not_be_reckoned_with_are_left_out_and_counted(wrong: float) -> None:
    points = some_points()
    points[[3, 50], [0, 2]] = wrong
    cloud = clean_cloud(points, points)
    np.testing.assert_array_equal(cloud.positions, np.delete(some_points(), [3, 50], axis=0))
    assert ("points that are not finite", "2 of 100 left out") in [
        (d.what, d.choice) for d in cloud.decisions
    ]
    with pytest.raises(ReconstructionError, match="0 different points with finite coordinates"):
        clean_cloud(np.full((100, 3), wrong), None)


def test_normals_without_length_or_number_are_none() -> None:
    normals = some_points()
    normals[0], normals[1], normals[2, 1] = 0, np.nan, np.inf
    cloud = clean_cloud(some_points(), normals)
    assert cloud.normals is not None
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), [0, 0, 0, *[1] * 97])
    assert [(d.what, d.choice) for d in cloud.decisions] == [
        ("normals that are not finite", "2 of 100 left out")
    ]


@pytest.mark.parametrize("scale", [1e-200, 1.0, 1e200])
def test_normals_of_any_length_are_made_unit(scale: float) -> None:
    """By the plain norm those of 1e-200 stay as they are, and those of 1e200 become 0."""
    expected = some_points() / np.linalg.norm(some_points(), axis=1, keepdims=True)
    normals = clean_cloud(some_points(), scale * some_points()).normals
    assert normals is not None
    np.testing.assert_allclose(normals, expected)


def test_clouds_that_can_not_be_used(tmp_path: Path) -> None:
    assert "does not exist" in refusal(tmp_path / "nothing.xyz")
    path = tmp_path / "cloud.xyz"
    for content, words in (
        ("", "empty"),
        ("# only a remark\n", "empty"),
        ("1 2\n3 4\n", "2 columns"),
        ("one two three\n", "cannot be read"),
        ("nan nan nan\n" * 50, "0 different points"),
        ("1 2 3\n" * 50, f"1 different points with finite coordinates; {FEWEST_POINTS}"),
    ):
        path.write_text(content)
        assert words in refusal(path)
    plane = some_points()
    plane[:, 2] = 3 * plane[:, 0] - plane[:, 1] + 5
    np.savetxt(path, plane)
    assert "one plane" in refusal(path)
    broken = tmp_path / "cloud.ply"
    broken.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nend_header\n")
    assert "cannot be read" in refusal(broken)


def test_decimal_commas_do_not_make_more_columns(tmp_path: Path) -> None:
    """A half of each number would be taken for the next coordinate, and the rest for normals."""
    path = tmp_path / "cloud.txt"
    rows = (" ".join(f"{100 * value:.3f}" for value in row) for row in some_points())
    path.write_text("\n".join(rows).replace(".", ","))
    assert "0,5 for 0.5" in refusal(path)
