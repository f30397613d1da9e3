"""The report of the cameras: its numbers against known answers, its diagrams to scale, its page whole."""

import json
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from markupsafe import Markup

from backend.report_page.diagrams import Bar, histogram, match_graph, shortened, top_view
from backend.scene import CameraEvidence, Decision, SolvedCameras, Unplaced
from backend.stages.cameras.camera_report import (
    CameraReport,
    build_camera_report,
    camera_report_html,
    camera_report_numbers,
    point_angles_deg,
)
from backend.stages.cameras.confirmation import (
    FEWEST_CONFIRMING,
    num_confirming,
    unconfirmed,
)
from tests.synthetic_scene import (
    DISTANCE,
    OBJECT_UNIT,
    SIZE,
    arc_cameras,
    photographed,
    surface_points,
    true_region,
)

LOST = "lost <1>.png"
DIAMETER = 2 * OBJECT_UNIT


@cache
def solved() -> SolvedCameras:
    """Three photographs placed and one not; 80 points, of which the third photograph sees half."""
    scene = photographed(arc_cameras(3, 40, 64))
    points = surface_points(np.tile([[0.0, -1.0, 0.0]], (80, 1)))
    visibility = np.ones((80, 3), bool)
    visibility[:40, 2] = False
    verified = np.zeros((4, 4), np.int64)
    verified[0, 1] = verified[1, 0] = 400
    verified[1, 3] = verified[3, 1] = 99
    verified[0, 3] = verified[3, 0] = 12
    covariance = np.zeros((3, 6, 6))
    covariance[:, range(6), range(6)] = np.square([0.001, 0.002, 0.003, 0.01, 0.04, 0.02])
    evidence = CameraEvidence(
        names=(scene.views[0].name, scene.views[1].name, LOST, scene.views[2].name),
        num_features=np.array([500, 600, 3, 700]),
        num_matched=2 * verified,
        num_verified=verified,
        error_px=np.where(visibility, np.linspace(0.1, 0.5, 80)[:, None] * [1, 2, 4], 0.0),
        pose_covariance=covariance,
        lenses_free=True,
        point_sigma_world=np.linspace(0.01, 0.03, 80),
    )
    return replace(
        scene.solved(points),
        estimated=True,
        sparse_visibility=visibility,
        evidence=evidence,
        reprojection_error_px=0.5,
        unplaced=(Unplaced(name=LOST, why="it is too dark"),),
        decisions=(Decision(what="lens", choice="900 px", because="they say so"),),
    )


def report_of(cameras: SolvedCameras) -> CameraReport:
    return build_camera_report(cameras, true_region(), job_name="Ball & ring", seed=3, versions={"A": "1"})


def test_photographs_are_told_in_the_order_they_were_given() -> None:
    first, second, lost, third = report_of(solved()).photos
    assert [p.name for p in (first, second, lost, third)] == list(solved().evidence.names)  # type: ignore[union-attr]
    assert (lost.why_unplaced, lost.num_features, lost.most_verified) == ("it is too dark", 3, 0)
    assert lost.num_points is lost.median_error_px is lost.place_sigma_percent is None
    assert (first.num_points, third.num_points) == (80, 40)
    assert (first.most_verified, second.most_verified, third.most_verified) == (400, 400, 99)


def test_errors_and_certainty_by_their_definitions() -> None:
    report = report_of(solved())
    errors = np.linspace(0.1, 0.5, 80)
    assert report.photos[0].median_error_px == pytest.approx(np.median(errors))
    assert report.photos[3].high_error_px == pytest.approx(np.quantile(4 * errors[40:], 0.95))
    assert report.photos[0].turn_sigma_deg == pytest.approx(np.degrees(0.003))
    assert report.photos[0].place_sigma_percent == pytest.approx(100 * 0.04 / DIAMETER)
    assert report.point_sigma_percent == pytest.approx(100 * 0.02 / DIAMETER)
    seen = np.concatenate([errors, 2 * errors, 4 * errors[40:]])
    assert report.median_error_px == pytest.approx(np.median(seen))


def test_tracks_and_angles_are_counted() -> None:
    """The cameras stand 20 degrees apart around the body's centre; its front lies nearer to them."""
    report = report_of(solved())
    assert report.track_lengths == (40, 40)
    assert sum(report.angle_counts) == 80
    centres = [view.camera.position for view in solved().views]
    rays = [c - solved().sparse_positions[0] for c in centres]
    unit = [ray / np.linalg.norm(ray) for ray in rays]
    angles = point_angles_deg(solved())
    assert angles[0] == pytest.approx(np.degrees(np.arccos(unit[0] @ unit[1])))
    assert angles[79] == pytest.approx(np.degrees(np.arccos(unit[0] @ unit[2])))
    assert report.median_angle_deg == pytest.approx((angles[0] + angles[79]) / 2)


