"""Solved cameras as objects of a scene.

What is made carries custom properties, by which it is found again: `fewview_job` (the job's folder) and
`fewview_role`; a camera also `fewview_photo` and `fewview_size`, the photograph's name, width and height.
Importing a job again puts its cameras back where they were found, keeps the placement that the user may have
moved, and touches nothing else.

A root places an estimated scene: its `matrix_world` is `world_from_solved`, and all else is its child.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..backend.maths.upright import up_direction
from ..backend.wire.photographs import is_named, is_of_phone
from .camera_lens import apply_lens
from .exif_orientation import clockwise_turn_deg
from .intrinsics import SAME_ASPECT, Pinhole, aspect_pair, shared_aspect_or_none
from .job_folder import CAMERAS, SPARSE, results_in
from .placing import upright_from_solved
from .ply import PlyMesh, read_ply
from .scenes import in_scene, scene_named
from .solved import SolvedCamera, SolvedScene, read_solved

JOB, ROLE, PHOTO, SIZE = "fewview_job", "fewview_role", "fewview_photo", "fewview_size"
UPRIGHT, BAKED = "fewview_upright", "fewview_baked"
"""Names of the custom properties."""
ROOT, CAMERA, POINTS = "root", "camera", "points"
"""Values of `fewview_role`."""
POINT_COLOURS = "Col"


@dataclass(frozen=True, kw_only=True)
class CameraImport:
    """What is to be shown of a job."""

    job: str
    """Its folder: what an earlier import of the same job made is found by it."""
    solved: SolvedScene
    photographs: tuple[Path, ...]
    """Files, or folders that hold them."""
    points: PlyMesh | None
    """Sparse points, in the frame that was solved."""


def read_import(folder: Path, photographs: tuple[Path, ...]) -> CameraImport:
    """What a job's folder has to show. Raises ValueError, a sentence, for files that cannot be used."""
    result = results_in(folder)
    sparse = result / SPARSE
    return CameraImport(
        job=str(folder.absolute()),
        solved=read_solved(result / CAMERAS),
        photographs=photographs,
        points=read_ply(sparse) if sparse.is_file() else None,
    )


def import_steps(scene_name: str, wanted: CameraImport, warnings: list[str]) -> Iterator[None]:
    """Make the objects, in steps for a timer, and set `scene.fewview.root`.

    What is changed of the scene's own settings is added to the warnings.
    Between two steps the user may undo, so each finds its objects anew. The caller pushes the undo step.
    Raises ValueError for a camera that Blender does not have.
    """
    for camera in wanted.solved.cameras:
        _make_camera(scene_named(scene_name), wanted, camera)
        yield
    _remove_old_cameras(scene_named(scene_name), wanted)
    warnings += set_pixel_aspect(scene_named(scene_name), wanted.solved)
    yield
    if wanted.points is not None and len(wanted.points.positions):
        _make_points(scene_named(scene_name), wanted, wanted.points)


def problems(wanted: CameraImport) -> tuple[str, ...]:
    """What the user should know of an import, in sentences; who is unplaced stands in `solved`."""
    solved = wanted.solved
    found = []
    pinholes = tuple(camera.pinhole for camera in solved.cameras)
    if shared_aspect_or_none(pinholes) is None:
        found.append(
            "The photographs' pixels differ in shape, and a scene has one: some cameras show them distorted"
        )
    files = {c.name: photograph_or_none(c.name, wanted.photographs) for c in solved.cameras}
    if missing := [name for name, file in files.items() if file is None]:
        found.append(f"Not found, so not shown behind their cameras: {', '.join(missing)}")
    if unread := [name for name, file in files.items() if file is not None and is_of_phone(file)]:
        found.append(
            f"HEIC, which Blender does not read, so not shown behind their cameras: {', '.join(unread)}"
        )
    return tuple(found)


def photograph_or_none(name: str, photographs: Sequence[Path]) -> Path | None:
    """The file of a photograph by the name that the backend gives it: the file's, or with its folder."""
    last = Path(name).name
    try:
        files = [path / last if path.is_dir() else path for path in photographs]
        alike = [path for path in files if path.name == last and path.is_file()]
    except OSError:  # a name that no file can have
        return None
    found = [path for path in alike if is_named(path.absolute(), name)] or alike
    return found[0] if len(found) == 1 else None


