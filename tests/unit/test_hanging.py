"""What hangs in the air goes, from points and depth maps; what is joined to the rest, or masked, stays."""

from dataclasses import replace

import numpy as np
import pytest
from jaxtyping import Float64

from backend.scene import Camera, DepthMap, Region, StereoResult, View
from backend.stages.stereo.hanging import without_hanging
from tests.synthetic_scene import plain_points

REGION = Region(object_from_world=np.diag([0.5, 0.5, 0.5, 1.0]))
"""Two world units around the origin."""


def table(z: float = -0.5, num: int = 20_000) -> Float64[np.ndarray, "points 3"]:
    """Of the object frame."""
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(-0.7, 0.7, (num, 2)), np.full(num, z)])


def lump(x: float, num: int = 40) -> Float64[np.ndarray, "points 3"]:
    return np.random.default_rng(1).normal(size=(num, 3)) * 0.01 + [x, 0, 0.3]


def view(masked: bool = False) -> View:
    """From above: 8 world units over the origin, looking down; a pixel is a tenth of a unit there."""
    camera_from_world = np.diag([1.0, -1.0, -1.0, 1.0])
    camera_from_world[2, 3] = 8.0
    camera = Camera(
        camera_from_world=camera_from_world,
        fx_px=80.0,
        fy_px=80.0,
        cx_px=20.0,
        cy_px=20.0,
        width=40,
        height=40,
    )
    mask = np.ones((40, 40), np.float32) if masked else None
    return View(name="a.png", camera=camera, image_srgb=np.zeros((40, 40, 3), np.float32), mask=mask)


def stereo_of(positions: Float64[np.ndarray, "points 3"]) -> StereoResult:
    """All of it in the middle of the picture is at the lump's height, around it at the table's."""
    depth = np.full((40, 40), 4.0 + 0.5, np.float32)  # object units
    depth[18:22, 18:22] = 4.0 - 0.3
    depth[:5] = 0
    map_ = DepthMap(depth=depth, confidence=np.where(depth > 0, np.float32(0.5), 0), empty=None, subject=None)
    return StereoResult(points=plain_points(positions, confidence=0.5), depth_maps=(map_,))


def test_lumps_above_a_table_are_left_out() -> None:
    stereo = stereo_of(np.concatenate([lump(0.0), table()]))
    kept = without_hanging(stereo, (view(),), REGION)
    np.testing.assert_array_equal(kept.points.positions, stereo.points.positions[40:])
    assert len(kept.points.confidence) == len(kept.points.view_index) == 20_000
    before, after = stereo.depth_maps[0], kept.depth_maps[0]
    assert not after.depth[18:22, 18:22].any()
    assert not after.confidence[18:22, 18:22].any()
    around = np.ones((40, 40), bool)
    around[18:22, 18:22] = False
    np.testing.assert_array_equal(after.depth[around], before.depth[around])
    (decision,) = kept.decisions
    assert (decision.what, decision.choice) == ("surface in the air", "left out")
    assert decision.because == "40 of 20040 measured points are joined to nothing else"


@pytest.mark.parametrize(
    "positions",
    [
        pytest.param(table(), id="one piece"),
        pytest.param(np.concatenate([lump(0.0, 200), table()]), id="a hundredth of all"),
        pytest.param(
            np.concatenate(
                [lump(0.0), np.column_stack([np.zeros((40, 2)), np.linspace(-0.5, 0.3, 40)]), table()]
            ),
            id="on a pole",
        ),
        pytest.param(np.zeros((0, 3)), id="nothing"),
    ],
)
def test_what_stays(positions: Float64[np.ndarray, "points 3"]) -> None:
    stereo = stereo_of(positions)
    assert without_hanging(stereo, (view(),), REGION) is stereo


def test_with_masks_it_stays() -> None:
    stereo = stereo_of(np.concatenate([lump(0.0), table()]))
    assert without_hanging(stereo, (view(masked=True),), REGION) is stereo
    both = replace(stereo, depth_maps=2 * stereo.depth_maps)
    assert without_hanging(both, (view(), view(masked=True)), REGION) is both


def test_what_is_unsure_counts_less() -> None:
    stereo = stereo_of(np.concatenate([lump(0.0, 200), table()]))
    confidence = stereo.points.confidence.copy()
    confidence[:200] = 0.05
    unsure = replace(stereo, points=replace(stereo.points, confidence=confidence))
    assert len(without_hanging(unsure, (view(),), REGION).points.positions) == 20_000