def test_what_is_weak_is_said_with_a_remedy() -> None:
    unplaced, few, misfit, unsure = report_of(weakened()).remarks
    assert unplaced == f"{LOST} could not be placed: it is too dark."
    assert "99 with its best partner" in few
    assert "fits to 1.6 pixels only" in misfit
    assert "1.6 % of the subject" in unsure
    strong = replace(solved(), unplaced=(), evidence=all_strong())
    assert report_of(strong).remarks == ()
    assert "Nothing to worry about" in camera_report_html(report_of(strong))


def test_cameras_that_no_third_photograph_confirms_are_doubted() -> None:
    """A photograph's points that two alone see are its and its partner's to place as they like."""
    strong = replace(solved(), unplaced=(), evidence=all_strong())
    assert list(num_confirming(strong.sparse_visibility)) == [40, 40, 40]
    assert unconfirmed(strong) is None
    visibility = strong.sparse_visibility.copy()
    visibility[40 : 80 - FEWEST_CONFIRMING + 1, 0] = False
    weak = replace(strong, sparse_visibility=visibility)
    (remark,) = report_of(weak).remarks
    assert remark == unconfirmed(weak)
    assert f"only {FEWEST_CONFIRMING - 1} points" in remark
    assert unconfirmed(replace(weak, evidence=None)) is None


def test_cameras_that_rest_on_outlines_are_doubted_less() -> None:
    weak = replace(
        solved(), unplaced=(), evidence=all_strong(), sparse_visibility=np.zeros((80, 3), np.bool_)
    )
    held = unconfirmed(replace(weak, suit_outlines=True))
    assert held is not None
    assert held.startswith("The cameras rest on the subject's outlines")
    left = unconfirmed(weak)
    assert left is not None
    assert left.startswith("The cameras may be wrong")
    whole = tuple(replace(view, mask=np.ones(view.image_srgb.shape[:2], np.float32)) for view in weak.views)
    masked = unconfirmed(replace(weak, views=whole))
    assert masked is not None
    assert "masks" not in masked
    bare = unconfirmed(replace(weak, views=tuple(replace(view, mask=None) for view in weak.views)))
    assert bare is not None
    assert "or masks of the whole subject, would help" in bare


@pytest.mark.parametrize("apart", [0.0, 0.01])
def test_a_copy_or_a_burst_confirms_nothing(apart: float) -> None:
    """The third photograph is taken from beside the second, so many distances to the subject away."""
    strong = replace(solved(), unplaced=(), evidence=all_strong())
    first, second, third = strong.views
    pose = second.camera.camera_from_world.copy()
    pose[:3, 3] += [apart * DISTANCE * SIZE, 0, 0]
    beside = replace(third, camera=replace(third.camera, camera_from_world=pose))
    doubt = unconfirmed(replace(strong, views=(first, second, beside)))
    assert doubt is not None
    assert "only 0 points are seen by three photographs from different places" in doubt


def weakened() -> SolvedCameras:
    """The last camera is three times less sure."""
    evidence = solved().evidence
    assert evidence is not None
    assert evidence.pose_covariance is not None
    covariance = evidence.pose_covariance * np.array([1, 1, 6])[:, None, None]
    return replace(solved(), evidence=replace(evidence, pose_covariance=covariance))


def all_strong() -> CameraEvidence:
    evidence = solved().evidence
    assert evidence is not None
    return replace(
        evidence,
        names=tuple(view.name for view in solved().views),
        num_features=np.array([500, 600, 700]),
        num_matched=np.full((3, 3), 300) * (1 - np.eye(3, dtype=np.int64)),
        error_px=evidence.error_px / 2,
        num_verified=np.full((3, 3), 200) * (1 - np.eye(3, dtype=np.int64)),
    )


def test_numbers_are_json_without_nan() -> None:
    numbers = json.loads(json.dumps(camera_report_numbers(report_of(solved())), allow_nan=False))
    assert [(pair["num_verified"], pair["num_matched"]) for pair in numbers["pairs"]] == [
        (400, 800),
        (99, 198),
        (12, 24),
    ]
    assert numbers["track_lengths"] == {"2": 40, "3": 40}
    assert numbers["pose_covariance_rad_world"]["view_00.png"][4][4] == pytest.approx(0.04**2)
    assert numbers["photos"][2]["why_unplaced"] == "it is too dark"


def test_the_page_loads_nothing_and_escapes_names() -> None:
    page = camera_report_html(report_of(solved()))
    assert "default-src 'none'" in page
    assert "lost &lt;1&gt;" in page
    assert "<1>" not in page
    assert "Ball &amp; ring" in page
    for address in re.findall(r'(?:src|href)="([^"]*)"', page):
        assert address.startswith("data:")
    assert "<script" not in page
    assert page.count("<svg") == 4


