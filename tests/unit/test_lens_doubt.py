"""Focal lengths from EXIF that are wrong, as of cropped photographs, and what is done then."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from backend.scene import no_progress
from backend.stages.cameras import features, focal_search, model_merit
from backend.stages.cameras.bundle_adjustment import adjust_bundle
from backend.stages.cameras.lens_doubt import contradicted_lenses
from backend.stages.cameras.lens_refinement import refine_lenses
from backend.stages.cameras.solving import CamerasConfig, solve_cameras
from tests.ridge_photos import FOCAL_PX, HEIGHT, WIDTH, arc_pose, make_photo, render

TRUE_FOCAL_PX = 1300.0


def model_as_mapped(
    ratios: list[float], *, known: bool = True, photos_each: int = 2
) -> pycolmap.Reconstruction:
    """Of one lens for each ratio: the focal length that is told, and held, beside the true one."""
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = len(ratios), photos_each, 400
    options.camera_width, options.camera_height = 1000, 800
    options.camera_model_id = pycolmap.CameraModelId.SIMPLE_RADIAL
    options.camera_params = [TRUE_FOCAL_PX, 500.0, 400.0, 0.0]
    options.num_points2D_without_point3D = 0
    model = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = 0.3
    pycolmap.synthesize_noise(noise, model)
    for camera_id, ratio in zip(sorted(model.cameras), ratios, strict=True):
        model.cameras[camera_id].focal_length = ratio * TRUE_FOCAL_PX
        model.cameras[camera_id].has_prior_focal_length = known
    adjust_bundle(model, free_lens=False, robust_scale_px=0.5)
    model.update_point_3d_errors()
    return model


@pytest.mark.parametrize(
    ("ratios", "contradicted"),
    [
        ([1.0, 1.0, 1.0], []),
        ([1.06, 0.95, 1.0], []),
        ([0.7, 0.7, 0.7], [0, 1, 2]),
        ([1.0, 0.7, 1.0], [1]),
        ([1.4, 0.6, 1.0], [0, 1]),
    ],
)
def test_photographs_contradict_wrong_focal_lengths_alone(
    ratios: list[float], contradicted: list[int]
) -> None:
    model = model_as_mapped(ratios)
    ids = sorted(model.cameras)
    before = {i: np.array(model.cameras[i].params) for i in ids}, model.num_points3D()
    assert contradicted_lenses(model) == {ids[place] for place in contradicted}
    for camera_id in ids:
        np.testing.assert_array_equal(model.cameras[camera_id].params, before[0][camera_id])
    assert model.num_points3D() == before[1]


def test_what_nothing_tells_is_not_contradicted() -> None:
    assert not contradicted_lenses(model_as_mapped([0.7, 0.7, 0.7], known=False))
    assert not contradicted_lenses(model_as_mapped([0.7], photos_each=2)), "two photographs say too little"
    assert not contradicted_lenses(pycolmap.Reconstruction())


@pytest.mark.parametrize(
    ("merit", "than", "better"),
    [
        ((2, 0, 300), (2, 0, 200), False),
        ((3, 10, 300), (3, 10, 200), False),
        ((3, 105, 0), (3, 100, 0), False),
        ((3, 106, 0), (3, 100, 0), True),
        ((3, 1, 0), (3, 0, 900), True),
        ((4, 20, 0), (3, 100, 0), True),
        ((2, 500, 0), (3, 100, 0), False),
    ],
)
def test_clearly_better_is_more_photographs_or_a_twentieth_more_confirmed_points(
    merit: tuple[int, int, int], than: tuple[int, int, int], better: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What only two photographs see says nothing: a tie is a tie whatever their number."""
    merits = {(one := pycolmap.Reconstruction()): merit, (other := pycolmap.Reconstruction()): than}
    monkeypatch.setattr(model_merit, "merit", merits.__getitem__)
    assert model_merit.is_clearly_better(one, other) == better


