"""pycolmap's bundle adjustment, triangulation and covariance against the plain reference in torch."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import PIL.Image  # noqa: F401 - before pycolmap
import pycolmap
import pytest
import torch

from backend.maths.gauge import in_gauge_of_the_whole
from backend.scene import Camera
from backend.stages.cameras.camera_evidence import covariances_or_none, offsets_px
from backend.stages.cameras.lenses import rigid_matrix, shared_tracks
from backend.stages.cameras.triangulation import two_view_points
from tests.bundle_adjustment_reference import (
    NUM_GAUGE,
    Adjusted,
    Observations,
    adjusted,
    projected,
    triangulated_linearly,
)

LENS = [900.0, 506.0, 395.0, 0.03]
NOISE_PX = 0.3


@dataclass(frozen=True, kw_only=True)
class Case:
    """One adjustment, as pycolmap and as the reference hold it."""

    model: pycolmap.Reconstruction
    image_ids: list[int]
    seen: Observations
    poses: torch.Tensor
    points: torch.Tensor


def synthetic_case(num_images: int, num_points: int) -> Case:
    """Cameras all around points, not at the least squares: points are moved off by a hundredth."""
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, num_images, num_points
    options.camera_width, options.camera_height = 1000, 800
    options.camera_model_id = pycolmap.CameraModelId.SIMPLE_RADIAL
    options.camera_params = LENS
    options.num_points2D_without_point3D = 0
    model = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev, noise.point3D_stddev = NOISE_PX, 0.01
    pycolmap.synthesize_noise(noise, model)
    image_ids = sorted(model.reg_image_ids())
    tracks = shared_tracks(model, image_ids)
    elements = [
        (view, row, model.images[image_ids[view]].points2D[number].xy)
        for row, track in enumerate(tracks.values())
        for view, number in track.items()
    ]
    cameras, points, pixels = zip(*elements, strict=True)
    seen = Observations(
        lens=torch.tensor(LENS, dtype=torch.float64),
        camera=torch.tensor(cameras),
        point=torch.tensor(points),
        pixels=torch.tensor(np.array(pixels)),
    )
    return Case(
        model=model,
        image_ids=image_ids,
        seen=seen,
        poses=torch.tensor(poses_of(model, image_ids)),
        points=torch.tensor(np.array([model.points3D[point].xyz for point in tracks])),
    )


def poses_of(model: pycolmap.Reconstruction, image_ids: list[int]) -> np.ndarray:
    return np.array([rigid_matrix(model.images[i].cam_from_world()) for i in image_ids])


def adjust_model(case: Case, *, lens_free: bool, cameras_free: bool = True) -> None:
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = lens_free
    options.refine_rig_from_world = cameras_free
    options.ceres.solver_options.gradient_tolerance = 1e-13
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in case.image_ids:
        config.add_image(image_id)
    if cameras_free:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_ceres_bundle_adjuster(options, config, case.model).solve()


@cache
def solved(num_images: int, lens_free: bool) -> tuple[Case, Adjusted]:
    """Both at their least squares, from the same start."""
    case = synthetic_case(num_images, 25)
    reference = adjusted(case.seen, case.poses, case.points, lens_free=lens_free)
    adjust_model(case, lens_free=lens_free)
    return case, reference


CASES = pytest.mark.parametrize(("num_images", "lens_free"), [(2, False), (4, False), (4, True)])


@CASES
def test_both_end_at_the_same_cameras_and_points(num_images: int, lens_free: bool) -> None:
    """Up to a similarity, to 1e-6 of the scene's size and 1e-6 radians."""
    case, reference = solved(num_images, lens_free)
    found = poses_of(case.model, case.image_ids)
    points = np.array([case.model.points3D[p].xyz for p in shared_tracks(case.model, case.image_ids)])
    wanted = reference.points.numpy()
    world_from_found = pycolmap.estimate_sim3d(points, wanted)
    np.testing.assert_allclose(world_from_found * points, wanted, atol=1e-6 * np.ptp(wanted))
    for pose, other in zip(found, reference.camera_from_world.numpy(), strict=True):
        turned = pose[:3, :3] @ world_from_found.rotation.inverse().matrix()
        np.testing.assert_allclose(turned, other[:3, :3], atol=1e-6)
        centre = world_from_found * (-pose[:3, :3].T @ pose[:3, 3])
        np.testing.assert_allclose(centre, -other[:3, :3].T @ other[:3, 3], atol=1e-6 * np.ptp(wanted))
    (camera,) = case.model.cameras.values()
    np.testing.assert_allclose(camera.params, reference.lens, rtol=1e-6, atol=1e-6)
    offsets = offsets_px(case.model, case.image_ids)
    np.testing.assert_allclose((offsets**2).sum(), reference.residuals.square().sum(), rtol=1e-9)
    start = projected(case.seen.lens, case.poses[case.seen.camera], case.points[case.seen.point])
    assert (start - case.seen.pixels).square().sum() > 10 * reference.residuals.square().sum()


