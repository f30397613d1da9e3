"""Very long and very short lenses, and scenes of any size anywhere: the result is the same up to scale."""

import json
import math
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image  # noqa: F401 - before pycolmap
import pycolmap
import pytest
import torch
import torch.nn.functional as F
import trimesh
from scipy.spatial.transform import Rotation

from backend.errors import ErrorCode, ReconstructionError
from backend.maths.geometry import (
    Pinhole,
    epipolar_map,
    pinhole_in_object,
    pixel_centres,
    project,
    warp_pixels,
)
from backend.maths.rays import first_crossing
from backend.mesh_files import write_glb
from backend.scene import (
    Camera,
    Photo,
    Region,
    SolvedCameras,
    StereoResult,
    SurfaceMesh,
    View,
    no_progress,
    transform_points,
)
from backend.stages.cameras import focal_search, mapping, model_choice
from backend.stages.cameras.known_cameras import read_cameras
from backend.stages.cameras.nerfstudio import OPENCV_FROM_OPENGL
from backend.stages.cameras.solving import CamerasConfig, solve_cameras
from backend.stages.mesh.extraction import MeshConfig, extract_mesh
from backend.stages.region import RegionConfig, find_region
from backend.stages.stereo.config import StereoConfig
from backend.stages.stereo.multi_view_stereo import match_views
from backend.stages.surface import Surface
from backend.stages.train.surface_fit import TrainConfig, fit_surface
from tests.ridge_photos import FOCAL_PX, WIDTH, arc_pose, make_photo, render
from tests.stability.surfaces import from_surface
from tests.synthetic_scene import (
    CENTRE,
    SIZE,
    Scene,
    arc_cameras,
    diagonal,
    photographed,
    surface_distance,
    surface_points,
    true_region,
)

CPU = torch.device("cpu")
QUICK_STEREO = StereoConfig(first_pixel_size=1, num_sources=2, growth_rounds=(1, 1, 1))


def pixels_of(camera: Camera, points: np.ndarray) -> np.ndarray:
    homogeneous = transform_points(camera.camera_from_world, points) @ camera.intrinsics.T
    return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:])


# Very long and very short lenses.


def through_lens(distance: float) -> Scene:
    """The body, filling the pictures, from so many of its sizes; a lens as long as it takes."""
    cameras = []
    for camera in arc_cameras(3, 30, 160):
        zoom = math.sqrt((distance**2 - 1) / 15)  # what touches a ball of SIZE at the usual distance of 4
        pose = camera.camera_from_world.copy()
        pose[:3, 3] = -pose[:3, :3] @ (CENTRE + (camera.position - CENTRE) * distance / 4)
        cameras.append(
            replace(camera, camera_from_world=pose, fx_px=camera.fx_px * zoom, fy_px=camera.fy_px * zoom)
        )
    return photographed(cameras)


@pytest.mark.parametrize(
    ("distance", "focal_widths", "num_points"), [(1.35, 0.34, 10_000), (400.0, 150.0, 20_000)]
)
def test_depth_through_very_short_and_very_long_lenses(
    distance: float, focal_widths: float, num_points: int
) -> None:
    """112 degrees, and 0.4; as exact as a normal lens, whose median error is 0.06 % of the diagonal."""
    scene = through_lens(distance)
    assert scene.cameras[0].fx_px / 160 == pytest.approx(focal_widths, rel=0.01)
    result = match_views(scene.views, true_region(), QUICK_STEREO, device=CPU, progress=no_progress)
    points = transform_points(true_region().world_from_object, result.points.positions.astype(np.float64))
    assert len(points) > num_points
    assert np.median(np.abs(surface_distance(points))) < 0.0008 * diagonal()


