"""What photographs and stereo say, as tensors."""

from dataclasses import replace

import numpy as np
import torch

from backend.scene import SurfacePoints, transform_points
from backend.stages.measurements import measurements
from backend.stages.stereo import unmatched
from tests.synthetic_scene import CENTRE, SIZE, photographed, ring_cameras, true_region

CPU = torch.device("cpu")


def points_seen(cameras: np.ndarray) -> SurfacePoints:
    """Of a ball about as large as the body, three for each camera, which looks at them; object frame."""
    view_index = np.repeat(np.arange(len(cameras)), 3)
    towards = cameras[view_index] - CENTRE
    aside = np.random.default_rng(0).normal(size=towards.shape)
    outwards = towards / np.linalg.norm(towards, axis=1, keepdims=True) + 0.3 * aside
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    count = len(outwards)
    return SurfacePoints(
        positions=transform_points(true_region().object_from_world, CENTRE + SIZE / 2 * outwards).astype(
            np.float32
        ),
        normals=outwards.astype(np.float32),
        colours_srgb=np.full((count, 3), 0.5, np.float32),
        confidence=np.ones(count, np.float32),
        num_views=np.full(count, 2),
        view_index=view_index,
    )


def test_normals_that_face_away_from_the_view_that_measured_them_are_turned_round() -> None:
    """Those of the sixth view look away from the first: one side for all would be wrong for some."""
    views = photographed(ring_cameras(6, 40)).views
    points = points_seen(np.stack([view.camera.position for view in views]))
    turned = replace(
        points, normals=points.normals * np.resize(np.float32([1, -1]), (len(points.normals), 1))
    )
    for given in (points, turned):
        stereo = replace(unmatched(views), points=given)
        found = measurements(views, true_region(), stereo, CPU).normals
        torch.testing.assert_close(found, torch.tensor(points.normals), rtol=0, atol=0)