def set_pixel_aspect(scene: bpy.types.Scene, solved: SolvedScene) -> tuple[str, ...]:
    """Give the scene the pixel aspect that the cameras share, if they do and it has another: it is told."""
    aspect = shared_aspect_or_none(tuple(camera.pinhole for camera in solved.cameras))
    render = scene.render
    before = render.pixel_aspect_y / render.pixel_aspect_x
    if aspect is None or abs(aspect - before) <= SAME_ASPECT * before:
        return ()
    old = f"{render.pixel_aspect_x:g} : {render.pixel_aspect_y:g}"
    render.pixel_aspect_x, render.pixel_aspect_y = aspect_pair(aspect)
    new = f"{render.pixel_aspect_x:g} : {render.pixel_aspect_y:g}"
    return (
        f"The scene's pixel aspect was {old} and is now {new}, which the cameras need: change it back for "
        "your own renders",
    )


def objects_of(scene: bpy.types.Scene, job: str, role: str) -> list[bpy.types.Object]:
    """What an import of the job has made in the scene."""
    return [made for made in scene.objects if made.get(JOB) == job and made.get(ROLE) == role]


def root_or_none(scene: bpy.types.Scene, job: str) -> bpy.types.Object | None:
    """The empty that places the job's cameras; None where they stand in the world themselves."""
    return next(iter(objects_of(scene, job, ROOT)), None)


def world_from_solved(root: bpy.types.Object | None) -> NDArray[np.float64]:
    """(4, 4) similarity of what hangs on the root; the identity without one.

    The root itself stands upright below the subject, for the user to move, turn and scale: how the solved
    frame lies in it is kept beside it.
    """
    if root is None:
        return np.eye(4)
    return np.array(root.matrix_world, np.float64) @ kept_similarity(root, UPRIGHT)


