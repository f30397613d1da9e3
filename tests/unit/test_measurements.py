"""What photographs and stereo say, as tensors."""

from dataclasses import replace

import numpy as np
import torch

from backend.stages.measurements import measurements
from backend.stages.stereo.multi_view_stereo import unmatched
from tests.synthetic_scene import faced_points, photographed, ring_cameras, true_region

CPU = torch.device("cpu")


def test_normals_that_face_away_from_the_view_that_measured_them_are_turned_round() -> None:
    """Those of the sixth view look away from the first: one side for all would be wrong for some."""
    views = photographed(ring_cameras(6, 40)).views
    points = faced_points([view.camera for view in views])
    assert set(points.view_index) == set(range(6))
    turned = replace(
        points, normals=points.normals * np.resize(np.float32([1, -1]), (len(points.normals), 1))
    )
    for given in (points, turned):
        stereo = replace(unmatched(views), points=given)
        found = measurements(views, true_region(), stereo, CPU).normals
        torch.testing.assert_close(found, torch.tensor(points.normals), rtol=0, atol=0)
