"""Cameras in hard places: the usual formula runs and fails, ours does not. Figures: docs/stability.md."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image  # noqa: F401 - before pycolmap
import pycolmap
import pytest
import torch
from scipy.spatial.transform import Rotation

from backend.errors import ErrorCode, ReconstructionError
from backend.maths.angles import angles_between
from backend.maths.geometry import (
    epipolar_map,
    inside,
    pinhole_in_object,
    pixel_centres,
    project,
    warp_pixels,
)
from backend.maths.raycast import in_picture
from backend.scene import Camera, Region, SolvedCameras, no_progress, transform_points
from backend.stages.cameras.camera_evidence import covariances_or_none, offsets_px
from backend.stages.cameras.solving import CamerasConfig, solve_cameras
from backend.stages.cameras.triangulation import two_view_points
from tests.ridge_photos import FOCAL_PX, arc_pose, look_at_origin, make_photo, render

CPU = torch.device("cpu")
ANGLES = tuple(10.0**-power for power in range(1, 8))


def camera_at(position: np.ndarray, focal_px: float = 1000.0) -> Camera:
    """Looks along z over a picture of 640 x 480."""
    pose = np.eye(4)
    pose[:3, 3] = -position
    return Camera(
        camera_from_world=pose,
        fx_px=focal_px,
        fy_px=focal_px,
        cx_px=320.0,
        cy_px=240.0,
        width=640,
        height=480,
    )


def pixels_of(camera: Camera, points: np.ndarray) -> np.ndarray:
    homogeneous = transform_points(camera.camera_from_world, points) @ camera.intrinsics.T
    return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:])


# Rays that are nearly parallel.


def depth_by_cosines(a: np.ndarray, b: np.ndarray, apart: np.ndarray) -> np.ndarray:
    """Along unit rays a to where they are nearest to b: the usual solution of the two normal equations."""
    cosine = (a * b).sum(axis=-1)
    return np.asarray(((a * apart).sum(-1) - cosine * (b * apart).sum(-1)) / (1 - cosine**2))


def test_depth_of_nearly_parallel_rays() -> None:
    """Exact pixels of a point ahead; what the pixels' own rounding allows is 1e-16 over the angle."""
    usual, ours = [], []
    for angle in ANGLES:
        point = np.array([[0.1, -0.2, 1.0]])
        a, b = camera_at(np.zeros(3)), camera_at(np.array([angle, 0, 0]))
        found, _ = two_view_points(a, b, pixels_of(a, point), pixels_of(b, point))
        ours.append(abs(found[0, 2] - 1.0))
        rays = [np.column_stack([(pixels_of(c, point) - (320, 240)) / 1000, [1.0]]) for c in (a, b)]
        length = np.linalg.norm(rays[0])
        unit = [ray / np.linalg.norm(ray) for ray in rays]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = depth_by_cosines(unit[0], unit[1], np.array([[angle, 0, 0]]))[0] / length
        usual.append(abs(depth - 1.0) if np.isfinite(depth) else math.inf)
    assert (np.array(ours) * np.array(ANGLES) < 1e-14).all(), ours
    assert max(usual) > 1e-3
    assert max(ours) < 1e-7


def test_angles_of_nearly_parallel_rays() -> None:
    """Down to 1e-12 radians, and as near to opposite."""
    exact = 10.0 ** -np.arange(1, 13)
    first = np.tile([1.0, 0.0, 0.0], (12, 1))
    second = np.stack([np.cos(exact), np.sin(exact), np.zeros(12)], axis=1)
    usual = np.arccos(np.clip((first * second).sum(axis=1), -1, 1))
    assert np.abs(usual / exact - 1).max() == 1.0, "nothing but 0 below 1e-8"
    np.testing.assert_allclose(angles_between(first, second), exact, rtol=1e-12)
    np.testing.assert_allclose(np.pi - angles_between(first, -second), exact, rtol=1e-3, atol=1e-15)


# Points behind the camera.


def test_points_behind_the_camera_are_not_seen() -> None:
    """x / z puts them into the middle of the picture, mirrored."""
    camera = camera_at(np.zeros(3))
    points = np.random.default_rng(0).uniform([-0.2, -0.2, -4], [0.2, 0.2, -1], (100, 3))
    usual = pixels_of(camera, points)
    assert ((usual > 0) & (usual < (640, 480))).all()
    assert not in_picture(points, camera).any()
    pinhole = pinhole_in_object(camera, Region(object_from_world=np.eye(4)), CPU)
    pixels, depth = project(pinhole, torch.tensor(points, dtype=torch.float32))
    assert bool((depth < 0).all())
    assert bool(pixels.isfinite().all())
    at_centre = torch.zeros(1, 3)
    assert bool(project(pinhole, at_centre)[0].isfinite().all()), "nor where depth is 0"


