"""What outlines ask of cameras: that it holds of the true ones, and brings wrong ones back."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from jaxtyping import Float32, Float64
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from backend.maths.outline_agreement import incoherences, tangencies
from backend.maths.outline_fit import Features, fit_to_outlines, outlines_miss_px
from backend.maths.posed_views import POSE, PosedViews, posed_views
from backend.maths.silhouette import Silhouette, silhouette_or_none
from backend.scene import Photo, no_progress
from backend.stages.cameras import structure_from_motion
from backend.stages.cameras.features import picture_name
from backend.stages.cameras.outline_cameras import held_against_outlines
from tests.relative_rotations import rotation_errors_deg
from tests.synthetic_scene import CENTRE, SIZE, Scene, arc_cameras, photographed, surface_points

NUM_VIEWS = 5
NEAREST, FARTHEST = 2.0 * SIZE, 6.0 * SIZE
"""Of the body from the cameras."""


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Through lenses that look straight ahead, with square pixels."""
    cameras = arc_cameras(NUM_VIEWS, 110, 960)
    return photographed([replace(c, fy_px=c.fx_px, cx_px=c.width / 2, cy_px=c.height / 2) for c in cameras])


@pytest.fixture(scope="module")
def silhouettes(scene: Scene) -> list[Silhouette]:
    found = [silhouette_or_none(view.mask) for view in scene.views]
    return [silhouette for silhouette in found if silhouette is not None]


@pytest.fixture(scope="module")
def views(scene: Scene) -> PosedViews:
    """The true ones, of one lens."""
    return replace(posed_views(scene.cameras), lens=np.zeros(NUM_VIEWS, np.int64))


def misplaced(views: PosedViews, seed: int = 0, degrees: float = 3.0) -> PosedViews:
    """By so much about the subject's middle, more or less."""
    rng = np.random.default_rng(seed)
    turned = rng.normal(scale=math.radians(degrees), size=(len(views.lens), 3))
    turns = Rotation.from_rotvec(turned).as_matrix()
    middle = np.einsum("vij,j->vi", views.rotation, CENTRE) + views.translation
    rotation = turns @ views.rotation
    translation = middle - np.einsum("vij,j->vi", rotation, CENTRE)
    return replace(views, rotation=rotation, translation=translation)


def worst_rotation_deg(views: PosedViews, true: PosedViews) -> float:
    """Of the turn between two views."""
    return float(rotation_errors_deg(list(views.rotation), list(true.rotation)).max())


def shared_features(views: PosedViews, count: int, mistaken: int = 0) -> Features:
    """Of places on the body, seen by the two views that face them most, to a third of a pixel."""
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    places = surface_points(directions)
    facing = np.einsum("vi,pi->pv", views.positions - CENTRE, directions)
    pair = np.argsort(-facing, axis=1)[:, :2]
    view, place = pair.ravel(), np.repeat(np.arange(count), 2)
    pixels = views.shown(view, places[place])[0] + rng.normal(scale=0.3, size=(2 * count, 2))
    pixels[: 2 * mistaken] += rng.uniform(-40, 40, size=(2 * mistaken, 2))
    return Features(view=view, pixels=pixels, place=place)


def test_true_cameras_suit_their_outlines(views: PosedViews, silhouettes: list[Silhouette]) -> None:
    touched = tangencies(views, silhouettes)
    assert len(touched.beside_px) == 2 * NUM_VIEWS * (NUM_VIEWS - 1)
    assert np.abs(touched.beside_px).max() < 0.6  # outlines of whole pixels
    assert outlines_miss_px(views, silhouettes) < 0.06


def test_wrong_cameras_do_not(views: PosedViews, silhouettes: list[Silhouette]) -> None:
    wrong = misplaced(views)
    assert np.abs(tangencies(wrong, silhouettes).beside_px).mean() > 1.5
    assert outlines_miss_px(wrong, silhouettes) > 0.6


