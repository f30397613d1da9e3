"""What a run shows of itself while it goes on: cameras, points, then meshes of the unfinished surface."""

import json
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from .mesh_files import write_mesh, write_points
from .scene import Region, SolvedCameras, SurfacePoints, transform_points
from .stages.cameras.nerfstudio import transforms_json
from .stages.mesh.extraction import preview_mesh
from .stages.surface import Surface
from .workspace import Workspace

_SHORTEST_PAUSE_S = 1.0
"""A viewer does not want more, and reading a mesh takes its time as well."""
_LARGEST_SHARE = 0.03
"""Of the run's time that meshes to look at may take."""
_POINTS_SHOWN = 50_000
_POINTS_FOR_COLOUR = 20_000


class Previews:
    """Writes previews into the private folder and tells the listener; nothing that is computed depends on it.

    Each has a file name of its own, so that a reader never sees half of one.
    """

    def __init__(
        self,
        workspace: Workspace,
        announce: Callable[[Path], None],
        *,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._workspace = workspace
        self._announce = announce
        self._clock = clock
        self._number = 0
        self._not_before_s = clock()
        workspace.remove_previews()

    def show_cameras(self, solved: SolvedCameras, region: Region) -> None:
        """Say where the photographs were taken: a viewer needs it to place what follows."""
        content = json.dumps(transforms_json(solved, region), allow_nan=False)
        self._show(lambda path: path.write_text(content, encoding="utf-8"), self._clock(), ".json")

    def show_points(self, points: SurfacePoints, region: Region) -> None:
        """Show some of the stereo points: there may be a million."""
        few = _spread(points, _POINTS_SHOWN)
        self._show(partial(write_points, points=few, region=region), self._clock())

    def show_surface(self, surface: Surface, points: SurfacePoints, region: Region) -> None:
        """Show the unfinished surface in the colours of the nearest points, unless that was done just now."""
        started_s = self._clock()
        if started_s < self._not_before_s:
            return
        few = _spread(points, _POINTS_FOR_COLOUR)
        positions = transform_points(region.world_from_object, few.positions.astype(np.float64))
        mesh = preview_mesh(surface, positions, few.colours_srgb)
        if mesh is not None:
            self._show(partial(write_mesh, mesh=mesh), started_s)

    def _show(self, write: Callable[[Path], object], started_s: float, suffix: str = ".ply") -> None:
        self._number += 1
        path = self._workspace.preview_path(self._number, suffix)
        write(path)
        ended_s = self._clock()
        self._not_before_s = ended_s + max(_SHORTEST_PAUSE_S, (ended_s - started_s) / _LARGEST_SHARE)
        self._announce(path)


def _spread(points: SurfacePoints, most: int) -> SurfacePoints:
    """Every n-th of the points, at most so many."""
    step = max(1, -(-len(points.positions) // most))
    return replace(
        points,
        positions=points.positions[::step],
        normals=points.normals[::step],
        colours_srgb=points.colours_srgb[::step],
        confidence=points.confidence[::step],
        num_views=points.num_views[::step],
        view_index=points.view_index[::step],
    )
