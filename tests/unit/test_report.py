"""The report: its numbers against known answers, its page against what a page must be."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from backend.benchmark import measuring
from backend.errors import Cancelled
from backend.maths.raycast import MeshImage, render_mesh
from backend.maths.upright import up_direction
from backend.report_page import pictures
from backend.report_page.wording import (
    count_text,
    css_gradient,
    decibel_text,
    duration_text,
    hundred_text,
    memory_text,
    percent_text,
    stage_text,
)
from backend.scene import SurfaceMesh, Unplaced, no_progress, transform_points
from backend.stages import report
from backend.stages.report import (
    Report,
    ReportConfig,
    ReportInputs,
    build_report,
    flat_settings,
    mesh_facts,
    render_report_html,
    report_numbers,
)
from tests.report_scene import camera_at, figure_mesh, finished_run, with_truth

SMALL = ReportConfig(num_photos_shown=2, num_turntable=3, picture_px=60, error_samples=20_000)


def small_run(wobble: float = 0.03, *, num_photos: int = 3, masked: bool = True) -> ReportInputs:
    return finished_run(num_photos=num_photos, wobble=wobble, masked=masked, width=120, resolution=2)


@pytest.fixture(scope="module")
def measured() -> Report:
    """A report with everything in it."""
    return build_report(with_truth(small_run(), resolution=2), SMALL, progress=no_progress)


class Page(HTMLParser):
    """Tags and visible words of a page; refuses tags that are closed in the wrong order."""

    VOID = frozenset({"meta", "link", "img", "input", "br"})

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.words = ""
        self.feed(html)
        self.close()
        assert not self.open, f"left open: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not {"style", "script"} & set(self.open):
            self.words += " ".join(data.split()) + " "

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.tags if name == tag]


def test_a_perfect_mesh_repeats_its_photographs_exactly() -> None:
    """Photographs drawn from the mesh itself: infinite PSNR, which JSON can not say, and full overlap."""
    report = build_report(small_run(wobble=0.0), SMALL, progress=no_progress)
    assert [photo.psnr_db for photo in report.photos] == [float("inf")] * 3
    assert [photo.silhouette_overlap for photo in report.photos] == [1.0] * 3
    numbers = json.loads(json.dumps(report_numbers(report), allow_nan=False))
    assert numbers["photos"][0]["psnr_db"] is None
    assert "identical" in Page(render_report_html(report)).words


def test_likeness_is_measured_inside_mesh_and_mask() -> None:
    """PSNR, coverage and overlap of one photograph by their definitions, pixel by pixel."""
    inputs = small_run(num_photos=1)
    view = inputs.solved.views[0]
    assert view.mask is not None
    view = replace(view, mask=view.mask * np.float32(0.6))  # above a half is on the subject
    inputs = replace(inputs, solved=replace(inputs.solved, views=(view,)))
    image = render_mesh(inputs.mesh, view.camera)
    assert view.mask is not None
    squares, inside, union = [], 0, 0
    for row in range(view.camera.height):
        for column in range(view.camera.width):
            covered, masked = bool(image.coverage[row, column]), bool(view.mask[row, column] > 0.5)
            inside, union = inside + (covered and masked), union + (covered or masked)
            if covered and masked:
                squares += list((image.colour_srgb[row, column] - view.image_srgb[row, column]) ** 2)
    photo = build_report(inputs, SMALL, progress=no_progress).photos[0]
    assert photo.psnr_db == pytest.approx(-10 * np.log10(np.mean(squares)), abs=1e-4)
    assert photo.covered_share == pytest.approx(image.coverage.mean())
    assert photo.silhouette_overlap == pytest.approx(inside / union)
    assert inside < union, "a mask that differs from the mesh, else the test says little"


def test_without_masks_there_is_no_overlap_to_report() -> None:
    report = build_report(small_run(masked=False), SMALL, progress=no_progress)
    assert all(photo.silhouette_overlap is None and photo.psnr_db is not None for photo in report.photos)


def test_support_shares_of_a_sphere_are_those_of_archimedes() -> None:
    """A sphere's area is spread evenly over its height; with support (z + 1) / 2 so is the support."""
    ball = trimesh.creation.icosphere(5)
    vertices = np.asarray(ball.vertices, np.float64)
    mesh = SurfaceMesh(
        vertices=vertices * 3.0,
        faces=np.asarray(ball.faces, np.int64),
        normals=vertices.astype(np.float32),
        colours_srgb=np.zeros((len(vertices), 3), np.uint8),
        support=((vertices[:, 2] + 1) / 2).astype(np.float32),
    )
    facts = mesh_facts(mesh)
    np.testing.assert_allclose(facts.support_histogram, 0.1, atol=0.004)
    assert facts.guessed_share == pytest.approx(0.2, abs=0.005)
    assert facts.measured_share == pytest.approx(0.4, abs=0.005)
    assert (facts.num_vertices, facts.num_faces) == (10242, 20480)
    np.testing.assert_allclose(facts.size_world, 6.0, atol=1e-2)
    assert facts.watertight
    assert not mesh_facts(replace(mesh, faces=mesh.faces[1:])).watertight