def test_given_cameras_have_no_matches_to_show() -> None:
    given = replace(solved(), evidence=None, estimated=False, reprojection_error_px=None)
    page = camera_report_html(report_of(given))
    assert "These cameras were given" in page
    assert "Who sees the same" not in page
    assert "At which angle they see it" in page
    numbers = camera_report_numbers(report_of(given))
    assert numbers["pairs"] == []
    assert numbers["pose_covariance_rad_world"] is None
    assert "How many photographs see a point" in page, "some are seen by three"
    pairs = replace(given, sparse_visibility=np.tile([True, True, False], (80, 1)))
    assert "How many photographs see a point" not in camera_report_html(report_of(pairs))
    bare = replace(given, sparse_positions=np.zeros((0, 3)), sparse_visibility=np.zeros((0, 3), bool))
    page = camera_report_html(report_of(bare))
    assert "At which angle they see it" not in page
    assert "From above" in page


def drawn(svg: Markup, tag: str, kind: str | None = None) -> list[dict[str, str]]:
    """The elements of a picture, in order."""
    elements = ElementTree.fromstring(str(svg)).iter(tag)
    return [e.attrib for e in elements if kind is None or kind in e.attrib.get("class", "").split()]


def test_bars_are_as_high_as_they_count() -> None:
    svg = histogram([Bar("a", 10, "weak"), Bar("b", 0, "measured"), Bar("<c>", 5, "measured")], "letters")
    heights = [float(bar["height"]) for bar in drawn(svg, "rect")]
    assert heights[0] == pytest.approx(2 * heights[2], abs=0.2)
    assert heights[1] == 0
    assert [bar["class"] for bar in drawn(svg, "rect")] == ["weak", "measured", "measured"]
    assert drawn(histogram([], "nothing"), "rect") == []


def test_ties_join_their_photographs_and_the_strong_lie_above() -> None:
    photos = [("a.png", None), ("b.png", "data:,"), ("c.png", None)]
    svg = match_graph(photos, [(0, 1, 400, "measured"), (1, 2, 100, "weak")])
    discs = [(disc["cx"], disc["cy"]) for disc in drawn(svg, "circle", "disc")]
    assert len(discs) == 3
    weak, strong = drawn(svg, "line", "tie")
    assert (strong["x1"], strong["y1"], strong["x2"], strong["y2"]) == (*discs[0], *discs[1])
    assert "weak" in weak["class"]
    assert float(strong["stroke-width"]) == pytest.approx(10)
    assert float(weak["stroke-width"]) == pytest.approx(1 + 9 / 2)
    assert len(drawn(svg, "circle", "lost")) == 2


def test_the_map_is_to_scale_with_the_cameras_below() -> None:
    views, region = solved().views, true_region()
    points = np.stack([region.centre_world, views[0].camera.position])
    covariances = np.tile(np.diag([1e-4, 4e-4, 1e-4]), (3, 1, 1))
    covariances[1] *= 4
    map_ = top_view(views, points, np.array([[255, 0, 0], [0, 0, 255]], np.uint8), region, covariances)
    (circle,) = drawn(map_.svg, "circle", "region")
    centre, radius = np.array([float(circle["cx"]), float(circle["cy"])]), float(circle["r"])
    scale = radius / region.radius_world
    eyes = [np.array([float(eye["cx"]), float(eye["cy"])]) for eye in drawn(map_.svg, "circle", "eye")]
    for eye, view in zip(eyes, views, strict=True):
        level = (view.camera.position - region.centre_world)[:2]  # the synthetic world's up is z
        assert np.linalg.norm(eye - centre) == pytest.approx(scale * np.linalg.norm(level), rel=0.02)
        assert eye[1] > centre[1]
    assert eyes[0][0] < eyes[1][0] < eyes[2][0], "from the left to the right, as seen from behind them"
    dots = {dot["fill"]: (dot["cx"], dot["cy"]) for dot in drawn(map_.svg, "circle") if "fill" in dot}
    np.testing.assert_allclose([float(x) for x in dots["#ff0000"]], centre, atol=1)
    np.testing.assert_allclose([float(x) for x in dots["#0000ff"]], eyes[0], atol=1)
    halos = [float(halo["rx"]) for halo in drawn(map_.svg, "ellipse", "halo")]
    assert map_.magnification is not None
    assert halos[1] == pytest.approx(2 * halos[0], abs=0.2)
    assert halos[1] == pytest.approx(map_.magnification * scale * 0.04, rel=0.02)
    assert 34 / 2.5 < max(halos) <= 34


def test_cameras_all_around_have_a_map() -> None:
    scene = photographed(arc_cameras(4, 270, 32))
    map_ = top_view(scene.views, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), true_region(), None)
    assert map_.magnification is None
    assert len(drawn(map_.svg, "circle", "eye")) == 4


def test_long_names_keep_their_ends() -> None:
    assert shortened("IMG_0042.JPG") == "IMG_0042"
    assert shortened("holiday-in-the-mountains-0042.jpg") == "…-mountains-0042"
    assert shortened(".hidden") == ".hidden"
