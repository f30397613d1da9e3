"""What points and photographs say about a grid, where planes, spheres and straight outlines decide it."""

import numpy as np
import pytest
import torch
from torch import Tensor

from backend.maths.evidence import (
    merged_points,
    off_silhouette,
    point_distances,
    read_at_nodes,
    seen_through,
)
from backend.maths.geometry import Pinhole, inside, project
from backend.maths.grid import node_positions, spacing

CPU = torch.device("cpu")
NODES = 9


def camera() -> Pinhole:
    """On the z axis, 3 units before the centre, its axes the object's; 60 x 40 pixels."""
    camera_from_object = torch.eye(4)
    camera_from_object[2, 3] = 3.0
    intrinsics = torch.tensor([[50.0, 0, 30], [0, 50, 20], [0, 0, 1]])
    return Pinhole(intrinsics=intrinsics, camera_from_object=camera_from_object, width=60, height=40)


def shown_nodes() -> tuple[Tensor, Tensor, Tensor]:
    """Pixel and depth of every node, and whether the photograph shows it."""
    pixel, depth = project(camera(), node_positions(NODES, CPU))
    shown = inside(pixel, 60, 40)
    assert shown.any()
    assert not shown.all()
    return pixel, depth, shown


def random_points(num: int) -> Tensor:
    return torch.rand(num, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1


def test_points_on_a_plane_give_its_distance() -> None:
    normal = torch.nn.functional.normalize(torch.tensor([0.5, -0.3, 1.0]), dim=0)
    points = random_points(2000)
    points = points - ((points @ normal) - 0.1)[:, None] * normal
    confidence = 0.1 + 0.9 * torch.rand(2000, generator=torch.Generator().manual_seed(1))
    result = point_distances(points, normal.expand(2000, 3), confidence, NODES)
    spoken = result.weight > 0
    truth = node_positions(NODES, CPU) @ normal - 0.1
    assert 50 < spoken.sum() < spoken.numel()
    torch.testing.assert_close(result.distance[spoken], truth[spoken], atol=1e-4, rtol=0)
    assert truth[spoken].abs().max() < 4 * spacing(NODES)


def test_points_on_a_sphere_give_its_distance_to_second_order() -> None:
    nodes = 33
    normals = torch.nn.functional.normalize(
        torch.randn(9000, 3, generator=torch.Generator().manual_seed(2)), dim=-1
    )
    result = point_distances(0.6 * normals, normals, torch.ones(9000), nodes)
    truth = node_positions(nodes, CPU).norm(dim=-1) - 0.6
    near = truth.abs() < spacing(nodes)
    assert (result.weight > 0)[near].all()
    assert (result.distance - truth)[near].abs().max() < 2 * spacing(nodes) ** 2
    assert (result.weight == 0)[truth.abs() > 4 * spacing(nodes)].all()


def distances_one_by_one(points: Tensor, normals: Tensor, confidence: Tensor, spread: float) -> Tensor:
    """Sums of weight x distance and of weight, point by point, in float64."""
    h = spacing(NODES)
    sums = np.zeros((NODES, NODES, NODES, 2))
    for p, n, c in zip(points.double().numpy(), normals.double().numpy(), confidence.tolist(), strict=True):
        for node in np.ndindex(NODES, NODES, NODES):
            apart = np.array(node) * h - 1 - p
            cells = np.array(node) - np.floor((p + 1) / h)
            if (cells < -1).any() or (cells > 2).any():
                continue
            along = apart @ n
            across = np.linalg.norm(apart - along * n)
            weight = c * np.exp(-((across / (spread * h)) ** 2) - (along / (2 * spread * h)) ** 2)
            sums[node] += weight * along, weight
    return torch.tensor(sums)


@pytest.mark.parametrize("spread", [0.7, 1.0, 1.4])
def test_point_distances_match_the_definition(spread: float) -> None:
    """Points outside the cube, too, speak to the nodes they are near."""
    points = torch.cat([0.9 * random_points(12), torch.tensor([[1.2, 0.0, 0.0], [-1.1, -1.1, 0.3]])])
    normals = torch.nn.functional.normalize(random_points(14).flip(0), dim=-1)
    confidence = torch.linspace(0.2, 1, 14)
    sums = distances_one_by_one(points, normals, confidence, spread)
    result = point_distances(points, normals, confidence, NODES, spread_cells=spread)
    spoken = sums[..., 1] > 1e-3
    torch.testing.assert_close(
        result.weight, torch.where(spoken, sums[..., 1], 0.0).float(), atol=1e-5, rtol=0
    )
    expected = (sums[..., 0] / sums[..., 1].clamp(min=1e-9)).float()
    torch.testing.assert_close(result.distance[spoken], expected[spoken], atol=1e-4, rtol=0)


@pytest.mark.parametrize("points", [torch.zeros(0, 3), torch.full((2, 3), 1e4)])
def test_no_points_near_say_nothing(points: Tensor) -> None:
    result = point_distances(points, points, torch.ones(len(points)), NODES)
    assert (result.weight == 0).all()
    assert result.distance.isfinite().all()


def test_a_confident_point_outweighs_a_doubtful_one() -> None:
    """Two parallel planes, one cell apart: the nodes take the weighted mean."""
    h = spacing(NODES)
    points = torch.tensor([[0.0, 0.0, -h / 2], [0.0, 0.0, h / 2]])
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(2, 3)
    middle = NODES // 2
    result = point_distances(points, up, torch.tensor([0.9, 0.1]), NODES)
    assert result.distance[middle, middle, middle].item() == pytest.approx(
        0.9 * h / 2 - 0.1 * h / 2, rel=1e-4
    )


# points as one


def oriented_points(num: int) -> tuple[Tensor, Tensor, Tensor]:
    """Positions in the cube, unit normals of all directions and confidences, some of them 0."""
    generator = torch.Generator().manual_seed(4)
    normals = torch.nn.functional.normalize(torch.randn(num, 3, generator=generator), dim=-1)
    confidence = torch.rand(num, generator=generator)
    return random_points(num), normals, torch.where(confidence < 0.2, 0.0, confidence)


def sorted_rows(positions: Tensor, normals: Tensor, confidence: Tensor) -> Tensor:
    """All that is known of the points, in an order of their own."""
    rows = torch.cat([positions, normals, confidence[:, None]], dim=-1).double().numpy()
    return torch.tensor(rows[np.lexsort(np.round(rows, 4).T)])


def merged_one_by_one(positions: Tensor, normals: Tensor, confidence: Tensor, cell: float) -> Tensor:
    """By a dictionary, point by point, in float64."""
    sums: dict[tuple[int, ...], np.ndarray] = {}
    points = (x.double().numpy() for x in (positions, normals, confidence))
    for p, n, c in zip(*points, strict=True):
        axis = int(np.abs(n).argmax())
        key = (*np.floor(p / cell).astype(int).tolist(), axis, bool(n[axis] > 0))
        sums[key] = sums.get(key, np.zeros(7)) + c * np.array([*p, *n, 1.0])
    rows = torch.tensor(np.stack([row for row in sums.values() if row[6] > 0]))
    normal = torch.nn.functional.normalize(rows[:, 3:6], dim=-1)
    return sorted_rows(rows[:, :3] / rows[:, 6:], normal, rows[:, 6])


@pytest.mark.parametrize("cell", [0.07, 0.3, 5.0])
def test_merged_points_match_the_definition(cell: float) -> None:
    """A cube of 5 holds an eighth of all: each of its sides is one point."""
    points = oriented_points(3000)
    merged = merged_points(*points, cell)
    torch.testing.assert_close(sorted_rows(*merged), merged_one_by_one(*points, cell), atol=2e-5, rtol=1e-5)
    assert merged[2].sum().item() == pytest.approx(points[2].sum().item(), rel=1e-5)
    torch.testing.assert_close(
        (merged[2][:, None] * merged[0]).sum(dim=0), points[2] @ points[0], atol=1e-4, rtol=0
    )


def test_points_with_one_error_count_as_one_measurement() -> None:
    """Many say no more than one, a surer one beside them does; places and normals are the same means."""
    points = oriented_points(3000)
    alone, apart = merged_points(*points, 0.3), merged_points(*points, 0.3, correlated=True)
    torch.testing.assert_close(apart[:2], alone[:2])

    def together(*confidence: float) -> float:
        count = len(confidence)
        position, normal = torch.full((count, 3), 0.5), torch.tensor([[0.0, 0.0, 1.0]]).repeat(count, 1)
        return float(merged_points(position, normal, torch.tensor(confidence), 1.0, correlated=True)[2])

    assert together(*[0.5] * 400) == pytest.approx(together(0.5)) == pytest.approx(0.5)
    assert together(0.1, 0.9) == pytest.approx((0.1 * 0.1 + 0.9 * 0.9) / (0.1 + 0.9))


def test_the_order_of_points_does_not_matter() -> None:
    points = oriented_points(3000)
    shuffled = torch.randperm(3000, generator=torch.Generator().manual_seed(5))
    first = merged_points(*points, 0.2)
    second = merged_points(*(x[shuffled] for x in points), 0.2)
    torch.testing.assert_close(sorted_rows(*first), sorted_rows(*second), atol=1e-5, rtol=1e-5)


def test_points_without_confidence_leave_no_trace() -> None:
    positions, normals, confidence = oriented_points(3000)
    sure = confidence > 0
    assert 300 < (~sure).sum() < 1000
    merged = merged_points(positions, normals, confidence, 0.05)
    alone = merged_points(positions[sure], normals[sure], confidence[sure], 0.05)
    torch.testing.assert_close(sorted_rows(*merged), sorted_rows(*alone), atol=1e-5, rtol=1e-5)
    assert all(x.isfinite().all() for x in merged)
    for nothing in (
        merged_points(positions, normals, 0 * confidence, 0.05),
        merged_points(positions[:0], normals[:0], confidence[:0], 0.05),
    ):
        assert [x.shape for x in nothing] == [(0, 3), (0, 3), (0,)]


def test_the_faces_of_a_thin_sheet_stay_apart() -> None:
    """A tenth of a cube thick and slightly bent: each cube holds a point of each face, never their mean."""
    cell = 0.1
    flat = random_points(4000) * torch.tensor([1.0, 1.0, 0.0]) + torch.tensor([0.0, 0.0, cell / 2])
    up = torch.nn.functional.normalize(torch.tensor([0.0, 0.0, 1.0]) + 0.2 * random_points(4000), dim=-1)
    offset = torch.tensor([0.0, 0.0, 0.05 * cell])
    positions, normals, confidence = merged_points(
        torch.cat([flat + offset, flat - offset]), torch.cat([up, -up]), torch.ones(8000), cell
    )
    upper = normals[:, 2] > 0
    assert upper.sum() == (~upper).sum() == 400
    assert normals[:, 2].abs().min() > 0.9
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(800))
    torch.testing.assert_close(positions[upper, 2], torch.full((400,), 0.55 * cell))
    torch.testing.assert_close(positions[~upper, 2], torch.full((400,), 0.45 * cell))
    torch.testing.assert_close(confidence.sum(), torch.tensor(8000.0))


