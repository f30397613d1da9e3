"""Photographs, masks and points as they should not be: a sensible mesh or a clear error, and an end to it.

Small photographs and a coarse grid: a cell is 3 % of the body's diagonal wide.
"""

import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from backend.errors import ErrorCode, ReconstructionError
from backend.maths.correlation import correlation, patch_statistics
from backend.maths.evidence import merged_points
from backend.maths.nearest import nearest_tree
from backend.scene import Photo, SolvedCameras, SurfaceMesh, SurfacePoints, no_progress
from backend.stages.cameras import CamerasConfig, solve_cameras
from backend.stages.mesh import MeshConfig, extract_mesh
from backend.stages.point_cloud import read_cloud
from backend.stages.region import RegionConfig, find_region
from backend.stages.stereo import match_views
from backend.stages.stereo_config import StereoConfig
from backend.stages.strays import strays, without_strays
from backend.stages.train import TrainConfig, fit_surface
from tests import synthetic_scene
from tests.synthetic_scene import (
    CENTRE,
    SIZE,
    Scene,
    arc_cameras,
    diagonal,
    photographed,
    ring_cameras,
    surface_distance,
    surface_points,
    texture_srgb,
)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(signal, "SIGALRM"), reason="a hang is noticed by SIGALRM"),
]

CPU = torch.device("cpu")
LONGEST_S = 120
"""Of a run that takes some seconds on an idle core."""
Image = np.ndarray
Points = Callable[[SurfacePoints], SurfacePoints]


