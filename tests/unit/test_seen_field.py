"""Which pixels can meet a field at all: none that does may be left out, and hardly more."""

import pytest
import torch

from backend.maths.geometry import Pinhole
from backend.maths.grid import node_positions
from backend.stages.train.seen_field import NearSurface, may_show, seen_field

CPU = torch.device("cpu")


def looking_along_z(distance: float, *, focal_px: float = 200.0) -> Pinhole:
    camera_from_object = torch.eye(4)
    camera_from_object[2, 3] = distance
    intrinsics = torch.tensor([[focal_px, 0, 80.0], [0, focal_px, 60.0], [0, 0, 1]])
    return Pinhole(intrinsics=intrinsics, camera_from_object=camera_from_object, width=160, height=120)


@pytest.mark.parametrize("nodes", [16, 48])
@pytest.mark.parametrize("middle", [(0.0, 0.0, 0.0), (0.5, -0.4, 0.3), (-0.3, 0.8, 0.9)])
@pytest.mark.parametrize("focal_px", [60.0, 300.0])
@pytest.mark.parametrize("steep", [1.0, 20.0])
def test_every_pixel_that_meets_the_field_may_show_it(
    nodes: int, middle: tuple[float, float, float], focal_px: float, steep: float
) -> None:
    field = steep * ((node_positions(nodes, CPU) - torch.tensor(middle)).norm(dim=-1) - 0.35)
    camera = looking_along_z(3.0, focal_px=focal_px)
    everywhere = torch.ones((120, 160), dtype=torch.bool)
    seen = seen_field(camera, everywhere, field)
    hit = (seen.hit & (seen.positions.abs().amax(dim=-1) <= 1)).view(120, 160)
    assert hit.any()
    assert not (hit & ~may_show(camera, NearSurface(distance=field))).any()


def test_no_pixel_is_left_out_between_nodes_that_lie_behind_one_another() -> None:
    """From far off, rolled by 45 degrees, squares of a cell's size lie between the nodes as they show."""
    field = node_positions(16, CPU)[..., 2].abs() - 0.4
    camera = looking_along_z(1000.0, focal_px=40_000.0)
    c = 0.5**0.5
    camera.camera_from_object[:2, :2] = torch.tensor([[c, -c], [c, c]])
    seen = seen_field(camera, torch.ones((120, 160), dtype=torch.bool), field)
    hit = (seen.hit & (seen.positions.abs().amax(dim=-1) <= 1)).view(120, 160)
    assert hit.any()
    assert not (hit & ~may_show(camera, NearSurface(distance=field))).any()


def test_rays_that_pass_by_are_told() -> None:
    field = node_positions(64, CPU).norm(dim=-1) - 0.3
    camera = looking_along_z(3.0)
    hit = seen_field(camera, torch.ones((120, 160), dtype=torch.bool), field).hit
    # 20 pixels of radius, and at most 2 cells and 2 squares more, of 2 and 3 pixels
    assert int(may_show(camera, NearSurface(distance=field)).sum()) < 2.4 * int(hit.sum()) < 0.2 * 120 * 160


def test_from_within_everything_may_show_and_of_an_empty_field_nothing() -> None:
    field = node_positions(24, CPU).norm(dim=-1) - 0.5
    assert may_show(looking_along_z(0.2), NearSurface(distance=field)).all()
    nothing = NearSurface(distance=torch.ones((24, 24, 24)))
    assert not may_show(looking_along_z(3.0), nothing).any()