def test_what_a_source_has_behind_it_is_thrown_out_of_its_picture() -> None:
    """Two cameras face each other; what the first sees beyond the second lies behind that."""
    back = np.diag([-1.0, 1.0, -1.0, 1.0])
    back[2, 3] = 2.0
    reference = camera_at(np.zeros(3))
    source = replace(reference, camera_from_world=back)
    world = Region(object_from_world=np.eye(4))
    a, b = epipolar_map(pinhole_in_object(source, world, CPU), pinhole_in_object(reference, world, CPU))
    pixels = pixel_centres(640, 480, CPU)
    beyond = torch.full((1, 480, 640), 1 / 6.0)
    homogeneous = pixels @ a[:, :2].T + a[:, 2] + beyond[0, ..., None] * b
    usual = homogeneous[..., :2] / homogeneous[..., 2:]
    assert float(inside(usual, 640, 480).float().mean()) > 0.4, "4 units behind it, 6 before the first"
    ours = warp_pixels(a, b, pixels, beyond)
    assert bool(ours.isfinite().all())
    assert float(inside(ours, 640, 480).float().mean()) < 1e-3


def test_points_that_triangulate_behind_are_none() -> None:
    """Linear triangulation puts rays that part in front of the cameras together behind them."""
    a, b = camera_at(np.array([-0.5, 0, 0])), camera_at(np.array([0.5, 0, 0]))
    behind = np.random.default_rng(0).uniform([-1, -1, -6], [1, 1, -3], (50, 3))
    seen_a, seen_b = pixels_of(a, behind), pixels_of(b, behind)
    matrices = [camera.intrinsics @ camera.camera_from_world[:3] for camera in (a, b)]
    for index in range(50):
        rows = np.concatenate(
            [p[:, None] * m[2] - m[:2] for p, m in zip((seen_a[index], seen_b[index]), matrices, strict=True)]
        )
        solution = np.linalg.svd(rows)[2][-1]
        assert solution[2] / solution[3] < 0
    assert not two_view_points(a, b, seen_a, seen_b)[1].any()


# A plane, and a turn on the spot.