@CASES
def test_both_are_as_sure_of_the_cameras(num_images: int, lens_free: bool) -> None:
    """What the page says, from pycolmap with two cameras fixed, and the pseudo-inverse with nothing fixed.

    pycolmap damps its points by 1e-8, which is what is left of a difference.
    """
    case, _ = solved(num_images, lens_free)
    offsets = offsets_px(case.model, case.image_ids)
    found, point_sigmas = covariances_or_none(case.model, case.image_ids, offsets, lenses_free=lens_free)
    assert found is not None
    assert point_sigmas is not None
    poses = poses_of(case.model, case.image_ids)
    world_from_twist = np.zeros((6 * num_images, 6 * num_images))
    for i, pose in enumerate(poses):
        world_from_twist[6 * i : 6 * i + 3, 6 * i : 6 * i + 3] = -pose[:3, :3].T
        world_from_twist[6 * i + 3 : 6 * i + 6, 6 * i + 3 : 6 * i + 6] = -pose[:3, :3].T
    # The reference is linearised where pycolmap ended, in pycolmap's world.
    points = np.array([case.model.points3D[p].xyz for p in shared_tracks(case.model, case.image_ids)])
    lens = torch.tensor(np.array(next(iter(case.model.cameras.values())).params))
    seen = Observations(lens=lens, camera=case.seen.camera, point=case.seen.point, pixels=case.seen.pixels)
    there = adjusted(seen, torch.tensor(poses), torch.tensor(points), lens_free=lens_free, rounds=0)
    joint = there.covariance[: 6 * num_images, : 6 * num_images].numpy()
    centres = np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])
    distance = np.sqrt(((centres - np.median(points, axis=0)) ** 2).sum(axis=1).mean())
    free = in_gauge_of_the_whole(world_from_twist @ joint @ world_from_twist.T, centres, float(distance))
    num_unknown = 6 * num_images + 3 * len(points) + (4 if lens_free else 0) - NUM_GAUGE
    variance = float(there.residuals.square().sum()) / (2 * len(seen.pixels) - num_unknown)
    for i in range(num_images):
        wanted = variance * free[6 * i : 6 * i + 6, 6 * i : 6 * i + 6]
        np.testing.assert_allclose(found[i], wanted, atol=1e-5 * np.abs(wanted).max())


def test_points_are_as_sure_as_the_reference_says() -> None:
    """With the cameras held."""
    case, _ = solved(4, False)
    offsets = offsets_px(case.model, case.image_ids)
    _, sigmas = covariances_or_none(case.model, case.image_ids, offsets, lenses_free=False)
    points = np.array([case.model.points3D[p].xyz for p in shared_tracks(case.model, case.image_ids)])
    held = adjusted(
        case.seen,
        torch.tensor(poses_of(case.model, case.image_ids)),
        torch.tensor(points),
        cameras_free=False,
        rounds=0,
    )
    blocks = held.covariance[24:-4, 24:-4].unflatten(0, (-1, 3)).unflatten(2, (-1, 3))
    own = blocks[torch.arange(len(points)), :, torch.arange(len(points))]
    largest = torch.linalg.eigvalsh(own)[:, -1].sqrt().numpy()
    assert sigmas is not None
    ratio = sigmas / largest
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-5)
    assert ratio[0] == pytest.approx(NOISE_PX, rel=0.3), "the noise is found in what is left over"


