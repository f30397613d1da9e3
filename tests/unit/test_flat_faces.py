"""A board with a square painted on it, measured along the paint's border alone; and a ball with a spot."""

from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from backend.maths.geometry import Pinhole, pixel_centres, ray_directions, unproject
from backend.maths.grid import node_positions, read
from backend.stages.measurements import Measurements
from backend.stages.train.flat_faces import FlatFaces, flat_faces, no_faces
from backend.stages.train.linear_fit import LinearConfig, fit_level
from tests.turned_camera import ball_depth, turned_camera

SIZE = 320
NORMAL = F.normalize(torch.tensor([0.2, 0.3, -1.0]), dim=0)
ACROSS = F.normalize(torch.linalg.cross(NORMAL, torch.tensor([0.0, 1.0, 0.0])), dim=0)
UP = torch.linalg.cross(NORMAL, ACROSS)
BOARD, SQUARE = 0.7, 0.4
"""Half their sides."""
BORDER = 0.03
"""As far from an edge stereo measures."""
RADIUS, SPOT = 0.7, 0.8
"""Of the ball; cosine of the angle from the spot's middle to its border."""

Picture = Float[Tensor, "height width"]
Points = Float[Tensor, "height width 3"]


def camera(angle_deg: float) -> Pinhole:
    return turned_camera(angle_deg, focal_px=500.0, size=SIZE)


def rays(one: Pinhole) -> Points:
    return ray_directions(one, pixel_centres(SIZE, SIZE, torch.device("cpu")))


def at_depth(one: Pinhole, depth: Picture) -> Points:
    return unproject(one, pixel_centres(SIZE, SIZE, torch.device("cpu")), depth)


def board_depth(one: Pinhole) -> Picture:
    """Of the plane through the middle."""
    return -(one.position @ NORMAL) / (rays(one) @ NORMAL)


def from_middle(points: Points) -> Picture:
    """The larger of both coordinates on the board."""
    return torch.maximum((points @ ACROSS).abs(), (points @ UP).abs())


def measurements(
    cameras: list[Pinhole],
    images: list[Float[Tensor, "3 height width"]],
    on: list[Bool[Tensor, "height width"]],
    depths: list[Picture],
) -> Measurements:
    positions = torch.cat(
        [at_depth(one, depth)[depth > 0] for one, depth in zip(cameras, depths, strict=True)]
    )
    outlines = [torch.where(subject, -9.0, 9.0) for subject in on]
    return Measurements(
        cameras=cameras,
        images=images,
        masks=[None] * len(cameras),
        outlines=[*outlines],
        backdrops=[None] * len(cameras),
        certain=[*outlines],
        depths=depths,
        confidences=[0.8 * (depth > 0) for depth in depths],
        positions=positions,
        normals=NORMAL.expand_as(positions),
        colours=torch.zeros_like(positions),
        confidence=torch.full((len(positions),), 0.8),
        view_index=torch.zeros(len(positions), dtype=torch.long),
        region_centre=torch.zeros(3),
        region_radius=1.0,
    )


def board(
    *, exposure: float = 1.0, side_alone: bool = False, angles: tuple[float, ...] = (-15, 15)
) -> Measurements:
    """Measured along the square's border, or along one of its sides; the second photograph is exposed so."""
    cameras = [camera(angle) for angle in angles]
    images, on, depths = [], [], []
    for index, one in enumerate(cameras):
        depth = board_depth(one)
        points = at_depth(one, depth)
        painted = from_middle(points) < SQUARE
        on.append(from_middle(points) < BOARD)
        pale = torch.where(painted, 0.3, 0.7) * (exposure if index else 1.0)
        images.append((pale * on[-1]).expand(3, -1, -1))
        known = (from_middle(points) - SQUARE).abs() < BORDER
        if side_alone:
            known &= points @ UP > SQUARE - BORDER
        depths.append(torch.where(known, depth, 0.0))
    return measurements(cameras, images, on, depths)


def ball(*, lit_from_aside: float) -> Measurements:
    """A spot towards -z; measured around its border, which lies on a plane."""
    cameras = [camera(-15), camera(15)]
    light = F.normalize(torch.tensor([1.0, 0.5, -0.7]), dim=0)
    images, on, depths = [], [], []
    for one in cameras:
        depth = ball_depth(one, RADIUS)
        on.append(depth > 0)
        normals = F.normalize(at_depth(one, depth), dim=-1)
        spot = -normals[..., 2] > SPOT
        shade = 1 - lit_from_aside + lit_from_aside * (normals @ light).clamp(min=0)
        images.append((torch.where(spot, 0.3, 0.7) * shade * on[-1]).expand(3, -1, -1))
        depths.append(torch.where((-normals[..., 2] - SPOT).abs() < 0.02, depth, 0.0))
    return measurements(cameras, images, on, depths)


