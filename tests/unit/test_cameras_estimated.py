"""Cameras from photographs of a rendered corner, and lens refinement on synthetic points."""

import json
import math
import threading
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pycolmap
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from backend.errors import Cancelled, ErrorCode, ReconstructionError
from backend.scene import Decision, Photo, SolvedCameras, Unplaced, no_progress
from backend.stages.cameras import features, focal_search, model_choice, model_merit
from backend.stages.cameras.camera_report import (
    build_camera_report,
    camera_report_html,
    camera_report_numbers,
)
from backend.stages.cameras.confirmation import num_confirming
from backend.stages.cameras.lens_refinement import Gaussian, joined, refine_lenses
from backend.stages.cameras.solving import CamerasConfig, solve_cameras
from backend.stages.region import RegionConfig, find_region
from tests.relative_rotations import rotation_errors_deg
from tests.ridge_photos import FOCAL_PX, HEIGHT, WIDTH, arc_pose, look_at_origin, make_photo, render

CONFIG = CamerasConfig(max_features=1200)


def noise_photo(name: str, seed: int) -> Photo:
    grey = gaussian_filter(np.random.default_rng(seed).random((HEIGHT, WIDTH)), 1.5)
    grey = (grey - grey.min()) / np.ptp(grey)
    return make_photo(name, np.repeat(grey[..., None], 3, axis=2))


def solve(photos: list[Photo], workdir: Path, seed: int = 0) -> SolvedCameras:
    return solve_cameras(photos, None, CONFIG, workdir=workdir, seed=seed, progress=no_progress)


def rotation_error_deg(a: np.ndarray, b: np.ndarray) -> float:
    return math.degrees(Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).magnitude())


POSES = {f"{i}.png": arc_pose(angle) for i, angle in enumerate([-18.0, 0.0, 15.0])}


@pytest.fixture(scope="module")
def corner() -> list[Photo]:
    return [make_photo(name, render(pose)) for name, pose in POSES.items()]


def test_copies_of_one_photograph_are_told(corner: list[Photo], tmp_path: Path) -> None:
    """Two copies, and a third photograph, are two; all copies are none to compare."""
    one, other, _ = corner
    copy = replace(one, name="copy.png")
    solved = solve([one, copy, other], tmp_path)
    assert [view.name for view in solved.views] == [one.name, other.name]
    assert solved.unplaced == (Unplaced(name="copy.png", why=f"it is a copy of {one.name}"),)
    with pytest.raises(ReconstructionError, match="All 2 photographs are copies of one") as raised:
        solve([one, copy], tmp_path)
    assert raised.value.code == ErrorCode.TOO_FEW_PHOTOS


@pytest.mark.parametrize("focal_px", [None, FOCAL_PX * 1.03])
def test_cameras_of_rendered_photographs(focal_px: float | None, corner: list[Photo], tmp_path: Path) -> None:
    photos = [make_photo(photo.name, photo.image_srgb, focal_px) for photo in corner]
    unrelated = noise_photo("noise.png", 5)
    solved = solve([*photos, unrelated], tmp_path)
    assert [view.name for view in solved.views] == list(POSES)
    (left_out,) = solved.unplaced
    assert left_out.name == "noise.png"
    assert left_out.why == "it shares no features with the others that could be recognised"
    assert solved.estimated
    assert solved.reprojection_error_px is not None
    assert solved.reprojection_error_px < 0.5
    check_evidence(solved)
    first, *others = solved.views
    for view in others:
        ours = view.camera.camera_from_world @ np.linalg.inv(first.camera.camera_from_world)
        true = POSES[view.name] @ np.linalg.inv(POSES[first.name])
        assert rotation_error_deg(ours, true) < 0.3, "a third of it is a pixel"
        cosine = ours[:3, 3] @ true[:3, 3] / np.linalg.norm(ours[:3, 3]) / np.linalg.norm(true[:3, 3])
        assert cosine > math.cos(math.radians(1.0))
        assert view.camera.fx_px == pytest.approx(FOCAL_PX, rel=0.02)