def test_large_faces_count_for_more() -> None:
    """A square of 9 area units that is measured beside one of 1 unit that is guessed."""
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    halves = np.array([[0, 1, 2], [0, 2, 3]])
    mesh = SurfaceMesh(
        vertices=np.concatenate([3 * square, square + 5.0]),
        faces=np.concatenate([halves, halves + 4]),
        normals=np.tile(np.float32([0, 0, 1]), (8, 1)),
        colours_srgb=np.zeros((8, 3), np.uint8),
        support=np.repeat(np.float32([1, 0]), 4),
    )
    facts = mesh_facts(mesh)
    assert facts.support_histogram == pytest.approx((0.1, *[0.0] * 8, 0.9))
    assert (facts.guessed_share, facts.measured_share) == pytest.approx((0.1, 0.9))


def test_pieces_are_counted() -> None:
    assert mesh_facts(figure_mesh(2)).num_pieces == 2


def test_numbers_survive_json_and_say_their_units(measured: Report) -> None:
    numbers = json.loads(json.dumps(report_numbers(measured), allow_nan=False))
    assert numbers["total_seconds"] == pytest.approx(0.42 + 11.3 + 0.1 + 14.8 + 26.1 + 3.9)
    assert numbers["peak_memory_bytes"] == 1_480_000_000
    assert numbers["stages"][-1] == {"name": "mesh", "seconds": 3.9, "peak_memory_bytes": None}
    assert numbers["cameras"] == {
        "estimated": True,
        "num_placed": 3,
        "unplaced": ["IMG_4030.JPG"],
        "unplaced_because": ["it shares no features with the others"],
        "reprojection_error_px": 0.47,
    }
    assert numbers["region"]["radius_world"] == pytest.approx(2.0)
    assert numbers["settings"] == {"preset": "balanced", "stereo.num_planes": 128, "stereo.margin": None}
    assert numbers["decisions"][1]["choice"] == "left out"
    psnr = [photo["psnr_db"] for photo in numbers["photos"]]
    assert numbers["mean_psnr_db"] == pytest.approx(np.mean(psnr))
    whole = numbers["error"]["whole"]
    mean = (whole["accuracy_percent"] + whole["completeness_percent"]) / 2
    assert whole["chamfer_percent"] == pytest.approx(mean)
    # The wobble is at most 0.03 and on average a third of that, of a diagonal of about 4.
    assert 0.1 < whole["chamfer_percent"] < 0.75
    assert numbers["error"]["visible"]["chamfer_percent"] > 0
    assert 0 < numbers["error"]["visible_share_of_truth"] < 0.6
    assert sum(step["share_of_mesh"] for step in numbers["error"]["support"]["steps"]) == pytest.approx(1)