def cameras_with_photographs(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The cameras that imports have made, by photograph."""
    found = [made for made in scene.objects if PHOTO in made and made.type == "CAMERA" and made[PHOTO]]
    return sorted(found, key=lambda camera: str(camera.get(PHOTO, "")))


def camera_of_photograph(scene: bpy.types.Scene, photograph: str) -> bpy.types.Object | None:
    """The camera of a photograph, given by its path or the end of it; None where it has none.

    Where several jobs placed it, it is that of the cameras in use. Raises ValueError where the name alone is
    that of several photographs.
    """
    path = Path(photograph)
    cameras = cameras_with_photographs(scene)
    found = [camera for camera in cameras if is_named(path, str(camera[PHOTO]))]
    found = found or [camera for camera in cameras if is_named(Path(str(camera[PHOTO])), photograph)]
    names = sorted({str(camera[PHOTO]) for camera in found})
    if len(names) > 1:
        raise ValueError(f"Several photographs are called {path.name}: choose {' or '.join(names)}")
    return max(found, key=lambda camera: camera.get(JOB) == scene.fewview.cameras_job, default=None)


def jobs_of(scene: bpy.types.Scene) -> tuple[str, ...]:
    """The jobs of which something was imported."""
    ours = [made for made in scene.objects if ROLE in made and made[ROLE] in {ROOT, CAMERA, POINTS}]
    return tuple(sorted({str(made.get(JOB, "")) for made in ours}))


def remove(scene: bpy.types.Scene, job: str) -> int:
    """Remove what imports of the job have made, and say how many objects that was.

    The root stays while something else, such as the mesh or the user's own objects, hangs on it, and while
    there is a region: it says where in the cameras' frame that is.
    """
    cameras = objects_of(scene, job, CAMERA)
    gone = cameras + objects_of(scene, job, POINTS)
    num_gone = len(gone)
    for made in gone:
        remove_object(made)
    root = root_or_none(scene, job)
    if root is not None and not root.children and in_scene(scene, scene.fewview.region) is None:
        remove_object(root)
        num_gone += 1
    collection = _collection_or_none(scene, job)
    if collection is not None and not collection.all_objects and not collection.children:
        bpy.data.collections.remove(collection)
    return num_gone


def remove_object(made: bpy.types.Object) -> None:
    """Remove an object of ours, and its data unless something else uses it; children stay in place."""
    for child in made.children:
        world_from_child = child.matrix_world.copy()
        child.parent = None
        child.matrix_world = world_from_child
    data = made.data
    bpy.data.objects.remove(made)
    if data is not None and data.users == 0:
        bpy.data.batch_remove([data])


def _make_root(scene: bpy.types.Scene, wanted: CameraImport) -> None:
    """The root of an estimated scene, as the user left it if it is there already."""
    if not wanted.solved.estimated:
        scene.fewview.root = None
        return
    root = root_or_none(scene, wanted.job)
    if root is None:
        root = bpy.data.objects.new("FewView Placement", None)
        _tag(root, wanted.job, ROOT)
        _collection(scene, wanted.job).objects.link(root)
        root.empty_display_type = "PLAIN_AXES"
        root.empty_display_size = 0.25
        points = None if wanted.points is None else wanted.points.positions
        root[UPRIGHT] = upright(wanted.solved, points).ravel().tolist()
    scene.fewview.root = root


def _make_camera(scene: bpy.types.Scene, wanted: CameraImport, solved: SolvedCamera) -> None:
    _make_root(scene, wanted)
    camera = next(
        (
            o
            for o in objects_of(scene, wanted.job, CAMERA)
            if o.get(PHOTO) == solved.name and o.type == "CAMERA"
        ),
        None,
    )
    if camera is None:
        name = Path(solved.name).stem
        camera = bpy.data.objects.new(name, bpy.data.cameras.new(name))
        _tag(camera, wanted.job, CAMERA)
        camera[PHOTO] = solved.name
        _collection(scene, wanted.job).objects.link(camera)
    _hang(camera, root_or_none(scene, wanted.job), solved.world_from_camera)
    camera[SIZE] = (solved.pinhole.width, solved.pinhole.height)
    shared = shared_aspect_or_none(tuple(c.pinhole for c in wanted.solved.cameras))
    render = scene.render
    aspect = render.pixel_aspect_y / render.pixel_aspect_x if shared is None else shared
    apply_lens(camera.data, solved.pinhole, pixel_aspect=aspect)
    _set_sizes(camera, root_or_none(scene, wanted.job), wanted.solved)
    _show_behind(camera.data, solved.pinhole, photograph_or_none(solved.name, wanted.photographs))


def _hang(
    made: bpy.types.Object, root: bpy.types.Object | None, solved_from_object: NDArray[np.float64]
) -> None:
    """Put the object where it belongs, under the root; a camera keeps its own size."""
    made.parent = root
    root_from_object = kept_similarity(root, UPRIGHT) @ solved_from_object
    if made.type == "CAMERA":
        root_from_object[:3, :3] /= np.cbrt(np.linalg.det(root_from_object[:3, :3]))
    made.matrix_basis = Matrix(root_from_object.tolist())


def kept_similarity(made: bpy.types.Object | None, name: str) -> NDArray[np.float64]:
    """(4, 4) that the object keeps; the identity where there is none, or the user has removed it."""
    kept = None if made is None else made.get(name)
    if kept is None or len(kept) != 16:
        return np.eye(4)
    return np.array(kept, np.float64).reshape(4, 4)


def selected_cameras(view_layer: bpy.types.ViewLayer) -> list[bpy.types.Object]:
    """Of any origin."""
    return [made for made in view_layer.objects if made.type == "CAMERA" and made.select_get()]


def _set_sizes(camera: bpy.types.Object, root: bpy.types.Object | None, solved: SolvedScene) -> None:
    """Clipping range and size on the screen that fit the subject."""
    scale = float(np.cbrt(abs(np.linalg.det(world_from_solved(root)[:3, :3]))))
    size = _size_solved(solved) * scale
    centre = np.append(_centre(solved), 1.0)
    centre_root = (kept_similarity(root, UPRIGHT) @ centre)[:3]
    distance = float(np.linalg.norm(np.array(camera.matrix_basis.translation) - centre_root))
    distance *= 1.0 if root is None else max(map(abs, root.matrix_world.to_scale()))
    camera.data.display_size = 0.3 * size
    camera.data.clip_start = 0.01 * size
    camera.data.clip_end = 2 * distance + 100 * size


def _show_behind(data: bpy.types.Camera, pinhole: Pinhole, photograph: Path | None) -> None:
    """Show the photograph when looking through the camera; Blender reads the file when it first does.

    One that it does not read would be a picture of nothing.
    """
    if photograph is None or is_of_phone(photograph):
        return
    if not data.background_images:
        data.background_images.new()
    background = data.background_images[0]
    background.image = bpy.data.images.load(str(photograph), check_existing=True)
    background.alpha, background.display_depth, background.frame_method = 0.7, "BACK", "FIT"
    # Blender shows pictures as they are stored, and fits them into the frame before it turns them.
    turn_deg = clockwise_turn_deg(photograph)
    background.rotation = np.deg2rad(turn_deg)
    short, long = sorted((pinhole.width, pinhole.height))
    background.scale = long / short if turn_deg % 180 else 1.0
    data.show_background_images = True
    data.passepartout_alpha = 0.8


def _make_points(scene: bpy.types.Scene, wanted: CameraImport, ply: PlyMesh) -> None:
    positions, colours_srgb = ply.positions, ply.colours_srgb
    _make_root(scene, wanted)
    for old in objects_of(scene, wanted.job, POINTS):
        remove_object(old)
    mesh = bpy.data.meshes.new("FewView Points")
    mesh.vertices.add(len(positions))
    mesh.vertices.foreach_set("co", positions.astype(np.float32).ravel())
    if colours_srgb is not None:
        colours = np.full((len(positions), 4), 255, np.uint8)
        colours[:, : colours_srgb.shape[1]] = colours_srgb
        attribute = mesh.color_attributes.new(POINT_COLOURS, "BYTE_COLOR", "POINT")
        attribute.data.foreach_set("color_srgb", (colours / np.float32(255)).astype(np.float32).ravel())
    mesh.update()
    points = bpy.data.objects.new("FewView Points", mesh)
    _tag(points, wanted.job, POINTS)
    points.hide_render = True
    _collection(scene, wanted.job).objects.link(points)
    _hang(points, root_or_none(scene, wanted.job), np.eye(4))


def _remove_old_cameras(scene: bpy.types.Scene, wanted: CameraImport) -> None:
    """Those of photographs that have no camera any more."""
    names = {camera.name for camera in wanted.solved.cameras}
    for camera in objects_of(scene, wanted.job, CAMERA):
        if camera.get(PHOTO) not in names:
            remove_object(camera)


def _tag(made: bpy.types.ID, job: str, role: str) -> None:
    made[JOB], made[ROLE] = job, role


def _collection_or_none(scene: bpy.types.Scene, job: str) -> bpy.types.Collection | None:
    return next((c for c in scene.collection.children_recursive if c.get(JOB) == job), None)


def _collection(scene: bpy.types.Scene, job: str) -> bpy.types.Collection:
    """The collection of the job's cameras, made where it is missing."""
    found = _collection_or_none(scene, job)
    if found is None:
        found = bpy.data.collections.new("FewView Cameras")
        _tag(found, job, CAMERA)
        scene.collection.children.link(found)
    return found


def upright(solved: SolvedScene, points: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """(4, 4) similarity world_from_solved for cameras that have no place of their own."""
    axes = solved.poses[:, :3, :3]  # right, up and backwards of each picture
    up = up_direction(*np.moveaxis(axes / np.linalg.norm(axes, axis=1, keepdims=True), 2, 0))
    return upright_from_solved(solved.poses, _centre(solved), _size_solved(solved), up=up, points=points)


def _centre(solved: SolvedScene) -> NDArray[np.float64]:
    """(3,) of the subject as far as it is known."""
    if solved.region_centre is None:
        return solved.poses[:, :3, 3].mean(axis=0)
    return np.array(solved.region_centre, np.float64)


def _size_solved(solved: SolvedScene) -> float:
    """Radius of the subject, or else half of what the cameras span; 1 where that is a point."""
    if solved.region_radius is not None:
        return solved.region_radius
    span = float(np.linalg.norm(np.ptp(solved.poses[:, :3, 3], axis=0))) / 2
    return span or 1.0
