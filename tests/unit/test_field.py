"""The field repeats the grid it is made from, learns near the surface only, and gives bounded colours."""

import pytest
import torch
from torch import Tensor, nn

from backend.maths.grid import interpolate, locate, near_surface, node_positions, value_and_gradient
from backend.stages.train.field import SurfaceField

CPU = torch.device("cpu")
NODES = 9


def ball() -> Tensor:
    distance: Tensor = node_positions(NODES, CPU).norm(dim=-1) - 0.55
    return distance


def make_field(*, view_dependent: bool = False, channels: int = 5, seed: int = 0) -> SurfaceField:
    return SurfaceField(
        ball(),
        band_cells=1,
        channels=channels,
        view_dependent=view_dependent,
        generator=torch.Generator().manual_seed(seed),
    )


def random_points(num: int) -> Tensor:
    return torch.rand(num, 3, generator=torch.Generator().manual_seed(1)) * 2 - 1


def unit(num: int, seed: int) -> Tensor:
    draws = torch.randn(num, 3, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.normalize(draws, dim=-1)


def test_distances_and_gradients_are_those_of_the_grid() -> None:
    field = make_field()
    corners = field.locate(random_points(100))
    value, gradient = value_and_gradient(ball(), locate(random_points(100), NODES))
    torch.testing.assert_close(field.distance(corners), value)
    again, slope = field.distance_and_gradient(corners)
    torch.testing.assert_close(again, value)
    torch.testing.assert_close(slope, gradient)


def test_the_whole_grid_comes_back() -> None:
    field = make_field()
    torch.testing.assert_close(field.whole(), ball())
    field.whole().zero_()  # a copy, free to be changed
    torch.testing.assert_close(field.whole(), ball())


def test_only_nodes_near_the_surface_are_learnt() -> None:
    field = make_field()
    near = near_surface(ball(), 1)
    assert 0 < len(field.distances) == near.sum() < near.numel()
    with torch.no_grad():
        field.distances.add_(1.0)
    torch.testing.assert_close(field.whole(), ball() + near.float())
    points = random_points(50)
    torch.testing.assert_close(
        field.distance(field.locate(points)), interpolate(field.whole(), locate(points, NODES))
    )


def test_how_it_began_is_no_change_however_bent() -> None:
    """Only what was learnt since counts, and that reaches the parameters."""
    field = make_field()
    every = torch.arange(NODES**3)
    assert not field.change(every).any()
    with torch.no_grad():
        field.distances.add_(0.25)
    near = near_surface(ball(), 1).flatten()
    torch.testing.assert_close(field.change(every), 0.25 * near.float())
    torch.autograd.backward(field.change(every).sum())
    assert field.distances.grad is not None
    assert (field.distances.grad == 1).all()


def test_the_grid_it_is_made_from_is_left_alone() -> None:
    grid = ball()
    field = SurfaceField(
        grid, band_cells=1, channels=3, view_dependent=False, generator=torch.Generator().manual_seed(0)
    )
    with torch.no_grad():
        field.distances.zero_()
    torch.testing.assert_close(grid, ball())


def test_learning_reaches_the_parameters_around_a_point_and_no_others() -> None:
    field = make_field()
    point = torch.tensor([[0.5, 0.1, 0.2]])
    value, gradient = field.distance_and_gradient(field.locate(point))
    (value.sum() + gradient.square().sum()).backward()  # type: ignore[no-untyped-call]
    assert field.distances.grad is not None
    touched = torch.zeros(NODES**3)
    touched[field.active] = field.distances.grad.abs()
    around = locate(point, NODES).index.flatten()
    assert (touched[around] > 0).all()
    touched[around] = 0
    assert (touched == 0).all()


class Outputs(nn.Module):
    """All that a field says at given points, as a function of its parameters."""

    def __init__(self, field: SurfaceField, points: Tensor) -> None:
        super().__init__()
        self.field = field
        self.corners = field.locate(points)

    def forward(self) -> tuple[Tensor, Tensor, Tensor]:
        normal, direction = unit(3, 4).double(), unit(3, 5).double()
        colour = self.field.colour(self.corners, normal, direction)
        return *self.field.distance_and_gradient(self.corners), colour


def test_gradients_agree_with_finite_differences() -> None:
    """Of colour, distance and slope, in every parameter."""
    field = make_field(view_dependent=True).double()
    points = 0.55 * unit(3, 2).double()
    with torch.no_grad():
        field.features.normal_(generator=torch.Generator().manual_seed(3))
    outputs = Outputs(field, points)
    names = [name for name, _ in outputs.named_parameters()]

    def of_parameters(*parameters: Tensor) -> tuple[Tensor, ...]:
        given = dict(zip(names, parameters, strict=True))
        return torch.func.functional_call(outputs, given, ())  # type: ignore[no-any-return]

    assert torch.autograd.gradcheck(of_parameters, tuple(outputs.parameters()), fast_mode=True)


def test_the_first_features_are_the_logits_of_the_colour() -> None:
    """With the network silent, colour is their sigmoid."""
    field = make_field()
    with torch.no_grad():
        field.last.zero_()
        field.features[:, :3] = torch.tensor([-1.0, 0.0, 2.0])
    points = 0.55 * unit(20, 2)
    colour = field.colour(field.locate(points), unit(20, 3), unit(20, 4))
    expected = torch.sigmoid(torch.tensor([-1.0, 0.0, 2.0])).expand(20, 3)
    torch.testing.assert_close(colour, expected, atol=1e-3, rtol=0)


@pytest.mark.parametrize("view_dependent", [False, True])
def test_colour_follows_the_view_only_where_it_may(view_dependent: bool) -> None:
    field = make_field(view_dependent=view_dependent)
    corners, normal = field.locate(0.55 * unit(20, 2)), unit(20, 3)
    seen, turned = field.colour(corners, normal, unit(20, 4)), field.colour(corners, normal, unit(20, 5))
    assert torch.equal(seen, turned) != view_dependent
    assert not torch.equal(seen, field.colour(corners, -normal, unit(20, 4)))


def test_colour_is_bounded_and_finite_for_wild_features() -> None:
    field = make_field()
    with torch.no_grad():
        field.features[:] = 1e4
        field.features[::2] = -1e4
    colour = field.colour(field.locate(random_points(50)), torch.zeros(50, 3), torch.zeros(50, 3))
    colour.sum().backward()  # type: ignore[no-untyped-call]
    assert ((colour >= 0) & (colour <= 1)).all()
    assert all(p.grad.isfinite().all() for p in field.parameters() if p.grad is not None)


def test_the_same_seed_starts_alike() -> None:
    first, again, other = make_field(seed=4), make_field(seed=4), make_field(seed=5)
    assert torch.equal(first.first, again.first)
    assert torch.equal(first.last, again.last)
    assert not torch.equal(first.first, other.first)
