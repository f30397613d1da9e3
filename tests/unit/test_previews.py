"""Meshes to look at while a run goes on: what they show, how often, and at what cost."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from backend.mesh_files import read_mesh
from backend.previews import Previews
from backend.scene import Region, SurfacePoints, to_unit_sphere
from backend.stages.mesh.extraction import PREVIEW_FACES, preview_mesh
from backend.stages.surface import Surface
from backend.workspace import Workspace

CENTRE, HALF = np.array([3.0, -1.0, 2.0]), 2.0
"""Of the grid, in the world."""


def ball(nodes: int, radius: float = 0.6, waves: float = 0.0) -> Surface:
    """A ball in the middle of a grid, radius in the grid's units, with a rough surface where waves are."""
    steps = np.linspace(-1, 1, nodes, dtype=np.float32)
    x, y, z = np.meshgrid(steps, steps, steps, indexing="ij")
    rough = waves * np.sin(40 * x) * np.sin(40 * y) * np.sin(40 * z)
    distance = np.sqrt(x**2 + y**2 + z**2) - radius + rough
    return Surface(distance=distance.astype(np.float32), grid_from_world=to_unit_sphere(CENTRE, HALF))


def poles() -> tuple[np.ndarray, np.ndarray]:
    """A red point at the top of the ball and a blue one below, world frame."""
    points = CENTRE + HALF * 0.6 * np.array([[0, 0, 1.0], [0, 0, -1.0]])
    return points, np.array([[1, 0, 0], [0, 0, 1]], np.float32)


@pytest.mark.parametrize("nodes", [24, 64, 128])
def test_the_mesh_is_the_surface_in_the_world(nodes: int) -> None:
    mesh = preview_mesh(ball(nodes), *poles())
    assert mesh is not None
    away = np.linalg.norm(mesh.vertices - CENTRE, axis=1)
    np.testing.assert_allclose(away, HALF * 0.6, rtol=0.02)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.is_watertight
    assert solid.volume > 0
    assert ((mesh.vertices - CENTRE) * mesh.normals).sum(axis=1).min() > 0


def test_a_vertex_has_the_colour_of_the_nearest_point() -> None:
    mesh = preview_mesh(ball(32), *poles())
    assert mesh is not None
    above = mesh.vertices[:, 2] > CENTRE[2]
    assert (mesh.colours_srgb[above] == [255, 0, 0]).all()
    assert (mesh.colours_srgb[~above] == [0, 0, 255]).all()


def test_without_points_it_is_grey_and_without_surface_it_is_not() -> None:
    nothing = np.zeros((0, 3)), np.zeros((0, 3), np.float32)
    mesh = preview_mesh(ball(16), *nothing)
    assert mesh is not None
    assert (mesh.colours_srgb == 128).all()
    assert preview_mesh(ball(16, radius=-1.0), *nothing) is None


def test_a_rough_surface_does_not_get_too_many_faces() -> None:
    mesh = preview_mesh(ball(200, radius=0.8, waves=0.2), *poles())
    assert mesh is not None
    assert 1_000 < len(mesh.faces) <= PREVIEW_FACES


class Shown:
    """A place for previews, a clock that is set by hand, and what was announced."""

    def __init__(self, folder: Path, seconds_to_write: float = 0.0) -> None:
        self.now_s = 100.0
        self.paths: list[Path] = []
        self.seconds_to_write = seconds_to_write
        self.workspace = Workspace(folder=folder)
        self.workspace.private.mkdir(exist_ok=True)
        self.previews = Previews(self.workspace, self._announced, clock=self._clock)

    def surface(self, later_s: float) -> int:
        """Show a surface some time after the last; how many previews there are now."""
        self.now_s += later_s
        positions, colours = poles()
        points = SurfacePoints(
            positions=((positions - CENTRE) / HALF).astype(np.float32),
            normals=colours,
            colours_srgb=colours,
            confidence=np.ones(2, np.float32),
            num_views=np.full(2, 2),
            view_index=np.zeros(2, np.int64),
        )
        self.previews.show_surface(ball(16), points, Region(object_from_world=to_unit_sphere(CENTRE, HALF)))
        return len(self.paths)

    def _announced(self, path: Path) -> None:
        self.paths.append(path)
        assert path.stat().st_size > 0, "it is whole by now"

    def _clock(self) -> float:
        self.now_s += self.seconds_to_write / 2
        return self.now_s


def test_previews_come_no_more_often_than_once_a_second(tmp_path: Path) -> None:
    shown = Shown(tmp_path)
    assert [shown.surface(later_s) for later_s in (0.0, 0.9, 0.2, 0.5, 0.6)] == [1, 1, 2, 2, 3]
    assert len(set(shown.paths)) == 3, "one that is being read is not replaced"
    assert all(path.parent == tmp_path / ".fewview" for path in shown.paths)
    mesh = read_mesh(shown.paths[0])
    assert (mesh.colours_srgb[mesh.vertices[:, 2] > CENTRE[2]] == [255, 0, 0]).all()


def test_slow_previews_come_less_often(tmp_path: Path) -> None:
    """Each takes a tenth of a second or so: at most three percent of the time goes into them."""
    shown = Shown(tmp_path, seconds_to_write=0.2)
    shown.surface(0.0)
    assert shown.surface(2.5) == 1
    assert shown.surface(2.5) == 2


@pytest.mark.parametrize("count", [0, 5, 120_001])
def test_some_points_are_shown_from_all_over(count: int, tmp_path: Path) -> None:
    shown = Shown(tmp_path)
    line = np.linspace(0, 1, count, dtype=np.float32)
    column = np.stack([line] * 3, axis=1)
    points = SurfacePoints(
        positions=column,
        normals=column,
        colours_srgb=column,
        confidence=line,
        num_views=np.full(count, 2),
        view_index=np.zeros(count, np.int64),
    )
    shown.previews.show_points(points, Region(object_from_world=to_unit_sphere(CENTRE, HALF)))
    (path,) = shown.paths
    header, _, body = path.read_bytes().partition(b"end_header\n")
    rows = np.frombuffer(body, np.dtype([("xyz", "<f8", 3), ("rest", "V19")]))
    assert f"element vertex {len(rows)}\n".encode() in header
    assert len(rows) == (count if count < 50_000 else 40_001)
    if count:
        np.testing.assert_allclose(rows["xyz"][[0, -1]], [CENTRE, CENTRE + HALF])


def test_previews_of_earlier_runs_go(tmp_path: Path) -> None:
    (tmp_path / ".fewview").mkdir()
    for name in ("preview.ply", "preview-7.ply", "stereo.npz"):
        (tmp_path / ".fewview" / name).touch()
    Shown(tmp_path)
    assert [path.name for path in (tmp_path / ".fewview").iterdir()] == ["stereo.npz"]