def off_plane(places: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
    return (places @ NORMAL).abs()


def assert_nothing(told: FlatFaces) -> None:
    assert len(told.positions) == 0
    assert told.decision.choice == "left out"


def test_the_inside_of_an_even_region_lies_on_the_plane_of_its_border() -> None:
    scene = board()
    told = flat_faces(scene)
    assert off_plane(told.positions).max() < 1e-4
    torch.testing.assert_close(told.normals, NORMAL.expand_as(told.normals), rtol=0, atol=1e-3)
    squares = torch.floor(torch.stack([told.positions @ ACROSS, told.positions @ UP], -1) / 0.05)
    assert len(torch.unique(squares, dim=0)) > 0.75 * (2 * SQUARE / 0.05) ** 2, "all of it"
    assert told.views.unique().tolist() == [0, 1]
    assert len(torch.unique(told.faces)) == int(told.decision.because.split()[0]) >= 2
    assert told.decision.choice == "used"


def test_they_stand_behind_the_points_of_a_scene() -> None:
    scene = board()
    told = flat_faces(scene)
    both, count = told.beside(scene), len(scene.positions)
    torch.testing.assert_close(both.positions[:count], scene.positions)
    torch.testing.assert_close(both.positions[count:], told.positions)
    assert len(both.normals) == len(both.colours) == len(both.confidence) == count + len(told.views)
    alone = no_faces(scene).beside(scene)
    torch.testing.assert_close(alone.positions, scene.positions)


def test_what_turns_is_shaded_and_not_told() -> None:
    """The spot's border lies on a plane, 0.1 behind its middle."""
    assert_nothing(flat_faces(ball(lit_from_aside=0.9)))


def test_where_light_comes_from_everywhere_nothing_tells_a_spot_from_a_disc() -> None:
    """The limit of it: without shading a dome looks flat."""
    assert len(flat_faces(ball(lit_from_aside=0.0)).positions) > 0


def test_one_photograph_alone_tells_nothing() -> None:
    assert_nothing(flat_faces(board(angles=(-15,))))


@pytest.mark.parametrize(("exposure", "told"), [(1.2, True), (0.8, True), (0.4, False)])
def test_the_other_photograph_may_be_a_little_brighter(exposure: float, told: bool) -> None:
    assert (len(flat_faces(board(exposure=exposure)).positions) > 0) == told


def test_a_border_that_is_elsewhere_in_the_other_photograph_is_not_on_the_plane() -> None:
    """As that of something behind, which an edge in front hides."""
    scene = board()
    aside = [scene.images[0], scene.images[1].roll(12, dims=2)]
    assert_nothing(flat_faces(replace(scene, images=aside)))


def test_a_border_measured_on_one_side_tells_nothing() -> None:
    assert_nothing(flat_faces(board(side_alone=True)))


def test_what_another_photograph_sees_through_is_no_face() -> None:
    """The square is a hole: a third photograph measures what is behind, or shows the backdrop there."""
    three = board(angles=(-15, 15, 5))
    assert len(flat_faces(three).positions) > 0
    hole = from_middle(at_depth(three.cameras[2], board_depth(three.cameras[2]))) < SQUARE - BORDER
    behind = torch.where(hole, three.cameras[2].position.norm() + 0.4, three.depths[2])
    seen = [*three.depths[:2], behind]
    assert_nothing(flat_faces(replace(three, depths=seen, confidences=[0.8 * (d > 0) for d in seen])))
    backdrop = torch.where(hole, 9.0, -9.0)
    assert_nothing(flat_faces(replace(three, certain=[*three.certain[:2], backdrop])))


def test_a_photograph_that_does_not_know_its_subject_tells_nothing() -> None:
    """An even wall seen through a handle has a border on a plane too."""
    assert_nothing(flat_faces(replace(board(), certain=[None, None])))


def test_a_fit_is_flat_there() -> None:
    """From a ball that bulges before the board, with points along the border alone and with the face."""
    scene = board()
    bulge = node_positions(32, torch.device("cpu")).norm(dim=-1) - 0.5
    across = torch.linspace(-0.3, 0.3, 9)
    inside = (across[:, None, None] * ACROSS + across[None, :, None] * UP).reshape(-1, 3)

    def off(measured: Measurements) -> float:
        return float(read(fit_level(measured, bulge, 0.5, 5, LinearConfig()), inside).abs().mean())

    assert off(flat_faces(scene).beside(scene)) < 0.2 * off(scene)