def ridge_from(
    focal_widths: float, *, told: bool = True, angles_deg: tuple[float, ...] = (-18.0, 0.0, 15.0)
) -> tuple[list[Photo], list[np.ndarray]]:
    """Photographs of the ridge, as large in each: a long lens from far away; and their cameras."""
    focal_px = focal_widths * WIDTH
    poses = []
    for angle_deg in angles_deg:
        pose = arc_pose(angle_deg)
        pose[:3, 3] *= focal_px / FOCAL_PX
        poses.append(pose)
    images = (render(pose, focal_px=focal_px) for pose in poses)
    in_exif = focal_px if told else None
    return [make_photo(f"{i}.png", image, in_exif) for i, image in enumerate(images)], poses


def worst_turn_deg(solved: SolvedCameras, poses: list[np.ndarray]) -> float:
    """Between the first photograph and each other one."""
    first = solved.views[0].camera.camera_from_world
    turns = []
    for view, pose in zip(solved.views[1:], poses[1:], strict=True):
        ours = view.camera.camera_from_world @ np.linalg.inv(first)
        true = pose @ np.linalg.inv(poses[0])
        turns.append(Rotation.from_matrix(ours[:3, :3].T @ true[:3, :3]).magnitude())
    return math.degrees(max(turns))


@pytest.mark.slow
@pytest.mark.parametrize(("focal_widths", "most_deg"), [(0.34, 2.0), (7.0, 0.1), (10.5, 0.1), (105.0, 0.1)])
def test_cameras_of_very_short_and_very_long_lenses_that_are_known(
    focal_widths: float, most_deg: float, tmp_path: Path
) -> None:
    photos, poses = ridge_from(focal_widths)
    solved = solve_cameras(photos, None, CamerasConfig(), workdir=tmp_path, seed=0, progress=no_progress)
    assert [view.name for view in solved.views] == ["0.png", "1.png", "2.png"]
    assert solved.views[0].camera.fx_px == pytest.approx(focal_widths * WIDTH, rel=0.03)
    assert worst_turn_deg(solved, poses) < most_deg