def test_a_view_that_holds_the_axis_says_nothing(views: PosedViews, silhouettes: list[Silhouette]) -> None:
    """A camera behind another sees it, or would, through the subject: no plane through both touches that."""
    aside = SIZE * (0.05 * views.rotation[0][0] + 0.4 * views.rotation[0][1])
    behind = CENTRE + 2 * (views.positions[0] - CENTRE) + aside
    translation = views.translation.copy()
    rotation = views.rotation.copy()
    rotation[1], translation[1] = rotation[0], -rotation[0] @ behind
    touched = tangencies(replace(views, rotation=rotation, translation=translation), silhouettes)
    assert not ((touched.view == 0) & (touched.other == 1)).any()
    assert ((touched.view == 0) & (touched.other == 2)).any()


def test_two_views_from_one_place_say_nothing_of_each_other(
    views: PosedViews, silhouettes: list[Silhouette]
) -> None:
    rotation, translation = views.rotation.copy(), views.translation.copy()
    rotation[1], translation[1] = rotation[0], translation[0]
    touched = tangencies(replace(views, rotation=rotation, translation=translation), silhouettes)
    assert not ((touched.view < 2) & (touched.other < 2)).any()
    assert np.isfinite(touched.beside_px).all()


def test_changes_are_derivatives(views: PosedViews, silhouettes: list[Silhouette]) -> None:
    wrong = misplaced(views)
    for lines in (tangencies(wrong, silhouettes), incoherences(wrong, silhouettes, NEAREST, FARTHEST)):
        assert len(lines.beside_px) > 10
        change = lines.change(wrong)

        def beside(step: Float64[np.ndarray, "unknowns"], lines=lines) -> Float64[np.ndarray, "lines"]:  # type: ignore[no-untyped-def]
            moved = wrong.moved(step)
            places = moved.places(lines.view, lines.pixels, lines.depth)
            return np.asarray((moved.shown(lines.other, places)[0] * lines.normal).sum(axis=1))

        for unknown in (0, 4, POSE + 2, POSE * NUM_VIEWS - 1, POSE * NUM_VIEWS):
            step = np.zeros(wrong.num_unknowns)
            step[unknown] = 1e-6
            slope = (beside(step) - beside(-step)) / 2e-6
            np.testing.assert_allclose(change[:, unknown], slope, rtol=1e-4, atol=1e-3)


def test_outlines_bring_cameras_back(views: PosedViews, silhouettes: list[Silhouette]) -> None:
    """With a few features between neighbours of which a tenth are mistaken."""
    wrong, features = misplaced(views), shared_features(views, 60, mistaken=6)
    assert worst_rotation_deg(wrong, views) > 4
    fit = fit_to_outlines(wrong, silhouettes, features, np.full(NUM_VIEWS, 0.02))
    assert worst_rotation_deg(fit.views, views) < 1.5
    assert np.median(np.linalg.norm(fit.beside_px(features), axis=1)) < 0.5


def test_true_cameras_stay(views: PosedViews, silhouettes: list[Silhouette]) -> None:
    fit = fit_to_outlines(views, silhouettes, shared_features(views, 60), np.full(NUM_VIEWS, 0.02))
    assert worst_rotation_deg(fit.views, views) < 1


def test_outlines_alone_are_enough_to_begin_with(views: PosedViews, silhouettes: list[Silhouette]) -> None:
    """No feature at all: outlines meet, and nothing fails."""
    fit = fit_to_outlines(misplaced(views), silhouettes, shared_features(views, 0), np.full(NUM_VIEWS, 0.05))
    assert outlines_miss_px(fit.views, silhouettes) < 0.15


def test_an_unknown_focal_length_is_found(views: PosedViews, silhouettes: list[Silhouette]) -> None:
    guess = replace(misplaced(views), focal_px=0.8 * views.focal_px)
    features = shared_features(views, 200)
    fit = fit_to_outlines(guess, silhouettes, features, np.full(NUM_VIEWS, 0.35))
    assert fit.views.focal_px == pytest.approx(views.focal_px, rel=0.03)
    held = fit_to_outlines(guess, silhouettes, features, np.full(NUM_VIEWS, 0.001))
    assert held.views.focal_px == pytest.approx(guess.focal_px, rel=0.01)


