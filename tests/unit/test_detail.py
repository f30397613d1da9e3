"""Detail: a wave that a coarse grid cannot hold is there after it; what was not measured stays as it was."""

import math
from dataclasses import replace

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from backend.maths.evidence import scatter_between
from backend.maths.geometry import Pinhole
from backend.maths.grid import node_positions, read, spacing
from backend.scene import Decision
from backend.stages.measurements import Measurements
from backend.stages.train.detail import add_detail
from backend.stages.train.linear_fit import LinearConfig

COARSE, FINE = 32, 64
WAVE = 5 * spacing(COARSE)
"""Length of the wave that was measured: too short for the coarse grid."""
HEIGHT = 0.15 * WAVE / (2 * math.pi)
CPU = torch.device("cpu")


def height_at(x: Tensor) -> Tensor:
    return HEIGHT * torch.cos(2 * math.pi / WAVE * x)


def camera(focal_px: float) -> Pinhole:
    """Looks at the grid's middle from 4 off."""
    from_object = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    from_object[2, 3] = 4.0
    intrinsics = torch.tensor([[focal_px, 0, 100], [0, focal_px, 100], [0, 0, 1]])
    return Pinhole(camera_from_object=from_object, intrinsics=intrinsics, width=200, height=200)


def measured(noise: float = 0.0, focal_px: float = 200.0) -> Measurements:
    """The wave over the half x < 0 of the plane z = 0, as two views see it."""
    generator = torch.Generator().manual_seed(0)
    places = torch.rand((40_000, 2), generator=generator) * torch.tensor([1.0, 2.0]) - 1
    views = torch.arange(len(places)) % 2
    z = height_at(places[:, 0]) + noise * (2 * views - 1)
    slope = -HEIGHT * 2 * math.pi / WAVE * torch.sin(2 * math.pi / WAVE * places[:, 0])
    normals = torch.stack([-slope, torch.zeros_like(slope), torch.ones_like(slope)], dim=-1)
    none: list[Tensor | None] = [None, None]
    return Measurements(
        cameras=[camera(focal_px)] * 2,
        images=[torch.zeros(3, 200, 200)] * 2,
        masks=none,
        outlines=none,
        backdrops=none,
        certain=none,
        depths=[torch.zeros(200, 200)] * 2,
        confidences=[torch.zeros(200, 200)] * 2,
        positions=torch.column_stack([places, z]),
        normals=torch.nn.functional.normalize(normals, dim=-1),
        colours=torch.zeros(len(places), 3),
        confidence=torch.ones(len(places)),
        view_index=views,
        region_centre=torch.zeros(3),
        region_radius=1.0,
    )


def flat() -> Float[Tensor, "nodes nodes nodes"]:
    return node_positions(COARSE, CPU)[..., 2].clone()


def detailed(
    most: int = FINE, *, noise: float = 0.0, focal_px: float = 200.0, there_is_time: bool = True
) -> tuple[Tensor, Decision]:
    return add_detail(measured(noise, focal_px), flat(), most, LinearConfig(), lambda _: there_is_time)


def test_the_wave_is_there_and_what_was_not_measured_is_as_it_was() -> None:
    distance, decision = detailed()
    assert distance.shape == (FINE,) * 3
    assert decision.choice == f"points on a grid of {FINE}"
    x = torch.linspace(-0.9, -0.2, 200)
    wave = torch.stack([x, torch.full_like(x, 0.1), height_at(x)], dim=-1)
    assert float(read(distance, wave).abs().mean()) < 0.15 * HEIGHT < 0.3 * float(height_at(x).abs().mean())
    nodes = node_positions(FINE, CPU)
    far = (nodes[..., 0] > 0.3) | (nodes[..., 2].abs() > 0.3)
    far &= (nodes.abs() < 0.9).all(dim=-1)  # at the sides of the grid what is smooth has no slope
    torch.testing.assert_close(distance[far], nodes[..., 2][far], atol=0.02 * HEIGHT, rtol=0)


@pytest.mark.parametrize(
    ("why", "because"),
    [
        ({"most": 40}, "the preset"),
        ({"most": 0}, "the preset"),
        ({"focal_px": 100.0}, "1.6 pixels wide"),  # of a coarse cell: a finer one would be less than a pixel
        ({"noise": 0.08 * spacing(COARSE)}, "two photographs differ by 0.16 cells"),
        ({"there_is_time": False}, "there is no time left"),
    ],
)
def test_it_is_left_out_where_nothing_would_be_gained(why: dict[str, float], because: str) -> None:
    distance, decision = detailed(**why)  # type: ignore[arg-type]
    torch.testing.assert_close(distance, flat(), atol=0, rtol=0)
    assert decision.choice == "left out"
    assert because in decision.because


def test_the_grid_is_as_fine_as_photographs_agree() -> None:
    """0.045 of a coarse cell between two photographs are the 0.075 that are allowed, of a smaller cell."""
    distance, _ = detailed(most=3 * COARSE, noise=0.0225 * spacing(COARSE))
    assert len(distance) == pytest.approx(COARSE * 0.075 / 0.045, abs=2)


def test_without_points_there_is_no_detail() -> None:
    scene = measured()
    none = torch.zeros(len(scene.positions), dtype=torch.bool)
    names = ("positions", "normals", "colours", "confidence", "view_index")
    empty = replace(scene, **{name: getattr(scene, name)[none] for name in names})
    distance, decision = add_detail(empty, flat(), FINE, LinearConfig(), lambda _: True)
    assert (len(distance), decision.choice) == (COARSE, "left out")
    assert "hardly any place was measured by two photographs" in decision.because


@pytest.mark.parametrize("offset", [0.0, 0.003, 0.02])
def test_scatter_is_how_far_two_views_are_apart(offset: float) -> None:
    generator = torch.Generator().manual_seed(0)
    places = torch.rand((20_000, 3), generator=generator) * torch.tensor([1.0, 1.0, 0.0])
    views = torch.randint(0, 3, (len(places),), generator=generator)
    places[:, 2] = 0.05 + offset * (views == 1)  # well within a layer of cubes
    up = torch.tensor([0.0, 0.0, 1.0]).expand(len(places), 3)
    found = scatter_between(places, up, torch.ones(len(places)), views, 0.1)
    # of three views in a cube one is compared with both others, which agree
    assert found == pytest.approx(offset, abs=1e-6)


def test_one_view_alone_has_no_scatter() -> None:
    places = torch.rand((20_000, 3), generator=torch.Generator().manual_seed(0))
    same = torch.zeros(len(places), dtype=torch.long)
    assert scatter_between(places, places, torch.ones(len(places)), same, 0.1) == math.inf
    assert scatter_between(places[:0], places[:0], torch.ones(0), same[:0], 0.1) == math.inf