@pytest.mark.slow
@pytest.mark.parametrize("focal_widths", [0.34, 1.05, 10.5, 105.0])
def test_cameras_of_very_short_and_very_long_lenses_that_nothing_tells(
    focal_widths: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Begun with a usual lens alone the mapper takes the extremes for one, and turns by 30 degrees."""
    photos, poses = ridge_from(focal_widths, told=False)
    solve = partial(solve_cameras, photos, None, CamerasConfig(), seed=0, progress=no_progress)
    assert worst_turn_deg(solve(workdir=tmp_path / "ours"), poses) < 1.0
    monkeypatch.setattr(focal_search, "_OTHER_FOCAL_FACTORS", ())
    usual_deg = worst_turn_deg(solve(workdir=tmp_path / "usual"), poses)
    assert (usual_deg > 20) == (focal_widths in (0.34, 105.0))


@pytest.mark.slow
@pytest.mark.parametrize("focal_widths", [0.34, 1.05])
def test_of_many_photographs_a_few_tell_the_lens(
    focal_widths: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    photos, poses = ridge_from(focal_widths, told=False, angles_deg=(-18.0, -11.0, -4.0, 3.0, 9.0, 15.0))
    mapped, tried = model_choice.mapped_models, []

    def counting(*given: Any) -> list[pycolmap.Reconstruction]:
        tried.append(len(given[5]) if len(given) > 5 else 0)
        return mapped(*given)

    monkeypatch.setattr(model_choice, "mapped_models", counting)
    solve = partial(solve_cameras, photos, None, CamerasConfig(), seed=0, progress=no_progress)
    assert worst_turn_deg(solve(workdir=tmp_path / "ours"), poses) < 1.0
    assert tried == [0, *4 * [focal_search.FEW_PHOTOS]], "the usual lens and three others"


@pytest.mark.slow
def test_by_the_usual_bound_a_long_lens_has_no_cameras(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """COLMAP takes a focal length of more than ten widths for a mistake."""
    monkeypatch.setattr(mapping, "_LONGEST_FOCAL_WIDTHS", 10.0)
    photos, _ = ridge_from(10.5)
    with pytest.raises(ReconstructionError) as caught:
        solve_cameras(photos, None, CamerasConfig(), workdir=tmp_path, seed=0, progress=no_progress)
    assert caught.value.code is ErrorCode.TOO_FEW_PLACED


def test_a_search_to_twice_the_depth_has_no_steps_left_for_a_long_lens() -> None:
    """The usual range, from the nearest depth to a multiple of it, in steps of one pixel of disparity."""
    num_steps = QUICK_STEREO.num_planes
    for distance in (4.0, 400.0):
        cameras = [pinhole_in_object(c, true_region(), CPU) for c in through_lens(distance).cameras[:2]]
        _, b = epipolar_map(cameras[1], cameras[0])
        middle = float(cameras[0].camera_from_object[2, 3])
        pixels_per_inverse_depth = float(b[:2].norm())
        usual = pixels_per_inverse_depth * (1 / (middle - 1) - 1 / (2 * (middle - 1)))
        ours = pixels_per_inverse_depth * (1 / (middle - 1) - 1 / (middle + 2))
        assert ours < 2 * num_steps, "semi-global matching finds what lies between two"
        assert (usual > 10 * num_steps) == (distance == 400.0)


# Scenes of any size, anywhere.


def moved(scene: Scene, scale: float, shift: np.ndarray) -> SolvedCameras:
    """The same photographs in another world."""
    views = []
    for view in scene.views:
        pose = view.camera.camera_from_world.copy()
        pose[:3, 3] = -pose[:3, :3] @ (scale * view.camera.position + shift)
        views.append(replace(view, camera=replace(view.camera, camera_from_world=pose)))
    return replace(scene.solved(), views=tuple(views))


@cache
def small_scene(masks: bool = True) -> Scene:
    scene = photographed(arc_cameras(3, 40, 80), wall=not masks)
    return scene if masks else scene.without_masks()


def sparse_points() -> np.ndarray:
    """Of the body, as triangulated ones; without masks they say where it is."""
    directions = np.random.default_rng(0).normal(size=(200, 3))
    return surface_points(directions / np.linalg.norm(directions, axis=1, keepdims=True))


@dataclass(frozen=True, kw_only=True)
class World:
    """The small scene somewhere, at some size, and what becomes of it there."""

    scale: float
    offset: np.ndarray
    views: tuple[View, ...]
    region: Region
    stereo: StereoResult
    surface: Surface

    def mesh(self, max_faces: int = 1_000_000) -> SurfaceMesh:
        """All of it, or simplified."""
        config = MeshConfig(max_faces=max_faces)
        return extract_mesh(self.views, self.region, self.stereo, self.surface, config, progress=no_progress)

    def here(self, points: np.ndarray) -> np.ndarray:
        """Points of this world in that of the small scene."""
        return np.asarray((points - self.offset) / self.scale)


@cache
def fitted(scale: float = 1.0, shift: float = 0.0, masks: bool = True) -> World:
    """Without masks the region is that of triangulated points."""
    offset, sparse = np.array([shift, -shift, shift]), sparse_points()
    solved = moved(small_scene(masks), scale, offset)
    if not masks:
        seen = np.ones((len(sparse), len(solved.views)), bool)
        solved = replace(solved, sparse_positions=scale * sparse + offset, sparse_visibility=seen)
    region = find_region(solved, RegionConfig(), progress=no_progress)
    stereo = match_views(solved.views, region, QUICK_STEREO, device=CPU, progress=no_progress)
    config = TrainConfig(levels=(32,), rounds=(4,), steps=(0,))
    surface = fit_surface(
        solved.views,
        region,
        stereo,
        config,
        device=CPU,
        generator=torch.Generator().manual_seed(0),
        progress=no_progress,
    )
    return World(
        scale=scale, offset=offset, views=solved.views, region=region, stereo=stereo, surface=surface
    )


MASKS = pytest.mark.parametrize("masks", [True, False], ids=["masks", "no masks"])
WORLDS = pytest.mark.parametrize(("scale", "shift"), [(1e-4, 0.0), (1e5, 0.0), (1.0, 1e6)], ids=str)


@pytest.mark.slow
@MASKS
@WORLDS
def test_the_result_is_the_same_in_any_world(scale: float, shift: float, masks: bool) -> None:
    """Region, depths, field and mesh up to the similarity, to 1e-4 of the subject's size; simplified as well.

    A point that the last digit moves into the next cube of merged ones moves the nodes around it by up to
    1e-4 of the cube; so points come to the field's frame by numbers in which the world's origin has no part.
    """
    there, here = fitted(scale, shift, masks), fitted(masks=masks)
    (found,) = here.region.decisions
    assert found.choice == ("the masked subject" if masks else "where the photographs overlap")
    assert there.region.radius_world == pytest.approx(scale * here.region.radius_world, rel=1e-9)
    apart = there.here(there.region.centre_world) - here.region.centre_world
    assert np.abs(apart).max() < 1e-9 * here.region.radius_world
    positions = here.stereo.points.positions
    assert len(there.stereo.points.positions) == len(positions)
    np.testing.assert_allclose(there.stereo.points.positions, positions, atol=1e-4)
    for one, other in zip(there.stereo.depth_maps, here.stereo.depth_maps, strict=True):
        np.testing.assert_allclose(one.depth, other.depth, rtol=1e-4)
    field_apart = np.abs(there.surface.distance - here.surface.distance)
    assert field_apart.max() < 1e-4 * 2, "the cube is 2 wide"
    assert field_apart.mean() < 1e-6
    mesh, known = there.mesh(), here.mesh()
    np.testing.assert_array_equal(mesh.faces, known.faces)
    size = np.ptp(known.vertices, axis=0).max()
    assert np.abs(there.here(mesh.vertices) - known.vertices).max() < 1e-4 * size
    np.testing.assert_allclose(mesh.support, known.support, atol=1e-3)
    # which edges are joined may hang on the last digit; the surface may not
    mesh, known = there.mesh(2000), here.mesh(2000)
    assert len(known.faces) <= 2000
    vertices = there.here(mesh.vertices)
    one_way = from_surface(vertices, known.vertices, known.faces)
    other_way = from_surface(known.vertices, vertices, mesh.faces)
    assert max(one_way.max(), other_way.max()) < 1e-4 * size


@pytest.mark.parametrize("digits", [4, 6, 16])
def test_cameras_from_a_file_stand_where_it_says_far_from_the_origin_too(digits: int, tmp_path: Path) -> None:
    """A rotation of few digits, inverted before it is made exact, moves the camera by 1e6 times its error."""
    scene, offset = small_scene(), np.array([1e6, -1e6, 1e6])
    frames, moved_by = [], []
    for name, camera in zip("abc", (view.camera for view in scene.views), strict=False):
        pose = np.linalg.inv(camera.camera_from_world)
        pose[:3, :3] = pose[:3, :3].round(digits)
        pose[:3, 3] += offset
        left, _, right = np.linalg.svd(np.linalg.inv(pose)[:3, :3])
        usual = np.linalg.inv(pose)[:3, 3]
        moved_by.append(np.linalg.norm(-(left @ right).T @ usual - pose[:3, 3]))
        matrix = (pose @ OPENCV_FROM_OPENGL).tolist()
        size = {"w": camera.width, "h": camera.height, "fl_x": camera.fx_px, "fl_y": camera.fy_px}
        frames.append({"file_path": f"{name}.png", "transform_matrix": matrix, **size})
    assert (max(moved_by) > 0.1) == (digits < 16)
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"frames": frames}))
    for (_, camera), frame in zip(read_cameras(path), frames, strict=True):
        np.testing.assert_allclose(
            camera.position, np.array(frame["transform_matrix"])[:3, 3], atol=1e-8, rtol=0
        )


@pytest.mark.slow
@MASKS
@pytest.mark.parametrize(
    ("scale", "shift"),
    [(1e-4, 0.0), (1e5, 0.0), (1.0, 1e6)],
    ids=str,
)
def test_colours_are_the_same_in_any_world(scale: float, shift: float, masks: bool) -> None:
    """Of each vertex, also of those that no photograph sees, to one step of 255."""
    there, here = (
        world.mesh().colours_srgb.astype(int) for world in (fitted(scale, shift, masks), fitted(masks=masks))
    )
    assert np.abs(there - here).max() <= 1


def test_distances_from_a_surface_are_those_from_its_triangles() -> None:
    ball = trimesh.creation.icosphere(3)
    points = np.asarray(ball.triangles_center) * 1.25
    expected = np.linalg.norm(points, axis=1) * 0.2
    np.testing.assert_allclose(from_surface(points, ball.vertices, ball.faces), expected, rtol=1e-3)


@WORLDS
def test_a_mesh_file_in_single_precision_keeps_its_digits(scale: float, shift: float, tmp_path: Path) -> None:
    """glTF knows no doubles but in the transform of a node."""
    offset = np.array([shift, -shift, shift])
    mesh = fitted().mesh(MeshConfig().max_faces)
    mesh = replace(mesh, vertices=scale * mesh.vertices + offset, texture=None)
    size = np.ptp(mesh.vertices, axis=0).max()
    usual = np.abs(mesh.vertices.astype(np.float32) - mesh.vertices).max()
    assert (usual > 1e-4 * size) == (shift != 0)
    write_glb(tmp_path / "mesh.glb", mesh)
    found = np.asarray(trimesh.load_scene(tmp_path / "mesh.glb").to_mesh().vertices)
    found = np.stack([found[:, 0], -found[:, 2], found[:, 1]], axis=1)
    assert np.abs(found - mesh.vertices).max() < 1e-6 * size


def test_projection_in_single_precision_where_maps_are_drawn() -> None:
    """K [R | t] in single precision is off by pixels at 1e6; through the object's frame it is not."""
    camera = moved(small_scene(), 1.0, np.array([1e6, -1e6, 1e6])).views[0].camera
    points = true_region().world_from_object[:3, 3] + SIZE * np.random.default_rng(0).uniform(
        -0.5, 0.5, (200, 3)
    )
    here = small_scene().views[0].camera
    exact = pixels_of(here, points)
    far = points + np.array([1e6, -1e6, 1e6])
    matrix = (camera.intrinsics @ camera.camera_from_world[:3]).astype(np.float32)
    homogeneous = far.astype(np.float32) @ matrix[:, :3].T + matrix[:, 3]
    usual = homogeneous[:, :2] / homogeneous[:, 2:]
    assert np.abs(usual - exact).max() > 1
    object_from_world = np.eye(4)
    object_from_world[:3, :3] /= SIZE
    object_from_world[:3, 3] = -(CENTRE + np.array([1e6, -1e6, 1e6])) / SIZE
    region = Region(object_from_world=object_from_world)
    in_object = torch.tensor(transform_points(object_from_world, far), dtype=torch.float32)
    ours, _ = project(pinhole_in_object(camera, region, CPU), in_object)
    assert np.abs(ours.numpy() - exact).max() < 1e-3


def test_warps_in_single_precision() -> None:
    """Against double precision, in pixels of a picture 160 wide; the longer the lens, the more cancels."""
    for distance, tolerance_px in ((1.35, 1e-4), (4.0, 1e-4), (40.0, 5e-4), (400.0, 2e-3)):
        scene = through_lens(distance)
        cameras = [pinhole_in_object(c, true_region(), CPU) for c in scene.cameras[:2]]
        exact = [in_double(c) for c in scene.cameras[:2]]
        inverse_depth = torch.tensor(true_region().radius_world / scene.depths[0])[None]
        pixels = pixel_centres(160, 120, CPU)
        single = warp_pixels(*epipolar_map(cameras[1], cameras[0]), pixels, inverse_depth.float())
        double = warp_pixels(*epipolar_map(exact[1], exact[0]), pixels.double(), inverse_depth)
        on_body = torch.tensor(np.isfinite(scene.depths[0]))
        assert float((single - double)[0][on_body].abs().max()) < tolerance_px


def test_warps_in_single_precision_far_from_the_origin() -> None:
    """A pixel to the world and into the other picture, at 1e6; ours never leaves the object's frame."""
    solved = moved(small_scene(), 1.0, np.array([1e6, -1e6, 1e6]))
    one, other = (view.camera for view in solved.views[:2])
    scene, on_body = small_scene(), np.isfinite(small_scene().depths[0])
    pixels = pixel_centres(one.width, one.height, CPU)
    here = [in_double(view.camera) for view in scene.views[:2]]
    inverse_depth = torch.tensor(true_region().radius_world / scene.depths[0])[None]
    exact = warp_pixels(*epipolar_map(here[1], here[0]), pixels.double(), inverse_depth)[0][on_body]

    depth = scene.depths[0][on_body].astype(np.float32)[:, None]
    rays = np.column_stack([pixels.numpy()[on_body], np.ones(len(depth), np.float32)])
    world_from_camera = np.linalg.inv(one.camera_from_world).astype(np.float32)
    in_camera = rays @ np.linalg.inv(one.intrinsics).astype(np.float32).T * depth
    in_world = in_camera @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]
    matrix = (other.intrinsics @ other.camera_from_world[:3]).astype(np.float32)
    homogeneous = in_world @ matrix[:, :3].T + matrix[:, 3]
    usual = torch.tensor(homogeneous[:, :2] / homogeneous[:, 2:])
    assert float((usual - exact).abs().max()) > 1

    object_from_world = true_region().object_from_world.copy()
    object_from_world[:3, 3] -= object_from_world[:3, :3] @ np.array([1e6, -1e6, 1e6])
    region = Region(object_from_world=object_from_world)
    ours = warp_pixels(
        *epipolar_map(pinhole_in_object(other, region, CPU), pinhole_in_object(one, region, CPU)),
        pixels,
        inverse_depth.float(),
    )[0][on_body]
    assert float((ours - exact).abs().max()) < 1e-3