@pytest.mark.parametrize("kind", ["none", "empty", "cut"])
def test_masks_without_a_whole_outline(kind: str, scene: Scene) -> None:
    mask = scene.views[0].mask
    assert mask is not None
    changed = {"none": None, "empty": np.zeros_like(mask), "cut": mask[:, mask.shape[1] // 2 :]}[kind]
    assert silhouette_or_none(changed) is None


def model_of(
    views: PosedViews, scene: Scene, features: Features, database: Path
) -> tuple[pycolmap.Reconstruction, tuple[Photo, ...]]:
    """The views as mapping leaves them, pictures being half as large as photographs, without points."""
    width, height = scene.cameras[0].width, scene.cameras[0].height
    model = pycolmap.Reconstruction()
    lens = pycolmap.Camera(
        model="SIMPLE_RADIAL",
        width=width // 2,
        height=height // 2,
        params=[views.focal_px[0] / 2, width / 4, height / 4, 0.1],
    )
    lens.has_prior_focal_length = True
    with pycolmap.Database.open(database) as opened:
        lens.camera_id = opened.write_camera(lens)
        model.add_camera_with_trivial_rig(lens)
        ids, numbers = [], np.zeros(len(features.view), np.int64)
        for view in range(len(views.lens)):
            mine = np.flatnonzero(features.view == view)
            numbers[mine] = np.arange(len(mine))
            pixels = (features.pixels[mine] / 2).astype(np.float32)
            ids.append(opened.write_image(pycolmap.Image(name=picture_name(view), camera_id=lens.camera_id)))
            opened.write_keypoints(ids[-1], pixels)
            image = pycolmap.Image(
                name=picture_name(view), keypoints=pixels, camera_id=lens.camera_id, image_id=ids[-1]
            )
            pose = np.concatenate([views.rotation[view], views.translation[view, :, None]], axis=1)
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
        first, second = features.view[::2], features.view[1::2]
        for a in range(len(ids)):
            for b in range(a + 1, len(ids)):
                forth, back = (first == a) & (second == b), (first == b) & (second == a)
                of_a = np.concatenate([numbers[::2][forth], numbers[1::2][back]])
                of_b = np.concatenate([numbers[1::2][forth], numbers[::2][back]])
                geometry = pycolmap.TwoViewGeometry()
                geometry.inlier_matches = np.stack([of_a, of_b], axis=1).astype(np.uint32)
                opened.write_two_view_geometry(ids[a], ids[b], geometry)
    photos = tuple(
        Photo(
            name=view.name,
            path=Path(view.name),
            image_srgb=view.image_srgb,
            mask=view.mask,
            original_width=width,
            original_height=height,
            focal_px=None,
        )
        for view in scene.views
    )
    return model, photos


def posed(model: pycolmap.Reconstruction, views: PosedViews) -> PosedViews:
    """The model's poses."""
    poses = [model.images[i].cam_from_world() for i in sorted(model.reg_image_ids())]
    return replace(
        views,
        rotation=np.array([pose.rotation.matrix() for pose in poses]),
        translation=np.array([pose.translation for pose in poses]),
    )


def test_a_model_is_adjusted(views: PosedViews, scene: Scene, tmp_path: Path) -> None:
    wrong, features = misplaced(views), shared_features(views, 60, mistaken=6)
    model, photos = model_of(wrong, scene, features, tmp_path / "features.db")
    steps: list[None] = []
    adjusted, (decision,) = held_against_outlines(
        model, tmp_path / "features.db", photos, lambda: steps.append(None)
    )
    assert len(steps) > 5
    assert decision.choice == "adjusted"
    assert worst_rotation_deg(posed(adjusted, views), views) < 1.5
    assert worst_rotation_deg(posed(model, views), wrong) < 1e-6  # which is as it was
    (lens,) = adjusted.cameras.values()
    assert lens.params[0] == pytest.approx(views.focal_px[0] / 2, rel=0.1)
    assert lens.params[3] == 0
    assert 30 < adjusted.num_points3D() <= 60
    assert adjusted.compute_mean_reprojection_error() < 0.5
    assert all(point.track.length() == 2 for point in adjusted.points3D.values())


def test_outlines_that_hardly_miss_each_other_tell_as_well(
    views: PosedViews, silhouettes: list[Silhouette], scene: Scene, tmp_path: Path
) -> None:
    wrong = misplaced(views, degrees=0.4)
    assert outlines_miss_px(wrong, silhouettes) < 0.3
    model, photos = model_of(wrong, scene, shared_features(views, 300), tmp_path / "features.db")
    adjusted, (decision,) = held_against_outlines(model, tmp_path / "features.db", photos, lambda: None)
    assert decision.choice == "adjusted"
    assert worst_rotation_deg(posed(adjusted, views), views) < 0.5 * worst_rotation_deg(wrong, views)


def test_a_placement_tells_whether_outlines_moved_its_cameras(
    views: PosedViews, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    database = tmp_path / "features.db"
    model, photos = model_of(misplaced(views), scene, shared_features(views, 300), database)
    adjusted, _ = held_against_outlines(model, database, photos, lambda: None)
    without_masks = tuple(replace(photo, mask=None) for photo in photos)
    monkeypatch.setattr(structure_from_motion, "refine_lenses", lambda *_, **__: ())
    for mapped, shown, moved in [(model, photos, True), (adjusted, without_masks, False)]:
        monkeypatch.setattr(
            structure_from_motion, "best_model", lambda *_, found=mapped, **__: (found, database, ())
        )
        placement = structure_from_motion.estimate_placement(
            shown,
            max_side_px=scene.cameras[0].width // 2,
            max_features=1000,
            workdir=tmp_path,
            seed=0,
            progress=no_progress,
        )
        assert placement.suit_outlines == moved


def roughened(mask: Float32[np.ndarray, "height width"], seed: int) -> Float32[np.ndarray, "height width"]:
    """Its outline moved to and fro by two pixels."""
    rng = np.random.default_rng(seed)
    moved = [gaussian_filter(rng.normal(size=mask.shape), 8.0) for _ in range(2)]
    places = np.indices(mask.shape) + np.stack([2.0 * axis / axis.std() for axis in moved])
    return np.asarray(map_coordinates(mask, places, order=1), np.float32)


def test_cameras_are_not_moved_to_suit_the_faults_of_rough_masks(
    views: PosedViews, scene: Scene, tmp_path: Path
) -> None:
    features = shared_features(views, 60)
    model, photos = model_of(views, scene, features, tmp_path / "features.db")
    masks = [photo.mask for photo in photos]
    rough = [roughened(mask, seed) for seed, mask in enumerate(masks) if mask is not None]
    photos = tuple(replace(photo, mask=mask) for photo, mask in zip(photos, rough, strict=True))
    kept, (decision,) = held_against_outlines(model, tmp_path / "features.db", photos, lambda: None)
    assert kept is model
    assert decision.choice == "left as they are"


@pytest.mark.parametrize("why", ["no mask", "two photographs", "well confirmed"])
def test_a_model_whose_outlines_are_not_asked(
    why: str, views: PosedViews, scene: Scene, tmp_path: Path
) -> None:
    features = shared_features(views, 2000)
    model, photos = model_of(misplaced(views), scene, features, tmp_path / "features.db")
    if why == "no mask":
        photos = (replace(photos[0], mask=None), *photos[1:])
    if why == "two photographs":
        for image_id in sorted(model.reg_image_ids())[2:]:
            model.deregister_frame(model.images[image_id].frame_id)
    if why == "well confirmed":
        ids = sorted(model.reg_image_ids())
        for feature in range(200):
            track = pycolmap.Track()
            for image_id in ids:
                track.add_element(image_id, feature)
            model.add_point3D(CENTRE, track)
    kept, decisions = held_against_outlines(model, tmp_path / "features.db", photos, lambda: None)
    assert kept is model
    assert decisions == ()