@pytest.fixture(autouse=True)
def _no_hang() -> Iterator[None]:
    def too_long(_signal: int, _frame: object) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, too_long)
    signal.alarm(LONGEST_S)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def sparse_points(outliers: int = 0) -> np.ndarray:
    """Two hundred points of the body, and as many as wanted anywhere in a ball five times as large."""
    random = np.random.default_rng(0)
    directions = random.normal(size=(200 + outliers, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    anywhere = CENTRE + 5 * SIZE * directions[200:] * random.random((outliers, 1)) ** (1 / 3)
    return np.concatenate([surface_points(directions[:200]), anywhere])


def as_they_are(points: SurfacePoints) -> SurfacePoints:
    return points


def reconstructed(solved: SolvedCameras, changed: Points = as_they_are) -> SurfaceMesh:
    """From cameras on, as a run does it; what stereo found is changed first."""
    region = find_region(solved, RegionConfig(), progress=no_progress)
    stereo = match_views(solved.views, region, StereoConfig(), device=CPU, progress=no_progress)
    # as at the end of stereo, whose own points are spoiled here
    stereo = replace(stereo, points=without_strays(changed(stereo.points)))
    config = TrainConfig(levels=(32,), rounds=(4,), steps=(0,))
    chance = torch.Generator().manual_seed(0)
    surface = fit_surface(
        solved.views, region, stereo, config, device=CPU, generator=chance, progress=no_progress
    )
    return extract_mesh(solved.views, region, stereo, surface, MeshConfig(), progress=no_progress)


def check_sensible(mesh: SurfaceMesh, most_percent: float) -> None:
    """Finite, closed, and near the body where it says so: median error in percent of the diagonal."""
    for values in (mesh.vertices, mesh.normals, mesh.support):
        assert np.isfinite(values).all()
    assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).is_watertight
    sure = mesh.support > 0.5
    assert sure.mean() > 0.05
    assert 100 * np.median(np.abs(surface_distance(mesh.vertices[sure]))) / diagonal() < most_percent


@cache
def masked() -> Scene:
    return photographed(ring_cameras(6, 80))


@cache
def unmasked() -> Scene:
    return photographed(ring_cameras(6, 80), wall=True).without_masks()


def with_images(scene: Scene, change: Callable[[int, Image], Image]) -> Scene:
    views = [
        replace(view, image_srgb=change(index, view.image_srgb).astype(np.float32))
        for index, view in enumerate(scene.views)
    ]
    return replace(scene, views=tuple(views))


def with_masks(change: Callable[[int, Image], Image]) -> Scene:
    masks = [view.mask for view in masked().views]
    views = [
        replace(view, mask=change(index, mask))
        for index, (view, mask) in enumerate(zip(masked().views, masks, strict=True))
        if mask is not None
    ]
    return replace(masked(), views=tuple(views))


# photographs


def constant(_index: int, image: Image) -> Image:
    return np.full_like(image, 0.5)


def white(_index: int, image: Image) -> Image:
    return np.ones_like(image)


def overexposed(_index: int, image: Image) -> Image:
    """Half of the body is white in some channel."""
    return np.clip(3 * image, 0, 1)


def one_black(index: int, image: Image) -> Image:
    return image * (index != 2)


def with_something_moving(index: int, image: Image) -> Image:
    """The same patch of noise, a quarter as high as the picture, somewhere else in each."""
    changed, side = image.copy(), len(image) // 4
    row, column = np.random.default_rng(index).integers(0, np.array(image.shape[:2]) - side)
    changed[row : row + side, column : column + side] = np.random.default_rng(99).random((side, side, 3))
    return changed


def not_a_number(index: int, image: Image) -> Image:
    changed = image.copy()
    if index == 1:
        changed[:, len(image) // 2] = np.nan
    return changed


@dataclass(frozen=True, kw_only=True)
class Spoiled:
    """Photographs, and what becomes of them: an error, or a mesh as good as that."""

    scene: Callable[[], Scene]
    change: Callable[[int, Image], Image]
    becomes: ErrorCode | float


PHOTOGRAPHS = {
    "good ones": Spoiled(scene=masked, change=lambda _, image: image, becomes=0.3),
    "good ones without masks": Spoiled(scene=unmasked, change=lambda _, image: image, becomes=0.3),
    "constant without masks": Spoiled(scene=unmasked, change=constant, becomes=ErrorCode.NO_SURFACE),
    "overexposed": Spoiled(scene=masked, change=overexposed, becomes=0.3),
    "overexposed without masks": Spoiled(scene=unmasked, change=overexposed, becomes=0.3),
    "one black": Spoiled(scene=masked, change=one_black, becomes=0.3),
    "one black without masks": Spoiled(scene=unmasked, change=one_black, becomes=0.3),
    "something moving": Spoiled(scene=masked, change=with_something_moving, becomes=0.3),
    "something moving, no masks": Spoiled(scene=unmasked, change=with_something_moving, becomes=0.3),
    "not a number": Spoiled(scene=masked, change=not_a_number, becomes=ErrorCode.NO_SURFACE),
}


@pytest.mark.parametrize("case", PHOTOGRAPHS.values(), ids=PHOTOGRAPHS.keys())
def test_spoiled_photographs(case: Spoiled) -> None:
    solved = with_images(case.scene(), case.change).solved(sparse_points())
    if isinstance(case.becomes, float):
        check_sensible(reconstructed(solved), case.becomes)
        return
    with pytest.raises(ReconstructionError) as raised:
        reconstructed(solved)
    assert raised.value.code == case.becomes


@pytest.mark.parametrize("change", [constant, white])
def test_of_photographs_without_texture_the_outlines_are_left(change: Callable[[int, Image], Image]) -> None:
    """Nothing of it counts as measured, and it is the body's hull: its only hollow is a shallow one."""
    mesh = reconstructed(with_images(masked(), change).solved(sparse_points()))
    assert np.isfinite(mesh.vertices).all()
    assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).is_watertight
    assert mesh.support.max() <= 0.3, "seen, not measured"
    off_percent = 100 * np.abs(surface_distance(mesh.vertices)) / diagonal()
    assert np.median(off_percent) < 0.4
    assert np.quantile(off_percent, 0.95) < 2.0


# subjects


def stripes_srgb(points: np.ndarray) -> np.ndarray:
    """The same every fifth of the body."""
    return np.asarray(0.5 + 0.4 * np.sin(2 * np.pi * (points - CENTRE) / SIZE / 0.2))


def mirrored_srgb(points: np.ndarray) -> np.ndarray:
    """The body's shape is nearly the same on both sides of x = 0; this makes its colours so."""
    apart = points - CENTRE
    return np.asarray(texture_srgb(CENTRE + np.abs(apart) * [1, 0, 0] + apart * [0, 1, 1]))


@pytest.mark.parametrize("texture", [stripes_srgb, mirrored_srgb])
@pytest.mark.parametrize("wall", [False, True])
def test_textures_that_repeat(
    texture: Callable[[np.ndarray], np.ndarray], wall: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The wall repeats as the body does."""
    monkeypatch.setattr(synthetic_scene, "texture_srgb", texture)
    scene = photographed(ring_cameras(6, 80), wall=wall)
    scene = scene.without_masks() if wall else scene
    check_sensible(reconstructed(scene.solved(sparse_points())), 0.3)


def placed_or_refused(photos: list[Photo], workdir: Path) -> SolvedCameras | ReconstructionError:
    try:
        return solve_cameras(photos, None, CamerasConfig(), workdir=workdir, seed=0, progress=no_progress)
    except ReconstructionError as error:
        return error


@pytest.mark.parametrize("texture", [stripes_srgb, mirrored_srgb])
def test_cameras_of_textures_that_repeat(
    texture: Callable[[np.ndarray], np.ndarray], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Photographs without cameras: those that are placed are placed right, or an error says what to do."""
    monkeypatch.setattr(synthetic_scene, "texture_srgb", texture)
    cameras = arc_cameras(4, 40, 320)
    photos = [
        Photo(
            name=view.name,
            path=tmp_path / view.name,
            image_srgb=view.image_srgb,
            mask=view.mask,
            original_width=view.camera.width,
            original_height=view.camera.height,
            focal_px=view.camera.fx_px,
        )
        for view in photographed(cameras).views
    ]
    solved = placed_or_refused(photos, tmp_path)
    if isinstance(solved, ReconstructionError):
        assert solved.code in (ErrorCode.NO_OVERLAP, ErrorCode.TOO_FEW_PLACED, ErrorCode.NO_PARALLAX)
        assert "photo" in solved.remedy.lower(), "what to take instead"
        return
    true = {photo.name: camera for photo, camera in zip(photos, cameras, strict=True)}
    first = solved.views[0]
    for view in solved.views[1:]:
        turned = view.camera.camera_from_world @ np.linalg.inv(first.camera.camera_from_world)
        truly = true[view.name].camera_from_world @ np.linalg.inv(true[first.name].camera_from_world)
        cosine = (np.trace(turned[:3, :3] @ truly[:3, :3].T) - 1) / 2
        assert np.degrees(np.arccos(min(cosine, 1.0))) < 1.0


# masks


def of_the_next_photograph(index: int, _mask: Image) -> Image:
    mask = masked().views[(index + 1) % len(masked().views)].mask
    assert mask is not None
    return mask


MASKS: dict[str, tuple[Callable[[int, Image], Image], tuple[ErrorCode, ...] | float]] = {
    "inverted": (lambda _, mask: 1 - mask, (ErrorCode.MASK_UNUSABLE, ErrorCode.NO_SURFACE)),
    "one inverted": (lambda i, mask: 1 - mask if i == 2 else mask, (ErrorCode.MASK_UNUSABLE,)),
    "empty": (lambda _, mask: 0 * mask, (ErrorCode.MASK_UNUSABLE,)),
    "one empty": (lambda i, mask: (i != 2) * mask, (ErrorCode.MASK_UNUSABLE,)),
    "of another photograph": (of_the_next_photograph, 1.5),
}


@pytest.mark.parametrize("case", MASKS)
def test_wrong_masks(case: str) -> None:
    change, becomes = MASKS[case]
    solved = with_masks(change).solved(sparse_points())
    if isinstance(becomes, float):
        check_sensible(reconstructed(solved), becomes)
        return
    with pytest.raises(ReconstructionError, match="mask") as raised:
        reconstructed(solved)
    assert raised.value.code in becomes


# points


def with_outliers(points: SurfacePoints) -> SurfacePoints:
    """As many again, anywhere in the region, facing anywhere, as sure of themselves as the others."""
    random = np.random.default_rng(0)
    shape = points.positions.shape
    facing = random.normal(size=shape)
    doubled = again(points, 2)
    positions, normals = doubled.positions.copy(), doubled.normals.copy()
    positions[len(points.positions) :] = random.uniform(-0.9, 0.9, shape)
    normals[len(points.normals) :] = facing / np.linalg.norm(facing, axis=1, keepdims=True)
    return replace(doubled, positions=positions, normals=normals)


def flipped(points: SurfacePoints) -> SurfacePoints:
    """Every second normal, at random, points inwards."""
    side = np.random.default_rng(0).choice([-1, 1], (len(points.normals), 1)).astype(np.float32)
    return replace(points, normals=points.normals * side)


def again(points: SurfacePoints, times: int = 10) -> SurfacePoints:
    """Each of them as often as that."""
    names = ("positions", "normals", "colours_srgb", "confidence", "num_views", "view_index")
    return replace(points, **{name: np.concatenate([getattr(points, name)] * times) for name in names})


@pytest.mark.parametrize(
    ("scene", "change", "most_percent"),
    [
        (masked, with_outliers, 0.3),
        (masked, flipped, 1.0),
        (masked, again, 0.3),
        (unmasked, with_outliers, 0.3),
        # half of the planes say the opposite: only what photographs see through tells the sides
        (unmasked, flipped, 1.5),
    ],
)
def test_wrong_points(scene: Callable[[], Scene], change: Points, most_percent: float) -> None:
    check_sensible(reconstructed(scene().solved(sparse_points()), change), most_percent)


@cache
def measured_points() -> SurfacePoints:
    """Of the unmasked body, object frame."""
    solved = unmasked().solved(sparse_points())
    region = find_region(solved, RegionConfig(), progress=no_progress)
    return match_views(solved.views, region, StereoConfig(), device=CPU, progress=no_progress).points


def test_strays_are_left_out_and_told_and_others_stay() -> None:
    points = measured_points()
    assert without_strays(points) is points
    assert strays(points.positions.astype(np.float64)).mean() < 0.05
    spoiled, count = with_outliers(points), len(points.positions)
    stray = strays(spoiled.positions.astype(np.float64))
    assert stray[:count].mean() < 0.05
    assert stray[count:].mean() > 0.95
    left = without_strays(spoiled)
    assert len(left.positions) == 2 * count - stray.sum()
    (told,) = left.decisions
    assert told.what == "stray points"
    assert told.choice == f"{stray.sum()} of {2 * count} left out"
    low, high = (np.ptp(values.positions, axis=0).min() for values in (points, spoiled))
    assert high > 1.3 * low, "a box around all points is that of the strays"


def test_flipped_normals_by_the_nearest_point_say_the_wrong_side_half_of_the_time() -> None:
    """A tenth of the region's radius outside of points: a sign that one normal gives is chance."""
    points = flipped(measured_points())
    outside = measured_points().positions + 0.1 * measured_points().normals
    _, nearest = nearest_tree(points.positions.astype(np.float64)).query(outside.astype(np.float64))
    side = ((outside - points.positions[nearest]) * points.normals[nearest]).sum(axis=1)
    assert 0.4 < (side < 0).mean() < 0.6


def test_repeated_points_have_no_spacing_and_no_plane_but_merged_ones_do() -> None:
    """The usual measure of a cloud is the median distance to the nearest other point: 0."""
    points = again(measured_points())
    positions = points.positions.astype(np.float64)
    apart, _ = nearest_tree(positions).query(positions, k=2)
    assert np.median(apart[:, 1]) == 0
    merged, normals, weight = merged_points(
        *(torch.tensor(x) for x in (points.positions, points.normals, points.confidence)), 0.02
    )
    assert len(merged) <= len(measured_points().positions)
    for values in (merged, normals, weight):
        assert values.isfinite().all()


def test_a_constant_picture_has_no_correlation_and_is_no_number_without_noise() -> None:
    flat = torch.full((20, 20), 0.5)
    statistics = patch_statistics(flat, torch.ones_like(flat), 2)
    usual = correlation(statistics, flat[None], 0.0)
    assert not usual.isfinite().all()
    assert correlation(statistics, flat[None], 0.01).abs().max() < 1e-2


def test_half_of_the_triangulated_points_wrong_leaves_the_region_where_it_is() -> None:
    """They lie anywhere in five times the body."""
    clean, noisy = (
        find_region(unmasked().solved(sparse_points(count)), RegionConfig(), progress=no_progress)
        for count in (0, 200)
    )
    sparse = sparse_points(200)
    usual = np.linalg.norm(sparse - sparse.mean(axis=0), axis=1).max()
    assert usual > 3 * clean.radius_world, "a sphere around all of them"
    assert np.linalg.norm(noisy.centre_world - clean.centre_world) < 0.3 * clean.radius_world
    assert 0.9 < noisy.radius_world / clean.radius_world < 2.0


def test_a_file_with_a_point_that_is_no_number_is_read_without_it(tmp_path: Path) -> None:
    """Its smallest and largest coordinates, as a frame is usually made from, are no numbers."""
    cloud = np.random.default_rng(0).normal(size=(100, 3))
    cloud[7, 1], cloud[8] = np.nan, np.inf
    assert np.isnan(cloud.min(axis=0)).any()
    file = tmp_path / "cloud.xyz"
    np.savetxt(file, cloud)
    found = read_cloud(file)
    assert np.isfinite(found.positions).all()
    assert len(found.positions) == 98
    assert [decision.choice for decision in found.decisions] == ["2 of 100 left out"]
    np.savetxt(file, np.full((100, 3), np.nan))
    with pytest.raises(ReconstructionError, match="0 different points with finite coordinates") as raised:
        read_cloud(file)
    assert raised.value.code == ErrorCode.CLOUD_UNUSABLE
    assert raised.value.remedy


@pytest.mark.parametrize("name", ["positions", "normals", "colours_srgb", "confidence"])
def test_points_that_are_no_numbers_are_refused(name: str) -> None:
    def spoil(points: SurfacePoints) -> SurfacePoints:
        values = getattr(points, name).copy()
        values[7] = np.nan
        return replace(points, **{name: values})

    with pytest.raises(ValueError, match=f"{name} of surface points hold numbers that are not finite"):
        reconstructed(masked().solved(sparse_points()), spoil)