@pytest.mark.parametrize(
    ("confirmed", "fewest", "is_taken"), [(200, 60, True), (98, 60, True), (90, 60, False), (200, 20, False)]
)
def test_without_exif_cameras_are_kept_if_confirmed_and_not_clearly_worse(
    confirmed: int, fewest: int, is_taken: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ("0000.png", "0001.png")
    for name, width in zip(names, (64, 60), strict=True):
        PIL.Image.new("L", (width, 48)).save(tmp_path / name)
    groups = [
        features.LensGroup(names=(name,), width=width, height=48, focal_px=50.0)
        for name, width in zip(names, (64, 60), strict=True)
    ]
    database = tmp_path / "a.db"
    features.register_pictures(database, tmp_path, groups)
    usual, other = pycolmap.Reconstruction(), pycolmap.Reconstruction()
    merits = {usual: (3, 100, 0), other: (3, confirmed, 0)}
    told: list[dict[int, tuple[bool, float]]] = []

    def mapped(path: Path) -> list[pycolmap.Reconstruction]:
        for place in (path, database):
            with pycolmap.Database.open(place) as opened:
                lenses = opened.read_all_cameras()
            told.append({lens.camera_id: (lens.has_prior_focal_length, lens.focal_length) for lens in lenses})
        return [other]

    for module in (model_merit, focal_search):
        monkeypatch.setattr(module, "merit", merits.__getitem__)
    monkeypatch.setattr(focal_search, "fewest_confirming", lambda _: fewest)
    monkeypatch.setattr(focal_search, "contradicted_lenses", lambda _: {2})
    kept = focal_search.without_contradicted_exif(usual, database, mapped)
    assert (kept is other) == is_taken
    assert told == [{1: (True, 50.0), 2: (False, 1.2 * 60)}, {1: (True, 50.0), 2: (True, 50.0)}]


def test_a_focal_length_found_against_exif_is_kept_where_lenses_slide() -> None:
    """Lenses of their own, free with their principal points, are told only by what mapping found."""
    free, held = model_as_mapped([1.1] * 3, known=False), model_as_mapped([1.1] * 3, known=False)
    refine_lenses(free)
    refine_lenses(held, mapped_well=held.cameras.keys())
    for camera_id in held.cameras:
        moved = [abs(model.cameras[camera_id].focal_length - 1.1 * TRUE_FOCAL_PX) for model in (held, free)]
        assert moved[0] < moved[1]


def test_photographs_cropped_one_by_one_that_keep_their_exif(tmp_path: Path) -> None:
    """Their focal lengths in longer sides are those of the whole, a third too short."""
    sizes = [(300, 225), (290, 230), (280, 220)]
    poses = [arc_pose(angle) for angle in (-15.0, 0.0, 15.0)]
    photos = []
    for number, (pose, (width, height)) in enumerate(zip(poses, sizes, strict=True)):
        left, top = (WIDTH - width) // 2, (HEIGHT - height) // 2
        cropped = render(pose)[top : top + height, left : left + width]
        told_px = FOCAL_PX * math.hypot(width, height) / math.hypot(WIDTH, HEIGHT)
        photo = make_photo(f"{number}.png", cropped, told_px)
        photos.append(replace(photo, original_width=width, original_height=height))
    config = CamerasConfig(max_features=1200)
    solved = solve_cameras(photos, None, config, workdir=tmp_path, seed=0, progress=no_progress)
    assert len(solved.views) == 3
    first, *others = (view.camera.camera_from_world[:3, :3] for view in solved.views)
    for ours, pose in zip(others, poses[1:], strict=True):
        error = (ours @ first.T).T @ (pose[:3, :3] @ poses[0][:3, :3].T)
        assert math.degrees(Rotation.from_matrix(error).magnitude()) < 0.5
    for view in solved.views:
        assert view.camera.fx_px == pytest.approx(FOCAL_PX, rel=0.05)
    told = [decision for decision in solved.decisions if decision.what.startswith("EXIF")]
    assert [decision.choice for decision in told] == 3 * ["its focal length is not believed"]