def eight_point(one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The essential matrix of rays with z = 1, and the singular values of its equations; Longuet-Higgins."""
    rows = np.einsum("pi,pj->pij", other, one).reshape(-1, 9)
    _, values, right = np.linalg.svd(rows)
    return right[-1].reshape(3, 3), values


def rotation_of_best_pose_deg(essential: np.ndarray, true: np.ndarray) -> float:
    """Of the two rotations that an essential matrix allows, the better one's error."""
    left, _, right = np.linalg.svd(essential)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    found = [left @ t @ right for t in (turn, turn.T)]
    found = [r * np.sign(np.linalg.det(r)) for r in found]
    return float(np.degrees(min(Rotation.from_matrix(r @ true.T).magnitude() for r in found)))


def two_views(points: np.ndarray, camera_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rays to the points from the origin and from a pose, with half a pixel of noise at f = 420 px."""
    noise = np.random.default_rng(1).normal(0, 0.5 / FOCAL_PX, (2, len(points), 2))
    rays = []
    for pose, off in zip((np.eye(4), camera_b), noise, strict=True):
        in_camera = transform_points(pose, points)
        flat = in_camera[:, :2] / in_camera[:, 2:] + off
        rays.append(np.column_stack([flat, np.ones(len(points))]))
    return rays[0], rays[1]


@pytest.mark.slow
def test_a_plane_does_not_mislead_the_cameras(tmp_path: Path) -> None:
    """Eight points of a plane leave two more directions open; COLMAP asks a homography as well."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", 20, degrees=True).as_matrix()
    pose[:3, 3] = [-1.0, 0.1, 0.2]
    flat = np.random.default_rng(0).uniform(-1, 1, (200, 3)) * [1, 1, 0] + [0, 0, 3]
    deep = flat + np.random.default_rng(2).uniform(-1, 1, (200, 3)) * [0, 0, 1]
    usual, values = eight_point(*two_views(flat, pose))
    assert values[6] < 0.05 * values[5], "two more directions that noise alone decides"
    assert rotation_of_best_pose_deg(usual, pose[:3, :3]) > 3
    assert rotation_of_best_pose_deg(eight_point(*two_views(deep, pose))[0], pose[:3, :3]) < 1
    solved = solved_from([arc_pose(angle) for angle in (-25.0, -5.0, 20.0)], tmp_path, slope=0.0)
    first = solved.views[0].camera.camera_from_world
    for view, angle in zip(solved.views, (-25.0, -5.0, 20.0), strict=True):
        found = view.camera.camera_from_world @ np.linalg.inv(first)
        true = arc_pose(angle) @ np.linalg.inv(arc_pose(-25.0))
        error = Rotation.from_matrix(found[:3, :3] @ true[:3, :3].T).magnitude()
        assert np.degrees(error) < 0.1
    assert solved.evidence is not None
    assert not solved.evidence.lenses_free, "a plane does not tell the lens"


@pytest.mark.slow
def test_a_turn_on_the_spot_is_refused(tmp_path: Path) -> None:
    """The eight-point algorithm gives a baseline of length 1 where there is none."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", 7, degrees=True).as_matrix()
    points = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 4], (200, 3))
    essential, values = eight_point(*two_views(points, pose))
    assert np.linalg.svd(essential)[1][0] > 0.5, "a baseline"
    assert values[6] < 0.05 * values[5]
    spot = np.array([0.6, 0.2, -2.8])
    with pytest.raises(ReconstructionError) as caught:
        solved_from([look_at_origin(spot, turn) for turn in (-7.0, 0.0, 6.0)], tmp_path)
    assert caught.value.code == ErrorCode.NO_PARALLAX


def solved_from(poses: list[np.ndarray], workdir: Path, slope: float = 0.8) -> SolvedCameras:
    photos = [make_photo(f"{i}.png", render(pose, slope), FOCAL_PX) for i, pose in enumerate(poses)]
    config = CamerasConfig(max_features=1200)
    return solve_cameras(photos, None, config, workdir=workdir, seed=0, progress=no_progress)


# Narrow baselines.

NOISE_PX, DEPTH = 0.3, 5.0


def narrow_model(baseline: float) -> pycolmap.Reconstruction:
    """Two cameras side by side, three hundred points in front of them, and noise."""
    random = np.random.default_rng(0)
    points = random.uniform([-1.0, -1.0, DEPTH - 0.2], [1.0, 1.0, DEPTH + 0.2], (300, 3))
    model = pycolmap.Reconstruction()
    tracks = [pycolmap.Track() for _ in points]
    for number in (1, 2):
        camera = camera_at(np.array([baseline * (number - 1.5), 0, 0]))
        lens = pycolmap.Camera(model="SIMPLE_PINHOLE", width=640, height=480, params=[1000.0, 320.0, 240.0])
        lens.camera_id = number
        model.add_camera_with_trivial_rig(lens)
        pixels = pixels_of(camera, points) + random.normal(0, NOISE_PX, (300, 2))
        image = pycolmap.Image(name=str(number), keypoints=pixels, camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(camera.camera_from_world[:3]))
        for index, track in enumerate(tracks):
            track.add_element(number, index)
    for point, track in zip(points, tracks, strict=True):
        model.add_point3D(point, track)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = options.refine_rig_from_world = False
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    config = pycolmap.BundleAdjustmentConfig()
    config.add_image(1)
    config.add_image(2)
    pycolmap.create_default_ceres_bundle_adjuster(options, config, model).solve()
    return model


def test_the_reported_uncertainty_grows_as_the_baseline_shrinks() -> None:
    """z^2 / (f b) times the noise of a disparity, sqrt(2) that of a pixel; the scatter of depths is the same.

    The usual measure, the reprojection error, is the same at every baseline.
    """
    usual_px = []
    for baseline in (1.0, 0.3, 0.1, 0.03):
        model = narrow_model(baseline)
        offsets = offsets_px(model, [1, 2])
        _, sigmas = covariances_or_none(model, [1, 2], offsets, lenses_free=False)
        assert sigmas is not None
        expected = DEPTH**2 / (1000.0 * baseline) * math.sqrt(2) * NOISE_PX
        assert np.median(sigmas) == pytest.approx(expected, rel=0.15), "the noise itself is found to 6 %"
        true = np.random.default_rng(0).uniform([-1.0, -1.0, DEPTH - 0.2], [1.0, 1.0, DEPTH + 0.2], (300, 3))
        found = np.array([model.points3D[i].xyz for i in sorted(model.points3D)])
        assert np.std(found[:, 2] - true[:, 2]) == pytest.approx(np.median(sigmas), rel=0.3)
        usual_px.append(float(np.sqrt((offsets**2).mean())))
    assert max(usual_px) / min(usual_px) < 1.2
