"""Pixels of the unit sphere are those whose rays come nearer than 1 to its centre; rays go through them."""

import torch

from backend.maths.geometry import project
from backend.maths.rays import sphere_span
from backend.stages.measurements import Measurements, measurements
from backend.stages.pixels import pixels_of_unit_sphere, rays_through
from backend.stages.stereo.multi_view_stereo import unmatched
from tests.synthetic_scene import Scene, photographed, ring_cameras, true_region


def measured(scene: Scene) -> Measurements:
    """The views in the region's frame, without points."""
    region = true_region()
    return measurements(scene.views, region, unmatched(scene.views), torch.device("cpu"))


def test_rays_of_the_unit_sphere_go_through_it_and_through_their_pixels() -> None:
    scene = measured(photographed(ring_cameras(3, 64)))
    pixels = pixels_of_unit_sphere(scene)
    every = torch.arange(len(pixels.view))
    origins, directions = rays_through(scene.cameras, pixels, every)
    along = -(origins * directions).sum(dim=-1, keepdim=True)
    nearest = origins + along * directions
    assert 0.5 < float(nearest.norm(dim=-1).max()) < 1
    assert len(every) > 0.2 * 3 * 64 * 48
    for index, camera in enumerate(scene.cameras):
        mine = pixels.view == index
        where, depth = project(camera, nearest[mine])
        torch.testing.assert_close(where, pixels.where[mine], atol=1e-3, rtol=0)
        assert (depth > 0).all()
        column, row = pixels.where[mine].long().unbind(-1)
        assert torch.equal(pixels.colour[mine], scene.images[index][:, row, column].T)


def test_the_subject_is_among_them() -> None:
    scene = measured(photographed(ring_cameras(3, 64)))
    on_subject = sum(float(mask.sum()) for mask in scene.masks if mask is not None)
    assert pixels_of_unit_sphere(scene).coverage.sum().item() == on_subject
    open_scene = measured(photographed(ring_cameras(3, 64)).without_masks())
    assert pixels_of_unit_sphere(open_scene).coverage.isnan().all()


def test_a_span_ends_on_the_sphere_or_is_nothing() -> None:
    origins = torch.tensor(
        [[0.0, 0.0, -3.0], [0.6, 0.0, -3.0], [0.0, 0.5, 0.0], [2.0, 0.0, -3.0], [0.0, 0, 2]]
    )
    directions = torch.tensor([[0.0, 0.0, 1.0]]).expand(5, 3)
    entry, leave = sphere_span(origins, directions)
    expected = [(2.0, 4.0), (2.2, 3.8), (0.0, 0.75**0.5), (3.0, 3.0), (0.0, 0.0)]
    torch.testing.assert_close(torch.stack([entry, leave], dim=-1), torch.tensor(expected))
