"""A matt ball under an even light, whose field is too large where nothing was measured: brightness tells."""

import math
import time
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from backend.maths.geometry import Pinhole, pixel_centres, project, unproject
from backend.maths.grid import locate, node_positions, read, spacing, value_and_gradient
from backend.maths.mirrored_light import BINS
from backend.maths.srgb import srgb_from_linear
from backend.scene import Decision
from backend.stages.deadline import deadline_after
from backend.stages.measurements import SURE, Measurements
from backend.stages.train import shared_brightness as stage
from backend.stages.train.linear_fit import LinearConfig, ask_nothing, fit_level, for_plain
from backend.stages.train.looks import Looks
from backend.stages.train.shared_brightness import ShownPlaces, share_told, shared_brightness, textured
from backend.stages.train.shine import Boxes, deviations, mirrored_by
from tests.turned_camera import ball_depth, turned_camera

NODES, SIZE, RADIUS = 64, 320, 0.6
TOO_LARGE = 0.03
"""By how much the field is, above: about a cell."""
SHARPNESS = 2
"""Of what it mirrors of the light: Phong's exponent."""
LIGHT = F.normalize(torch.tensor([1.0, 0.7, -0.5]), dim=0)

Field = Float[Tensor, "nodes nodes nodes"]


def camera(angle_deg: float) -> Pinhole:
    return turned_camera(angle_deg, focal_px=600.0, size=SIZE)


def too_large(by: float = TOO_LARGE) -> Field:
    """Right for y < 0, where points are."""
    nodes = node_positions(NODES, torch.device("cpu"))
    return nodes.norm(dim=-1) - RADIUS - by * (nodes[..., 1] / 0.1).clamp(0, 1)