def test_triangulation_by_three_ways() -> None:
    """Exact pixels: the point to 1e-9. Noisy ones: the closed forms lie within a fifth of the noise's own
    scatter of the least squares, which pycolmap and the reference find alike to 1e-8."""
    case = synthetic_case(2, 25)
    exact = projected(torch.tensor([*LENS[:3], 0.0]), case.poses[:, None], case.points[None]).numpy()
    a, b = (pinhole(pose) for pose in case.poses.numpy())
    ours, good = two_view_points(a, b, exact[0], exact[1])
    assert good.mean() > 0.9
    np.testing.assert_allclose(ours[good], case.points.numpy()[good], atol=1e-9)
    matrices = torch.tensor(np.array([c.intrinsics @ c.camera_from_world[:3] for c in (a, b)]))
    for index, point in enumerate(case.points):
        linear = triangulated_linearly(matrices, torch.tensor(exact[:, index]))
        np.testing.assert_allclose(linear, point, atol=1e-9)

    noisy = exact + NOISE_PX * np.random.default_rng(0).normal(size=exact.shape)
    seen = Observations(
        lens=torch.tensor([*LENS[:3], 0.0]),
        camera=torch.tensor([0, 1]).repeat_interleave(len(case.points)),
        point=torch.arange(len(case.points)).repeat(2),
        pixels=torch.tensor(noisy.reshape(-1, 2)),
    )
    best = adjusted(seen, case.poses, case.points, cameras_free=False)
    sigma = NOISE_PX * best.covariance.diagonal()[12:-4].unflatten(0, (-1, 3)).sum(1).sqrt().numpy()
    middle, good = two_view_points(a, b, noisy[0], noisy[1])
    # pycolmap's is the linear one, of coordinates in the camera instead of pixels
    rays = (noisy - np.array(LENS[1:3])) / LENS[0]
    poses = [camera.camera_from_world[:3] for camera in (a, b)]
    colmap = np.array([pycolmap.triangulate_point(*poses, *pair) for pair in rays.transpose(1, 0, 2)[good]])
    assert np.median(np.linalg.norm(colmap - best.points.numpy()[good], axis=1) / sigma[good]) < 0.2
    off = np.linalg.norm(middle - best.points.numpy(), axis=1) / sigma
    assert np.median(off[good]) < 0.2
    linear = torch.stack(
        [triangulated_linearly(matrices, torch.tensor(noisy[:, i])) for i in range(len(case.points))]
    )
    assert np.median((linear - best.points).norm(dim=1).numpy() / sigma) < 0.2
    assert np.linalg.norm(best.points - case.points, axis=1).max() > 0.1 * sigma.max(), "there is noise"


def pinhole(pose: np.ndarray) -> Camera:
    focal_px, cx_px, cy_px, _ = LENS
    return Camera(
        camera_from_world=pose,
        fx_px=focal_px,
        fy_px=focal_px,
        cx_px=cx_px,
        cy_px=cy_px,
        width=1000,
        height=800,
    )


def test_points_of_held_cameras_by_pycolmap_and_the_reference() -> None:
    case = synthetic_case(3, 25)
    best = adjusted(case.seen, case.poses, case.points, cameras_free=False)
    adjust_model(case, lens_free=False, cameras_free=False)
    found = np.array([case.model.points3D[p].xyz for p in shared_tracks(case.model, case.image_ids)])
    np.testing.assert_allclose(found, best.points, atol=1e-8)


def test_nothing_left_over_says_nothing() -> None:
    """Two cameras and five points: as many equations as unknowns, so no error shows."""
    case = synthetic_case(2, 5)
    offsets = offsets_px(case.model, case.image_ids)
    assert covariances_or_none(case.model, case.image_ids, offsets, lenses_free=False) == (None, None)