@pytest.fixture
def doubted() -> Report:
    """The true mesh with support 0.9, and around it the same, a fifth too large, with 0.1."""
    inputs = with_truth(small_run(wobble=0.0, num_photos=1), resolution=2)
    mesh = inputs.mesh
    there = mesh.vertices * 1.2
    both = SurfaceMesh(
        vertices=np.concatenate([mesh.vertices, there]),
        faces=np.concatenate([mesh.faces, mesh.faces + len(there)]),
        normals=np.tile(mesh.normals, (2, 1)),
        colours_srgb=np.tile(mesh.colours_srgb, (2, 1)),
        support=np.repeat(np.float32([0.9, 0.1]), len(there)),
    )
    return build_report(replace(inputs, mesh=both), SMALL, progress=no_progress)


def test_how_support_foretells_error_is_in_page_numbers_and_benchmark(doubted: Report) -> None:
    """The mesh around has 1.44 times the area of the true one, and is near it where ring meets ball."""
    assert doubted.error is not None
    auc = doubted.error.support.auc
    assert auc is not None
    numbers = json.loads(json.dumps(report_numbers(doubted), allow_nan=False))
    assert numbers["error"]["support"]["auc"] == auc
    assert measuring.report_numbers(numbers)["support_auc"] == auc
    steps = numbers["error"]["support"]["steps"]
    assert [step["share_of_mesh"] for step in steps] == pytest.approx(
        [1.44 / 2.44, 0, 0, 0, 1 / 2.44], abs=0.01
    )
    words = " ".join(Page(render_report_html(doubted)).words.split())
    assert f"good surface from bad in {hundred_text(auc)} pairs" in words
    off, true = steps[0], steps[-1]
    assert off["median_error_percent"] > 1 > true["median_error_percent"]
    for ends, step in (("0.0 to 0.2", off), ("0.8 to 1.0", true)):
        share, within = (percent_text(step[key]) for key in ("share_of_mesh", "share_within_one_percent"))
        assert f"{ends} {share} {step['median_error_percent']:.3f} % {within}" in words
    assert "0.2 to 0.4 0 % – –" in words


def test_where_support_has_nothing_to_tell_apart_the_page_says_so(measured: Report) -> None:
    assert measured.error is not None
    numbers = report_numbers(measured)
    assert "support_auc" in measuring.report_numbers(numbers)
    for factor, word in ((1.0, "all"), (9.0, "none")):
        whole = replace(measured.error.whole, accuracy_percent=0.2 * factor)
        support = replace(measured.error.support, auc=None)
        report = replace(measured, error=replace(measured.error, whole=whole, support=support))
        words = Page(render_report_html(report)).words
        assert f"{word} of the surface is within 1 %" in words
        assert "pairs" not in words


def test_the_page_needs_nothing_but_itself(measured: Report) -> None:
    page = Page(render_report_html(measured))
    for tag, attributes in page.tags:
        for name in ("src", "href", "srcset", "data", "action", "poster"):
            assert attributes.get(name, "data:").startswith("data:"), (tag, attributes)
    assert not re.search(r"url\(|@import|https?:", render_report_html(measured))
    assert "default-src 'none'" in page.all("meta")[3]["content"]


def test_pictures_are_what_they_say(measured: Report) -> None:
    """Two photographs of four panels, the slider's two again, three new sides and three error maps."""
    images = Page(render_report_html(measured)).all("img")
    assert len(images) == 2 * 4 + 2 + 3 + 3
    assert len({image["alt"] for image in images}) == 2 * 4 + 3 + 3
    for image in images:
        assert image["alt"].strip()
    for shown in (*measured.photos[0].panels, *measured.turntable, *measured.error_maps):
        with Image.open(BytesIO(shown.jpeg)) as file:
            assert file.size == (shown.width, shown.height)
            assert max(file.size) == SMALL.picture_px
    assert measured.photos[1].panels == (), "the middle one of three when two are shown"