@pytest.mark.parametrize("scale", [1e-4, 1e5])
def test_steps_in_units_of_the_world_miss_a_scene_of_another_size(scale: float) -> None:
    """The same search for the surface of a ball of radius 0.5: its steps are 0.005 to 0.1 long.

    In the world's frame they leap over a ball that is small, and end long before one that is large.
    """
    directions = F.normalize(torch.tensor([[0.0, 0.1, 1.0], [0.1, 0.0, 1.0], [0.0, 0.0, 1.0]]), dim=-1)
    origins = torch.tensor([[0.0, 0.0, -1.0]]).expand(3, 3)
    middle = -(origins * directions).sum(dim=-1)
    exact = middle - (0.25 - 1 + middle.square()).sqrt()

    def found(size: float) -> torch.Tensor:
        start = torch.zeros(3)
        crossing = first_crossing(
            lambda x: x.norm(dim=-1) - 0.5 * size, size * origins, directions, start, reach=2.0 * size
        )
        return torch.where(crossing.hit, crossing.along / size, torch.nan)

    torch.testing.assert_close(found(1.0), exact, rtol=0, atol=1e-4)
    usual = found(scale)
    assert not ((usual - exact).abs() < 1e-2).any(), "missed, or a hundredth of the size off"


def in_double(camera: Camera) -> Pinhole:
    region = true_region()
    pose = camera.camera_from_world @ region.world_from_object
    pose[:3] /= region.radius_world
    return Pinhole(
        intrinsics=torch.tensor(camera.intrinsics),
        camera_from_object=torch.tensor(pose),
        width=camera.width,
        height=camera.height,
    )