@pytest.mark.parametrize("curved", [False, True])
def test_merged_points_say_what_all_points_say(curved: bool) -> None:
    """Of a plane the same distance, of a ball to second order in the cell; of both the same weight."""
    nodes, num = 33, 60_000
    h = spacing(nodes)
    across = torch.nn.functional.normalize(
        torch.randn(num, 3, generator=torch.Generator().manual_seed(6)), dim=-1
    )
    normal = torch.nn.functional.normalize(torch.tensor([0.5, -0.3, 1.0]), dim=0)
    spread = random_points(num)
    flat = spread - ((spread @ normal) - 0.1)[:, None] * normal
    positions, normals = (0.6 * across, across) if curved else (flat, normal.expand(num, 3))
    merged = merged_points(positions, normals, torch.ones(num), h / 2)
    assert len(merged[0]) < num / 4
    whole = point_distances(positions, normals, torch.ones(num), nodes)
    few = point_distances(*merged, nodes)
    near = whole.weight > 0.1 * whole.weight.max()
    assert near.sum() > 3000
    apart = (few.distance - whole.distance)[near].abs()
    assert apart.max() < (h**2 if curved else 1e-4)
    torch.testing.assert_close(few.weight[near], whole.weight[near], rtol=0.15, atol=0)


# nodes in photographs