def test_error_maps_are_dark_red_where_the_error_is_large() -> None:
    """A mesh a sixth too large is off by more than the map's limit almost everywhere, a true one nowhere."""
    inputs = with_truth(small_run(wobble=0.0, num_photos=1), resolution=2)
    large = replace(inputs, mesh=replace(inputs.mesh, vertices=inputs.mesh.vertices * 1.16))
    middle_colours = []
    for run in (inputs, large):
        (drawn, *_) = build_report(run, SMALL, progress=no_progress).error_maps
        with Image.open(BytesIO(drawn.jpeg)) as file:
            middle_colours.append(np.asarray(file, np.float64)[25:35, 25:35].mean(axis=(0, 1)) / 255)
    (true_red, true_green, _), (red, green, _) = middle_colours
    assert true_green > 0.8 * true_red
    assert green < 0.3 * red < 0.2


def test_the_page_tells_everything(measured: Report) -> None:
    words = Page(render_report_html(measured)).words
    inputs = measured.inputs
    expected = [
        inputs.job_name,
        *inputs.warnings,
        "IMG_4030.JPG no it shares no features",
        "0.47 pixels",
        "torch 2.13.0",
        "Seed 7",
    ]
    expected += [
        text for decision in inputs.decisions for text in (decision.what, decision.choice, decision.because)
    ]
    expected += [
        "stereo.num_planes 128",
        "stereo.margin –",
        "11 s",
        "1.1 GB",
        "Measuring points 15 s",
        "In all 57 s",
        "Chamfer",
    ]
    expected += [f"{measured.mesh.num_faces:,}", "Closed (watertight) yes", "Separate pieces 2"]
    for text in expected:
        assert text in words
    assert measured.error is not None
    assert f"{measured.error.whole.chamfer_percent:.3f} %" in words
    assert measured.error.visible is not None
    assert f"{measured.error.visible.chamfer_percent:.3f} %" in words


def test_names_can_not_break_the_page() -> None:
    evil = '"><script>alert(1)</script>'
    inputs = replace(small_run(), job_name=evil, warnings=(evil,))
    views = (replace(inputs.solved.views[0], name=evil),)
    inputs = replace(
        inputs, solved=replace(inputs.solved, views=views, unplaced=(Unplaced(name=evil, why=evil),))
    )
    page = Page(render_report_html(build_report(inputs, SMALL, progress=no_progress)))
    assert not page.all("script")
    assert page.words.count(evil) == 7, "title, heading, warning, picture, two rows, a reason"
    assert page.all("img")[0]["alt"].count(evil) == 1


def test_a_run_of_given_cameras_without_truth_or_warnings() -> None:
    inputs = replace(small_run(), warnings=(), decisions=(), versions={}, timings=())
    given = replace(inputs.solved, estimated=False, reprojection_error_px=None, unplaced=())
    report = build_report(replace(inputs, solved=given), SMALL, progress=no_progress)
    words = Page(render_report_html(report)).words
    assert "was given" in words
    for absent in ("Please note", "left out", "true surface", "worked out"):
        assert absent not in words
    assert report_numbers(report)["error"] is None
    assert report_numbers(report)["peak_memory_bytes"] is None


def test_a_photograph_the_mesh_does_not_reach_has_no_likeness() -> None:
    inputs = small_run()
    away = camera_at(0.0, 1.2, width=120)
    turned = replace(away, camera_from_world=np.diag([-1.0, 1, -1, 1]) @ away.camera_from_world)
    views = (*inputs.solved.views, replace(inputs.solved.views[0], name="away", camera=turned))
    report = build_report(
        replace(inputs, solved=replace(inputs.solved, views=views)), SMALL, progress=no_progress
    )
    assert report.photos[-1].psnr_db is None
    assert report.photos[-1].covered_share == 0.0
    assert report.mean_psnr_db == pytest.approx(np.mean([photo.psnr_db for photo in report.photos[:-1]]))
    render_report_html(report)