def scene(
    *,
    shine: float = 0.0,
    exposure: float = 1.0,
    known_up_to: float = 0.0,
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> Measurements:
    """Points are sure where y < `known_up_to`; `shine` is what a mirroring lobe adds to brightness."""
    cameras = [camera(-12), camera(12)]
    images, outlines, depths, confidences, positions = [], [], [], [], []
    for index, one in enumerate(cameras):
        depth = ball_depth(one, RADIUS)
        on = depth > 0
        points = unproject(one, pixel_centres(SIZE, SIZE, torch.device("cpu")), depth)
        normals = points / RADIUS
        matt = 0.05 + 0.6 * (normals @ LIGHT).clamp(min=0)
        to_camera = F.normalize(one.position - points, dim=-1)
        mirrored = 2 * (normals * to_camera).sum(-1, keepdim=True) * normals - to_camera
        light = matt * torch.tensor(colour)[:, None, None]
        light = light + shine * (mirrored @ LIGHT).clamp(min=0) ** SHARPNESS
        srgb = srgb_from_linear((light * (exposure if index else 1.0)).clamp(max=1).numpy())
        images.append(torch.where(on, torch.tensor(srgb, dtype=torch.float32), 0.0))
        outlines.append(torch.where(on, -5.0, 5.0))
        known = on & (points[..., 1] < known_up_to)
        depths.append(torch.where(known, depth, 0.0))
        confidences.append(0.8 * known)
        positions.append(points[known])
    points = torch.cat(positions)
    return Measurements(
        cameras=cameras,
        images=images,
        masks=[None, None],
        outlines=[*outlines],
        backdrops=[None, None],
        certain=[*outlines],
        depths=depths,
        confidences=confidences,
        positions=points,
        normals=F.normalize(points, dim=-1),
        colours=torch.zeros_like(points),
        confidence=torch.full((len(points),), 0.8),
        view_index=torch.zeros(len(points), dtype=torch.long),
        region_centre=torch.zeros(3),
        region_radius=1.0,
    )


def error(places: Float[Tensor, "points 3"]) -> float:
    return float((places.norm(dim=-1) - RADIUS).abs().median())


@pytest.mark.parametrize("exposure", [1.0, 0.6])
def test_places_are_told_where_nothing_was_measured(exposure: float) -> None:
    shown = shared_brightness(scene(exposure=exposure), too_large())
    assert len(shown.weights) > 2000
    assert float((shown.positions[:, 1] > -0.05).float().mean()) > 0.99  # below are points already
    assert error(shown.positions[shown.positions[:, 1] > 0.1]) < 0.15 * TOO_LARGE
    assert float(shown.weights.min()) > 0
    assert float(shown.weights.max()) <= 1
    torch.testing.assert_close(shown.normals.norm(dim=-1), torch.ones(len(shown.normals)))


def test_ripples_of_a_field_are_not_told_again() -> None:
    ripples = 0.1 * spacing(NODES) * torch.randn((NODES,) * 3, generator=torch.Generator().manual_seed(0))
    rippled = too_large(0.0) + ripples
    told = shared_brightness(scene(known_up_to=-0.3), rippled)
    _, gradient = value_and_gradient(rippled, locate(told.positions, NODES))
    outwards = F.normalize(told.positions, dim=-1)
    off, of_field = (
        1 - (F.normalize(normals, dim=-1) * outwards).sum(-1).mean() for normals in (told.normals, gradient)
    )
    assert off < 0.4 * of_field


def test_a_second_look_is_nearer_than_the_first() -> None:
    measured = scene()
    first = shared_brightness(measured, too_large())
    nearer = too_large(0.2 * TOO_LARGE)
    second = shared_brightness(measured, nearer)
    assert error(second.positions) < error(first.positions)


def test_the_more_it_shines_the_less_brightness_counts() -> None:
    matt, satin, glossy = (
        float(shared_brightness(scene(shine=shine), too_large()).weights.sum()) for shine in (0, 0.05, 0.4)
    )
    assert satin < 0.7 * matt
    assert glossy < 0.05 * matt


def test_colour_tells_what_shine_hides() -> None:
    """A highlight seems to lie behind a convex surface; the red that it is laid over does not."""
    grey, red = (
        shared_brightness(scene(shine=0.05, colour=colour), too_large()).positions
        for colour in ((0.5, 0.5, 0.5), (1.0, 0.3, 0.2))
    )
    assert error(red[red[:, 1] > 0.1]) < 0.1 * TOO_LARGE
    assert error(red[red[:, 1] > 0.1]) < 0.2 * error(grey[grey[:, 1] > 0.1])


def test_what_shines_has_what_it_mirrors_taken_off() -> None:
    """Red tells the place better for it; grey, of which little is left to tell by, is believed less."""
    red, grey = (scene(shine=0.05, colour=colour) for colour in ((1.0, 0.3, 0.2), (1.0, 1.0, 1.0)))
    told, as_matt = (shared_brightness(red, too_large(), may_shine=may) for may in (True, False))
    assert float(told.mirrored.max()) > 0.01
    assert float(as_matt.mirrored.max()) == 0
    assert len(told.weights) > 1.3 * len(as_matt.weights)
    assert error(told.positions) < 0.5 * error(as_matt.positions)
    told, as_matt = (shared_brightness(grey, too_large(), may_shine=may) for may in (True, False))
    assert error(told.positions) < error(as_matt.positions)
    assert float(told.weights.sum()) < 0.3 * float(as_matt.weights.sum())


def test_what_is_matt_is_left_as_it_is() -> None:
    matt = scene()
    told, as_matt = (vars(shared_brightness(matt, too_large(), may_shine=may)) for may in (True, False))
    torch.testing.assert_close(told, as_matt, rtol=0, atol=0)


def test_nobody_shines_of_whom_patches_tell_everything() -> None:
    """Nothing is left that mirrored light could be fitted to."""
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(60, BINS, generator=generator)
    difference = torch.randn(60, 3, generator=generator)
    sure = torch.ones(60, dtype=torch.bool)
    boxes = Boxes(difference=difference, slope=torch.zeros_like(difference), mirrored=rows, sure=sure)
    assert mirrored_by(boxes, deviations(difference), 0.03) is None


def test_pictures_of_much_are_looked_at_smaller(monkeypatch: pytest.MonkeyPatch) -> None:
    everything = shared_brightness(scene(), too_large())
    monkeypatch.setattr(stage, "_MOST_PIXELS", 3000)  # of some 11 000
    fewer = shared_brightness(scene(), too_large())
    assert 0.1 * len(everything.weights) < len(fewer.weights) < 0.4 * len(everything.weights)
    assert error(fewer.positions[fewer.positions[:, 1] > 0.15]) < 0.15 * TOO_LARGE


def test_sure_places_are_judged_apart_from_silent_ones_among_them() -> None:
    """Stripes as wide as half a box, by turns sure and right, and silent and off."""

    def wave(y: Float[Tensor, "*places"]) -> Float[Tensor, "*places"]:
        return torch.sin(2 * math.pi * y / (6 * spacing(NODES)))

    nodes, pixels = node_positions(NODES, torch.device("cpu")), pixel_centres(SIZE, SIZE, torch.device("cpu"))
    field = nodes.norm(dim=-1) - RADIUS - TOO_LARGE * (2 * wave(nodes[..., 1])).clamp(0, 1)
    known = scene(known_up_to=1.0)
    confidences = [
        confidence * (wave(unproject(one, pixels, depth)[..., 1]) < -0.2)
        for one, depth, confidence in zip(known.cameras, known.depths, known.confidences, strict=True)
    ]
    off, right = (
        shared_brightness(replace(known, confidences=confidences), one).weights
        for one in (field, too_large(0.0))
    )
    assert min(len(off), len(right)) > 1000
    # what is off leaves something unexplained, 0.58 of the weight; judged together it would be 0.42
    assert float(off.mean()) > 0.5 * float(right.mean())


def with_grain(clean: Measurements, deviation: float) -> Measurements:
    generator = torch.Generator().manual_seed(0)
    images = [
        (image + deviation * torch.randn(image.shape, generator=generator)).clamp(0, 1)
        for image in clean.images
    ]
    return replace(clean, images=images)


def test_grain_of_colours_is_not_taken_for_their_slope() -> None:
    """Of what is grey: it would agree with the field as it is, and hold it there."""
    told = shared_brightness(with_grain(scene(), 5 / 255), too_large()).positions
    assert error(told[told[:, 1] > 0.12]) < 0.115 * TOO_LARGE


def test_small_windows_that_go_wild_are_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    """In noisy photographs: what a wide window does not confirm is far off more often than the rest."""
    noisy = with_grain(scene(), 0.03)

    def far_off() -> Tensor:
        told = shared_brightness(noisy, too_large())
        return (told.positions.norm(dim=-1) - RADIUS).abs() > spacing(NODES)

    confirmed = far_off()
    monkeypatch.setattr(stage, "_ALIKE_CELLS", math.inf)
    everything = far_off()
    lost = len(everything) - len(confirmed)
    assert 0 < lost < 0.1 * len(everything)
    assert int(everything.sum() - confirmed.sum()) > 3 * lost * float(everything.float().mean())


@pytest.mark.parametrize("known_up_to", [-0.55, -1.0])
def test_nothing_is_told_without_places_to_judge_brightness_by(known_up_to: float) -> None:
    assert len(shared_brightness(scene(known_up_to=known_up_to), too_large()).weights) == 0


def test_nothing_is_told_where_patches_tell_everything() -> None:
    assert len(shared_brightness(scene(known_up_to=1.0), too_large(0.0)).weights) == 0


def test_nothing_is_told_of_an_even_brightness() -> None:
    measured = scene()
    even = replace(measured, images=[torch.full_like(image, 0.5) for image in measured.images])
    assert len(shared_brightness(even, too_large()).weights) == 0


def test_what_is_at_an_outline_is_left_to_the_outline() -> None:
    """The outline of a third photograph that shows a part of the ball alone."""
    measured = scene()
    everything = shared_brightness(measured, too_large())
    across = pixel_centres(SIZE, SIZE, torch.device("cpu"))[..., 0] - 70
    third = replace(
        measured,
        cameras=[*measured.cameras, camera(-90)],
        images=[*measured.images, torch.zeros((3, SIZE, SIZE))],
        certain=[*measured.certain, across],
        confidences=[*measured.confidences, torch.zeros((SIZE, SIZE))],
    )
    told = shared_brightness(third, too_large())
    pixels, _ = project(camera(-90), told.positions)
    assert float(pixels[:, 0].max()) < 66.5
    pixels, _ = project(camera(-90), everything.positions)
    assert len(told.weights) == pytest.approx(int((pixels[:, 0] < 66).sum()), rel=0.02)


def test_a_fit_goes_to_what_was_told() -> None:
    measured, before = scene(), too_large()
    shown = shared_brightness(measured, before)
    told = shown.chosen(shown.positions[:, 1] > 0.1)
    fields = [
        fit_level(measured, before, RADIUS, 3, LinearConfig(), ask=ask, looks=1)
        for ask in (ask_nothing, lambda distance: told)
    ]
    fields.append(fit_level(measured, before, RADIUS, 3, LinearConfig(), told=told))
    off = [float(read(field, told.positions).abs().median()) for field in fields]
    assert off[1] < 0.5 * off[0]
    assert off[1] < 0.3 * spacing(NODES)
    assert off[2] < off[1]  # what is told before all rounds is heard in all of them


def test_what_is_told_last_stands_in_place_of_what_was_told_before() -> None:
    measured = scene()
    wrong, right = (shared_brightness(measured, too_large(by)) for by in (4 * TOO_LARGE, TOO_LARGE))
    fields = [
        fit_level(measured, too_large(), RADIUS, 1, LinearConfig(), told=told, ask=lambda _: right, looks=1)
        for told in (wrong, None)
    ]
    torch.testing.assert_close(*fields, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("by", "share"), [(2.5 * spacing(NODES), (0.8, 1.0)), (0.25 * spacing(NODES), (0, 0.1)), (-0.06, (0, 0))]
)
def test_what_a_field_surely_hides_lies_well_behind_it(by: float, share: tuple[float, float]) -> None:
    """Above, where the field is off by all of it."""
    told = shared_brightness(scene(), too_large(by))
    above = told.chosen(told.positions[:, 1] > 0.15)
    assert len(above.weights) > 500
    assert share[0] <= above.hidden.float().mean() <= share[1]
    towards = torch.stack([F.normalize(told.positions - camera(a).position, dim=-1) for a in (-12, 12)])
    assert (towards * told.directions).sum(dim=-1).amax(dim=0).min() > 0.9999


def test_what_is_hidden_is_sure_by_six_deviations() -> None:
    """A step goes from the field, above a ball that is larger, along the ray; weights tell deviations."""
    by = 0.75 * spacing(NODES)
    told = shared_brightness(scene(shine=0.1), too_large(by), may_shine=False)
    above = told.chosen((told.positions[:, 1] > 0.15) & (told.weights < 1))
    middle = (above.positions * above.directions).sum(dim=-1)
    off_middle = above.positions.square().sum(dim=-1) - middle.square()
    step = middle + ((RADIUS + by) ** 2 - off_middle).clamp(min=0).sqrt()
    least = 6 * stage._SURE_DEVIATION / above.weights.sqrt()
    clear = (step / least - 1).abs() > 0.05
    assert 20 < (~above.hidden[clear]).sum() < above.hidden[clear].sum()
    assert ((step > least) == above.hidden)[clear].float().mean() > 0.98


def test_a_bridge_is_pushed_away_from_before_what_it_hid() -> None:
    """A field that ends 0.1 before a plane that is told, hardly surely, but on one side as hidden."""
    h, along = spacing(NODES), torch.linspace(-0.3, 0.3, 40)
    x, y = torch.meshgrid(along, along, indexing="ij")
    told = torch.stack([x, y, torch.full_like(x, 0.1)], dim=-1).reshape(-1, 3)
    count, backward = len(told), torch.tensor([0.0, 0.0, 1.0])
    places = ShownPlaces(
        positions=told,
        normals=-backward.expand(count, 3),
        weights=torch.full((count,), 1e-3),
        mirrored=torch.zeros(count),
        directions=backward.expand(count, 3),
        hidden=told[:, 0] > 0,
    )
    bridge = torch.maximum(-node_positions(NODES, torch.device("cpu"))[..., 2], too_large(0.0))
    after = fit_level(scene(), bridge, RADIUS, 3, LinearConfig(settled=0.0), ask=lambda _: places, looks=3)
    pushed, left = (read(after, torch.tensor([[side * 0.15, 0.2, 0.06]])).item() for side in (1, -1))
    assert left < 0 < 2 * h < pushed


@pytest.mark.parametrize("subject_known", [True, False])
def test_patches_are_textured_by_their_share_of_the_surface(subject_known: bool) -> None:
    """What the photographs show beside the ball counts for nothing, though some of it was measured."""

    def share(known_up_to: float) -> float:
        ball = scene(known_up_to=known_up_to)
        around = [
            torch.where(on < 0, c, 0.8)
            for on, c in zip(ball.certain, ball.confidences, strict=True)
            if on is not None
        ]
        unknown: list[Tensor | None] = [None, None]
        return textured(
            replace(ball, confidences=around, certain=ball.certain if subject_known else unknown),
            too_large(0.0),
        )

    assert [share(y) for y in (-RADIUS, 0.0, RADIUS)] == pytest.approx([0.0, 0.5, 1.0], abs=0.03)


def test_brightness_tells_a_share_of_the_surface_cell_by_cell() -> None:
    """Places all over a part of the ball, many in a cell."""
    torch.manual_seed(0)
    ball = RADIUS * F.normalize(torch.randn(200_000, 3), dim=-1)
    for height, share in ((-1.0, 1.0), (0.0, 0.5), (0.5 * RADIUS, 0.25)):
        told = ball[ball[:, 1] > height]
        places = ShownPlaces(
            positions=told,
            normals=told,
            weights=torch.ones(len(told)),
            mirrored=torch.zeros(len(told)),
            directions=-told,
            hidden=torch.zeros(len(told), dtype=torch.bool),
        )
        assert share_told(places, too_large(0.0)) == pytest.approx(share, abs=0.03 + 0.1 * share)


def test_patches_that_are_not_sure_tell_less_of_the_surface() -> None:
    ball = scene(known_up_to=RADIUS)
    faint = replace(ball, confidences=[0.1 * (c > 0) for c in ball.confidences])
    assert textured(faint, too_large(0.0)) == pytest.approx(0.1 / SURE, abs=0.03)


def test_a_field_that_no_photograph_shows_has_no_texture() -> None:
    assert textured(scene(), torch.ones(NODES, NODES, NODES)) == 0


@pytest.mark.parametrize(
    ("textured", "told", "plain"), [(0.0, 1.0, 1.0), (0.0, 0.035, 0.5), (0.35, 1.0, 0.75)]
)
def test_stereo_gives_way_to_smoothness_and_rims_by_what_is_plain(
    textured: float, told: float, plain: float
) -> None:
    usual = LinearConfig()
    changed = for_plain(usual, textured, told)
    assert changed.stereo == pytest.approx((1 - plain) * usual.stereo)
    assert changed.smoothness == pytest.approx((1 + plain) * usual.smoothness)
    assert changed.rims == pytest.approx((1 + 2 * plain) * usual.rims)


def test_lines_of_points_with_tilted_normals_dent_what_is_plain_less() -> None:
    """Points on circles of the ball, as beside edges of paint: in place, but turned by 25 degrees."""
    torch.manual_seed(0)
    angle = torch.rand(4000) * 2 * math.pi
    height = torch.tensor([0.15, 0.3, 0.45])[torch.arange(4000) % 3]
    out = (1 - height**2).sqrt()
    normals = torch.stack([out * angle.cos(), height, out * angle.sin()], dim=-1)
    along = F.normalize(torch.cross(normals, torch.tensor([[0.0, 1.0, 0.0]]), dim=-1), dim=-1)
    uphill, tilt = torch.cross(along, normals, dim=-1), math.radians(25)
    tilted = math.cos(tilt) * normals + math.sin(tilt) * uphill
    ball = scene()
    painted = replace(
        ball,
        positions=torch.cat([ball.positions, RADIUS * normals]),
        normals=torch.cat([ball.normals, tilted]),
        colours=torch.zeros(len(ball.colours) + 4000, 3),
        confidence=torch.cat([ball.confidence, torch.full((4000,), 0.8)]),
        view_index=torch.zeros(len(ball.colours) + 4000, dtype=torch.long),
    )

    def dents_deg(config: LinearConfig) -> float:
        field = fit_level(painted, too_large(0.0), RADIUS, 5, config)
        _, gradient = value_and_gradient(field, locate(RADIUS * normals, NODES))
        cosine = (F.normalize(gradient, dim=-1) * normals).sum(dim=-1)
        return float(torch.rad2deg(cosine.clamp(max=1).acos()).mean())

    usual, half, plain = (
        dents_deg(config)
        for config in (LinearConfig(), *(for_plain(LinearConfig(), share, 1.0) for share in (0.55, 0.25)))
    )
    assert plain < 0.8 * usual
    assert plain < half < usual
    assert for_plain(LinearConfig(), 0.9, 1.0) == for_plain(LinearConfig(), 0.2, 0.0) == LinearConfig()
    config = for_plain(LinearConfig(), 0.25, 1.0)
    assert dents_deg(replace(config, stereo=1.0)) > 1.1 * plain
    assert dents_deg(replace(config, smoothness=LinearConfig().smoothness)) > 1.1 * plain


@pytest.mark.parametrize(("rounds", "looks", "times"), [(4, 2, 2), (3, 5, 3), (3, 0, 0)])
def test_brightness_is_asked_about_the_field_so_far_before_the_last_rounds(
    rounds: int, looks: int, times: int
) -> None:
    measured, asked = scene(), list[Field]()
    told = shared_brightness(measured, too_large())

    def ask(distance: Field) -> ShownPlaces:
        asked.append(distance)
        return told

    config = LinearConfig(settled=0.0)
    after = fit_level(measured, too_large(), RADIUS, rounds, config, ask=ask, looks=looks)
    assert len(asked) == times
    assert not any(torch.equal(field, after) for field in asked)
    if times < rounds and times:  # rounds without it come first, and give the field that it is asked about
        first = fit_level(measured, too_large(), RADIUS, rounds - times, config)
        torch.testing.assert_close(asked[0], first)


def test_a_surface_at_rest_goes_on_to_the_looks_and_one_that_they_do_not_move_ends() -> None:
    measured, asked = scene(), list[Field]()
    told = shared_brightness(measured, too_large())

    def ask(distance: Field) -> ShownPlaces:
        asked.append(distance)
        return told

    fit_level(measured, too_large(), RADIUS, 9, LinearConfig(settled=100.0), ask=ask, looks=4)
    assert len(asked) == 1


def test_who_has_nothing_to_tell_is_not_asked_again() -> None:
    measured, asked = scene(), list[Field]()
    config = LinearConfig(settled=0.0)
    fields = [
        fit_level(measured, too_large(), RADIUS, 4, config, ask=ask, looks=3)
        for ask in (asked.append, ask_nothing)
    ]
    assert len(asked) == 1
    torch.testing.assert_close(*fields, rtol=0, atol=0)


def test_the_report_says_what_it_was_worth() -> None:
    shown = shared_brightness(scene(), too_large())
    nothing = shared_brightness(scene(known_up_to=-1.0), too_large())

    def told(shares: list[float], shown: list[ShownPlaces]) -> Decision:
        linear, deadline = LinearConfig(), deadline_after(None, time.perf_counter)
        looks = Looks(scene=scene(), linear=linear, deadline=deadline, shares=shares, shown=shown)
        return looks.of_brightness

    used = told([0.5], [shown, nothing])
    assert used.choice == "used"
    assert str(len(shown.weights)) in used.because
    assert "shines" not in used.because
    shining = replace(shown, mirrored=torch.full_like(shown.mirrored, 0.021))
    assert "2.1%" in told([0.5], [nothing, shining]).because
    for shares, looks, why in (
        ([0.5], [nothing], "too little"),
        ([0.5, 0.93], [], "93%"),
        ([0.5], [], "time"),
        ([], [], "time"),
    ):
        left_out = told(shares, looks)
        assert left_out.choice == "left out"
        assert why in left_out.because