@pytest.mark.slow
def test_photographs_far_apart_are_placed_by_features_as_seen_from_aside(tmp_path: Path) -> None:
    """The usual ones place two of three photographs that are 40 degrees apart."""
    poses = {f"{i}.png": arc_pose(angle) for i, angle in enumerate([-40.0, 0.0, 40.0])}
    solved = solve([make_photo(name, render(pose, 0.3)) for name, pose in poses.items()], tmp_path)
    assert not solved.unplaced
    told = next(decision for decision in solved.decisions if decision.what == "features")
    assert told.choice == "fainter ones as well, and those of pictures as seen from aside"
    assert told.because.startswith("with the usual ones 2 of 3 photographs were placed")
    assert num_confirming(solved.sparse_visibility).min() > 100
    turns = [view.camera.camera_from_world for view in solved.views]
    assert rotation_errors_deg(turns, list(poses.values())).max() < 0.4


def check_evidence(solved: SolvedCameras) -> None:
    """Of the ridge and one photograph of noise: who matches, how far off, and how sure to within a factor."""
    evidence = solved.evidence
    assert evidence is not None
    assert evidence.names == (*POSES, "noise.png")
    np.testing.assert_array_equal(evidence.num_verified, evidence.num_verified.T)
    assert (evidence.num_matched >= evidence.num_verified).all()
    assert (evidence.num_verified[:3, :3][~np.eye(3, dtype=bool)] > 50).all()
    assert not evidence.num_verified[3].any()
    assert (evidence.num_features > 0).all()
    seen = solved.sparse_visibility
    assert not evidence.error_px[~seen].any()
    mean_px = (evidence.error_px.sum(axis=1) / seen.sum(axis=1)).mean()
    assert mean_px == pytest.approx(solved.reprojection_error_px, rel=1e-3), "COLMAP's is a mean over points"
    assert evidence.pose_covariance is not None
    for covariance in evidence.pose_covariance:
        assert (np.linalg.eigvalsh(covariance) > -1e-15).all()
        turn_deg = np.degrees(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
        assert 0.003 < turn_deg < 3, "true errors are about 0.1 degrees"


def test_the_page_tells_what_the_solve_found(corner: list[Photo], tmp_path: Path) -> None:
    """In the order and the units of the record, photograph by photograph."""
    solved = solve([*corner, noise_photo("noise.png", 5)], tmp_path)
    region = find_region(solved, RegionConfig(), progress=no_progress)
    report = build_camera_report(solved, region, job_name="ridge", seed=0, versions={})
    numbers: dict[str, Any] = json.loads(json.dumps(camera_report_numbers(report)))
    facts = {photo["name"]: photo for photo in numbers["photos"]}
    evidence, seen = solved.evidence, solved.sparse_visibility
    assert evidence is not None
    assert evidence.pose_covariance is not None
    for index, view in enumerate(solved.views):
        told = facts[view.name]
        assert told["why_unplaced"] is None
        assert told["num_points"] == seen[:, index].sum()
        errors_px = evidence.error_px[seen[:, index], index]
        assert told["median_error_px"] == pytest.approx(np.median(errors_px))
        turn = np.sqrt(np.linalg.eigvalsh(evidence.pose_covariance[index, :3, :3])[-1])
        assert told["turn_sigma_deg"] == pytest.approx(math.degrees(turn))
        assert numbers["pose_covariance_rad_world"][view.name] == evidence.pose_covariance[index].tolist()
    assert facts["noise.png"]["why_unplaced"] == solved.unplaced[0].why
    place = {name: index for index, name in enumerate(evidence.names)}
    assert {frozenset((pair["one"], pair["other"])) for pair in numbers["pairs"]} >= {
        frozenset(pair) for pair in combinations(POSES, 2)
    }
    for pair in numbers["pairs"]:
        assert pair["num_verified"] == evidence.num_verified[place[pair["one"]], place[pair["other"]]]
    assert sum(numbers["track_lengths"].values()) == sum(numbers["angle_counts"]) == len(seen)
    assert 14 < numbers["median_angle_deg"] < 34, "the photographs are 15 and 18 degrees apart"
    html = camera_report_html(report)
    assert all(name in html for name in (*POSES, "noise.png", f"{len(seen):,}"))


def test_the_mean_error_is_in_each_photograph_s_own_pixels(corner: list[Photo], tmp_path: Path) -> None:
    """One of three is twice as large: its errors count twice as much."""
    config = replace(CONFIG, sfm_max_side_px=WIDTH)
    large = make_photo("2.png", np.kron(corner[2].image_srgb, np.ones((2, 2, 1), np.float32)))
    alike, mixed = (
        solve_cameras(photos, None, config, workdir=tmp_path, seed=0, progress=no_progress)
        for photos in (corner, [*corner[:2], large])
    )
    assert alike.reprojection_error_px is not None
    assert mixed.reprojection_error_px is not None
    ratio = mixed.reprojection_error_px / alike.reprojection_error_px
    assert ratio == pytest.approx(4 / 3, rel=0.1)
    assert mixed.evidence is not None
    mean_px = (mixed.evidence.error_px.sum(axis=1) / mixed.sparse_visibility.sum(axis=1)).mean()
    assert mean_px == pytest.approx(mixed.reprojection_error_px)


def test_sparse_points_project_to_what_sees_them(corner: list[Photo], tmp_path: Path) -> None:
    """Every point is in front of the cameras that see it and inside their pictures."""
    solved = solve(corner, tmp_path)
    assert len(solved.sparse_positions) > 200
    assert (solved.sparse_visibility.sum(axis=1) >= 2).all()
    for index, view in enumerate(solved.views):
        points = solved.sparse_positions[solved.sparse_visibility[:, index]]
        in_camera = points @ view.camera.camera_from_world[:3, :3].T + view.camera.camera_from_world[:3, 3]
        pixels = in_camera @ view.camera.intrinsics.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        assert (in_camera[:, 2] > 0).all()
        assert ((pixels > -2) & (pixels < (WIDTH + 2, HEIGHT + 2))).all()


def test_the_same_seed_gives_the_same_bits(corner: list[Photo], tmp_path: Path) -> None:
    one, other = solve(corner, tmp_path / "a", seed=3), solve(corner, tmp_path / "b", seed=3)
    np.testing.assert_array_equal(one.sparse_positions, other.sparse_positions)
    for view, again in zip(one.views, other.views, strict=True):
        np.testing.assert_array_equal(view.camera.camera_from_world, again.camera.camera_from_world)
        np.testing.assert_array_equal(view.camera.intrinsics, again.camera.intrinsics)
        np.testing.assert_array_equal(view.image_srgb, again.image_srgb)


def refusal(photos: list[Photo], workdir: Path) -> ErrorCode:
    with pytest.raises(ReconstructionError) as caught:
        solve(photos, workdir)
    assert caught.value.remedy
    return caught.value.code


def test_photographs_of_nothing_in_common(tmp_path: Path) -> None:
    photos = [noise_photo(f"{seed}.png", seed) for seed in range(3)]
    assert refusal(photos, tmp_path) == ErrorCode.NO_OVERLAP


@pytest.mark.parametrize("focal_px", [None, FOCAL_PX])
def test_photographs_from_one_spot(focal_px: float | None, tmp_path: Path) -> None:
    spot = np.array([0.6, 0.2, -2.8])
    images = [render(look_at_origin(spot, turn)) for turn in (-7.0, 0.0, 6.0)]
    photos = [make_photo(f"{index}.png", image, focal_px) for index, image in enumerate(images)]
    assert refusal(photos, tmp_path) == ErrorCode.NO_PARALLAX


def lens_kept(
    few: dict[float, int], whole: dict[float, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[int, list[tuple[float, int]]]:
    """Of models that are told apart by how many points they confirm: the one kept, and all that were made.

    `few` and `whole` say that number for each focal length that the mapper begins with, of a few photographs
    and of all; those made are (focal length, photographs).
    """
    PIL.Image.new("L", (64, 48)).save(tmp_path / "0000.png")
    group = features.LensGroup(names=("0000.png",), width=64, height=48, focal_px=None)
    features.register_pictures(tmp_path / "a.db", tmp_path, [group])
    begun: dict[Path, float] = {}
    made: list[tuple[float, int]] = []
    confirmed: dict[pycolmap.Reconstruction, int] = {}

    def model_with(number: int) -> pycolmap.Reconstruction:
        confirmed[model := pycolmap.Reconstruction()] = number
        return model

    def mapped(database: Path, names: Sequence[str] = ()) -> list[pycolmap.Reconstruction]:
        factor = begun.get(database, 1.2)
        made.append((factor, len(names) or 20))
        return [model_with((few if names else whole)[factor])]

    monkeypatch.setattr(focal_search, "_begin_with", begun.__setitem__)
    monkeypatch.setattr(focal_search, "num_threads", lambda: 1)
    monkeypatch.setattr(focal_search, "_few_that_share_most", lambda _: ["0", "1"])
    for module in (model_merit, focal_search):
        monkeypatch.setattr(module, "merit", lambda model: (20, confirmed[model], 0))
    kept = focal_search.with_another_lens(model_with(whole[1.2]), tmp_path / "a.db", mapped)
    assert kept is not None
    assert tmp_path / "a.db" not in begun, "later attempts begin as usual"
    return confirmed[kept], made


FEW_PHOTOS = [(1.2, 2), (0.4, 2), (4.0, 2), (12.0, 2)]


def test_a_few_photographs_say_that_no_other_lens_is_worth_all_of_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few, whole = {1.2: 100, 0.4: 20, 4.0: 104, 12.0: 99}, {1.2: 500}
    assert lens_kept(few, whole, tmp_path, monkeypatch) == (500, FEW_PHOTOS)


@pytest.mark.parametrize(("with_all", "kept"), [(900, 900), (510, 500)])
def test_where_a_few_say_another_lens_all_decide(
    with_all: int, kept: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few, whole = {1.2: 100, 0.4: 20, 4.0: 120, 12.0: 20}, {1.2: 500, 4.0: with_all}
    made = [*FEW_PHOTOS[:3], (4.0, 20), *FEW_PHOTOS[3:]]
    assert lens_kept(few, whole, tmp_path, monkeypatch) == (kept, made)


@pytest.mark.parametrize(("num_photos", "num_draws"), [(3, 4), (12, 1)])
def test_chance_is_drawn_again_for_few_photographs_and_else_until_all_are_confirmed(
    num_photos: int, num_draws: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[int] = []

    def match(_: Path, *, seed: int, **__: object) -> None:
        drawn.append(seed)

    def nothing(*_: Any, **__: Any) -> None:
        pass

    fakes = {
        "register_pictures": nothing,
        "extract_features": nothing,
        "extract_thoroughly": nothing,
        "match_pictures": nothing,
        "match_thoroughly": match,
        "mapped_models": lambda *_: [pycolmap.Reconstruction()],
        "with_another_lens": lambda model, *_: model,
        "without_contradicted_exif": lambda model, *_: model,
        "_is_enough": lambda *_: bool(drawn),
        "_why_thorough": lambda *_: Decision(what="features", choice="the usual ones", because="it is so"),
    }
    for name, fake in fakes.items():
        monkeypatch.setattr(model_choice, name, fake)
    names = tuple(f"{index:04d}.png" for index in range(num_photos))
    group = features.LensGroup(names=names, width=64, height=48, focal_px=None)
    model_choice.best_model(tmp_path, [group], 1000, workdir=tmp_path, seed=7, progress=no_progress)
    assert drawn == list(range(7, 7 + num_draws))


@pytest.mark.parametrize(("plenty", "is_fine"), [(1, False), (10**6, True)])
def test_of_large_photographs_features_are_sought_finely_where_there_are_few(
    plenty: int, is_fine: bool, corner: list[Photo], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = tuple(f"{index:04d}.png" for index in range(3))
    for name, photo in zip(names, corner, strict=True):
        grey = features.brightness(photo.image_srgb)
        PIL.Image.fromarray(grey).save(tmp_path / name)
    group = features.LensGroup(names=names, width=WIDTH, height=HEIGHT, focal_px=None)

    def found(database: Path, few_pixels: int, fine_pixels: int) -> list[int]:
        monkeypatch.setattr(features, "_FEW_PIXELS", few_pixels)
        monkeypatch.setattr(features, "_FINE_PIXELS", fine_pixels)
        features.register_pictures(database, tmp_path, [group])
        features.extract_features(database, tmp_path, [group], 5000, progress=no_progress)
        with pycolmap.Database.open(database) as opened:
            return [opened.num_keypoints_for_image(image.image_id) for image in opened.read_all_images()]

    fine = found(tmp_path / "fine.db", 10**9, 10**9)
    coarse = found(tmp_path / "coarse.db", 0, 0)
    assert min(fine) > 1.5 * max(coarse)
    monkeypatch.setattr(features, "_PLENTY", plenty)
    assert found(tmp_path / "asked.db", 0, 10**9) == (fine if is_fine else coarse)


@pytest.mark.parametrize(("num_photos", "side_px"), [(3, 1280), (4, 1600)])
def test_a_few_large_photographs_are_looked_at_smaller(num_photos: int, side_px: int) -> None:
    """Their features are sought at twice the resolution, of more of them not."""
    large = replace(
        make_photo("a.png", np.zeros((4, 6, 3), np.float32)), original_width=3072, original_height=2048
    )
    assert features._picture_side_px(num_photos * [large], 1600) == side_px
    assert features._picture_side_px(num_photos * [large], 800) == 800


def test_progress_can_cancel(corner: list[Photo], tmp_path: Path) -> None:
    shares: list[float] = []

    def cancel(share: float, text: str) -> None:
        shares.append(share)
        if text == "Placing cameras":
            raise Cancelled

    with pytest.raises(Cancelled):
        solve_cameras(corner, None, CONFIG, workdir=tmp_path, seed=0, progress=cancel)
    assert shares == sorted(shares)


def test_a_run_is_cancelled_while_it_tries_other_lenses(
    corner: list[Photo], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(focal_search, "num_threads", lambda: 2)
    threads = set()

    def cancel(_share: float, text: str) -> None:
        if text == "Placing cameras":
            threads.add(threading.current_thread())
            if len(threads) > 1:
                raise Cancelled

    with pytest.raises(Cancelled):
        solve_cameras(corner, None, CONFIG, workdir=tmp_path, seed=0, progress=cancel)


def test_joined_beliefs() -> None:
    """The mean is weighted by inverse variances; ignorance changes nothing; order does not matter."""
    sure = Gaussian(mean=np.array([1.0]), covariance=np.array([[1.0]]))
    unsure = Gaussian(mean=np.array([4.0]), covariance=np.array([[2.0]]))
    both = joined(sure, unsure)
    assert both.mean[0] == pytest.approx(2.0)
    assert both.covariance[0, 0] == pytest.approx(2 / 3)
    np.testing.assert_allclose(joined(unsure, sure).mean, both.mean)
    ignorant = Gaussian(mean=np.array([99.0]), covariance=np.array([[1e12]]))
    np.testing.assert_allclose(joined(sure, ignorant).mean, sure.mean, atol=1e-6)


def synthetic_model(num_images: int, lens: list[float]) -> pycolmap.Reconstruction:
    """Points and cameras all around them, seen through the lens to a third of a pixel."""
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, num_images, 400
    options.camera_width, options.camera_height = 1000, 800
    options.camera_model_id = pycolmap.CameraModelId.SIMPLE_RADIAL
    options.camera_params = lens
    options.num_points2D_without_point3D = 0
    model = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = 0.3
    pycolmap.synthesize_noise(noise, model)
    return model


TRUE_LENS = [900.0, 506.0, 395.0, 0.03]


def test_refinement_finds_the_lens() -> None:
    model = synthetic_model(6, TRUE_LENS)
    camera = next(iter(model.cameras.values()))
    camera.params = [930.0, 500.0, 400.0, 0.0]
    (decision,) = refine_lenses(model)
    np.testing.assert_allclose(camera.params[:3], TRUE_LENS[:3], atol=1.5)
    assert camera.params[3] == pytest.approx(TRUE_LENS[3], abs=0.01)
    assert model.compute_mean_reprojection_error() < 0.5
    assert "refined" in decision.choice


def test_two_photographs_leave_the_lens_alone() -> None:
    model = synthetic_model(2, TRUE_LENS)
    camera = next(iter(model.cameras.values()))
    camera.params = held = [930.0, 500.0, 400.0, 0.0]
    (decision,) = refine_lenses(model)
    np.testing.assert_array_equal(camera.params, held)
    assert "930 px" in decision.choice