def test_a_truth_of_another_scale_is_measured_by_few_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else that takes an hour."""
    inputs = with_truth(small_run(num_photos=1), resolution=2)
    asked: list[int] = []
    measure = report.surface_error

    def counted(*args: Any, num_samples: int, **kwargs: Any) -> Any:
        asked.append(num_samples)
        return measure(*args, num_samples=num_samples, **kwargs)

    monkeypatch.setattr(report, "surface_error", counted)
    assert inputs.truth is not None
    larger = replace(inputs.truth, vertices=100 * inputs.truth.vertices)
    for truth in (inputs.truth, larger):
        build_report(replace(inputs, truth=truth), SMALL, progress=no_progress)
    assert asked == [SMALL.error_samples, 2000]


def test_progress_goes_forward_and_can_cancel(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    fractions: list[float] = []
    inputs = with_truth(small_run(), resolution=2)
    build_report(inputs, SMALL, progress=lambda fraction, _: fractions.append(fraction))
    assert fractions == sorted(set(fractions))
    assert len(fractions) == 7, "three photographs, the truth, three other sides"
    assert 0 <= fractions[0] < fractions[-1] < 1

    def cancel(_fraction: float, _text: str) -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        build_report(inputs, SMALL, progress=cancel)


def test_the_same_run_gives_the_same_page(measured: Report) -> None:
    again = build_report(measured.inputs, SMALL, progress=no_progress)
    assert render_report_html(again) == render_report_html(measured)


@pytest.mark.slow
def test_the_page_stays_modest_with_large_noisy_photographs() -> None:
    """Noise is what JPEG packs worst."""
    inputs = finished_run(num_photos=4, width=900, resolution=2)
    noise = np.random.default_rng(0).random(inputs.solved.views[0].image_srgb.shape, np.float32)
    views = tuple(replace(view, image_srgb=noise) for view in inputs.solved.views)
    inputs = replace(inputs, solved=replace(inputs.solved, views=views))
    html = render_report_html(build_report(inputs, ReportConfig(), progress=no_progress))
    assert 100_000 < len(html) < 3_000_000


def test_settings_of_settings_are_flattened() -> None:
    assert flat_settings(small_run().settings) == (
        ("preset", "balanced"),
        ("stereo.num_planes", 128),
        ("stereo.margin", None),
    )
    assert flat_settings(Path("a")) == (("", "a"),)


@pytest.mark.parametrize(
    ("write", "value", "text"),
    [
        (duration_text, 0.04, "0.0 s"),
        (duration_text, 9.94, "9.9 s"),
        (duration_text, 10.4, "10 s"),
        (duration_text, 59.7, "1 min 00 s"),
        (duration_text, 3599.6, "1 h 00 min"),
        (duration_text, 4000.0, "1 h 06 min"),
        (memory_text, 999_400_000, "999 MB"),
        (memory_text, 1_480_000_000, "1.5 GB"),
        (memory_text, None, "–"),
        (stage_text, "stereo", "Measuring points"),
        (stage_text, "unheard of", "unheard of"),
        (percent_text, 0.0, "0 %"),
        (percent_text, 0.001, "< 1 %"),
        (percent_text, 0.42, "42 %"),
        (percent_text, 0.9999, "> 99 %"),
        (percent_text, 1.0, "100 %"),
        (hundred_text, 0.874, "87 of 100"),
        (hundred_text, 0.999, "99 of 100"),
        (hundred_text, 1.0, "100 of 100"),
        (hundred_text, 0.001, "1 of 100"),
        (hundred_text, 0.0, "0 of 100"),
        (decibel_text, None, "–"),
        (decibel_text, 27.26, "27.3 dB"),
        (decibel_text, float("inf"), "identical"),
        (lambda count: count_text(count, "face"), 1, "1 face"),
        (lambda count: count_text(count, "face"), 12_345, "12,345 faces"),
        (
            css_gradient,
            np.array([[0, 0.5, 1], [1, 1, 1]]),
            "linear-gradient(to right, rgb(0 128 255), rgb(255 255 255))",
        ),
    ],
)
def test_wording(write: Callable[[object], str], value: object, text: str) -> None:
    assert write(value) == text


def test_turntable_cameras_hold_the_mesh_from_new_sides_with_its_top_up() -> None:
    given = [camera_at(azimuth, 1.2) for azimuth in (-0.4, 0.1, 0.5)]
    vertices = figure_mesh(3).vertices * 7.0 + np.array([3.0, -40.0, 5.0])
    given = [
        replace(camera, camera_from_world=camera.camera_from_world @ shift_by([-3.0, 40.0, -5.0]))
        for camera in given
    ]
    cameras = pictures.turntable_cameras(given, vertices, 4, 100)
    directions = []
    for camera in cameras:
        in_camera = transform_points(camera.camera_from_world, vertices)
        pixels = in_camera @ camera.intrinsics.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        assert in_camera[:, 2].min() > 0
        assert pixels.min() > 0
        assert pixels.max() < 100
        assert np.ptp(pixels, axis=0).max() > 60, "and large"
        rotation = camera.camera_from_world[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        assert -rotation[1, 2] > 0.9, "z points up in the picture"
        assert camera.position[2] > 5.0, "seen from above"
        directions.append(rotation[2])
    between = np.array(directions) @ np.array(directions).T
    assert between[~np.eye(4, dtype=bool)].max() < 0.3, "a quarter turn apart, seen from 18 degrees above"


@pytest.mark.parametrize("azimuths", [(-0.5, 0.1, 0.5), (0.0, 0.9, 2.1, 4.0), (-0.3, 0.3)])
def test_up_is_found_from_tilted_level_cameras(azimuths: tuple[float, ...]) -> None:
    """Each looks down by 30 degrees, so that no picture's own up is up. The world turned, up turns."""
    cameras = [camera_at(azimuth, 4 * np.tan(np.pi / 6)) for azimuth in azimuths]
    np.testing.assert_allclose(pictures.up_of(cameras), [0, 0, 1], atol=0.12)
    turn = np.eye(4)
    turn[:3, :3] = trimesh.transformations.rotation_matrix(2.0, [1, 2, 3])[:3, :3]
    turned = [replace(camera, camera_from_world=camera.camera_from_world @ turn.T) for camera in cameras]
    expected = turn[:3, :3] @ pictures.up_of(cameras)
    np.testing.assert_allclose(pictures.up_of(turned), expected, atol=1e-9)