def test_nodes_read_the_image_where_it_shows_them() -> None:
    pixel, depth, shown = shown_nodes()
    columns = (torch.arange(60) + 0.5).expand(40, 60).contiguous()
    value, read_depth, read_shown = read_at_nodes(camera(), columns, NODES)
    assert (read_shown == shown).all()
    torch.testing.assert_close(read_depth, depth)
    inner = shown & (pixel[..., 0] > 0.5) & (pixel[..., 0] < 59.5)
    torch.testing.assert_close(value[inner], pixel[..., 0][inner], atol=1e-3, rtol=0)


def test_distance_from_a_straight_outline_is_the_distance_at_that_depth() -> None:
    """The outline is the column 30, that is, the plane x = 0: off the subject is x > 0."""
    _, _, shown = shown_nodes()
    outline_px = (torch.arange(60) + 0.5 - 30).expand(40, 60).contiguous()
    distance = off_silhouette(camera(), outline_px, NODES)
    x = node_positions(NODES, CPU)[..., 0]
    torch.testing.assert_close(distance[shown], x[shown], atol=0.04, rtol=0)  # half a pixel at the border
    inner = shown & (x.abs() < 0.8)
    torch.testing.assert_close(distance[inner], x[inner], atol=1e-3, rtol=0)
    assert (distance[~shown] == -torch.inf).all()


def test_what_lies_before_the_measured_depth_is_seen_through() -> None:
    _, depth, shown = shown_nodes()
    wall = torch.full((40, 60), 3.1)
    assert (seen_through(camera(), wall, 0.2, NODES) == (shown & (depth < 2.9))).all()
    assert not seen_through(camera(), torch.zeros(40, 60), 0.2, NODES).any()


def test_a_camera_among_the_nodes_shows_only_those_before_it() -> None:
    near = Pinhole(
        intrinsics=camera().intrinsics, camera_from_object=torch.eye(4), width=60, height=40
    )  # at the centre, looking along z
    value, depth, shown = read_at_nodes(near, torch.ones(40, 60), NODES)
    assert shown.any()
    assert (depth[shown] > 0).all()
    assert value.isfinite().all()