def test_up_of_a_single_photograph_is_its_own() -> None:
    camera = camera_at(0.7, 2.0)
    expected = -camera.camera_from_world[1, :3]
    # But for a thousandth of backwards, which decides for cameras that look straight down.
    np.testing.assert_allclose(pictures.up_of([camera]), expected, atol=2e-3)


def test_the_report_is_upright_as_blender_is_though_a_photograph_was_taken_on_its_side() -> None:
    """The plain eigenvector of the x axes would tilt by 20 degrees and more."""
    cameras = [camera_at(azimuth, 1.5) for azimuth in (-0.6, -0.2, 0.2, 0.6)]
    quarter = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 0, 1])
    cameras[1] = replace(cameras[1], camera_from_world=quarter @ cameras[1].camera_from_world)
    up = pictures.up_of(cameras)
    assert np.degrees(np.arccos(up[2])) < 1.0
    axes = np.stack([np.linalg.inv(camera.camera_from_world)[:3, :3] for camera in cameras])
    rights, bottoms, forwards = np.moveaxis(axes, 2, 0)
    np.testing.assert_array_equal(up_direction(rights, -bottoms, -forwards).round(9), up.round(9))


def test_turntable_views_are_between_the_photographs_side_and_the_others() -> None:
    """With four of them, 45, 135, 225 and 315 degrees from the photographs' mean azimuth."""
    given = [camera_at(azimuth, 0.0) for azimuth in (0.6, 1.0)]
    cameras = pictures.turntable_cameras(given, figure_mesh(2).vertices, 4, 50)
    azimuths = [np.arctan2(camera.position[0], -camera.position[1]) for camera in cameras]
    steps = np.degrees(np.array(azimuths) - 0.8) % 360
    np.testing.assert_allclose(sorted(steps), [45, 135, 225, 315], atol=5.0)


@pytest.mark.parametrize(("axis", "angle"), [((0, 1, 0), 0.0), ((0, 1, 0), np.pi / 2), ((3, 1, 2), 1.0)])
def test_turntable_does_without_a_preferred_side(axis: tuple[float, ...], angle: float) -> None:
    """Cameras face to face, whose mean direction is none, in worlds turned so that up is z, x and neither."""
    turn = np.eye(4)
    turn[:3, :3] = trimesh.transformations.rotation_matrix(angle, axis)[:3, :3]
    front = camera_at(0.0, 0.0)
    back = replace(front, camera_from_world=np.diag([-1.0, 1, -1, 1]) @ front.camera_from_world)
    back.camera_from_world[:3, 3] = front.camera_from_world[:3, 3]
    given = [replace(c, camera_from_world=c.camera_from_world @ turn.T) for c in (front, back)]
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    for camera in pictures.turntable_cameras(given, corners, 3, 50):
        rotation = camera.camera_from_world[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        backwards_up = -rotation[2] @ turn[:3, 2]
        assert backwards_up == pytest.approx(np.sin(np.radians(18.0)), abs=1e-6)


def shift_by(offset: list[float]) -> np.ndarray:
    shift = np.eye(4)
    shift[:3, 3] = offset
    return shift


def lone_pixel(normal: tuple[float, float, float], support: float = 0.0) -> MeshImage:
    """What a camera at (0, -4, 0) sees in its single pixel; it looks along +y."""
    face = SurfaceMesh(
        vertices=np.eye(3),
        faces=np.array([[0, 1, 2]]),
        normals=np.array([normal] * 3, np.float32),
        colours_srgb=np.zeros((3, 3), np.uint8),
        support=np.full(3, support, np.float32),
    )
    return MeshImage(
        mesh=face,
        coverage=np.ones((1, 1), bool),
        face=np.array([0]),
        barycentric=np.full((1, 3), 1 / 3),
        depths=np.ones(1),
    )


def test_clay_is_lit_from_the_upper_left_and_bluish_inside() -> None:
    camera = replace(camera_at(0.0, 0.0), width=1, height=1, cx_px=0.5, cy_px=0.5)
    lit, dark, inside = (
        pictures.clay(lone_pixel(normal), camera)[0, 0]
        for normal in ((-0.6, -0.6, 0.53), (0.6, -0.6, -0.53), (0.6, 0.6, -0.53))
    )
    assert lit.mean() > dark.mean() + 0.3
    assert lit[0] > lit[2]
    assert inside[2] > inside[0] + 0.05
    grazing = pictures.clay(lone_pixel((-0.97, 0.24, 0.0)), camera)[0, 0]
    assert grazing[0] > grazing[2], "an interpolated normal at the outline is not the inside"


def test_maps_run_from_their_first_colour_to_their_last() -> None:
    camera = replace(camera_at(0.0, 0.0), width=1, height=1, cx_px=0.5, cy_px=0.5)
    stops = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    for support, expected in ((0.0, [1, 0, 0]), (0.25, [0.5, 0.5, 0]), (1.0, [0, 0, 1]), (7.0, [0, 0, 1])):
        drawn = pictures.value_map(lone_pixel((0, -1, 0), support), camera, stops)[0, 0]
        np.testing.assert_allclose(drawn / drawn.sum(), expected, atol=1e-9)
        assert 0.6 < drawn.sum() <= 1.0
