"""Renders views of the scene that is there, with exact cameras, and leaves the scene as it was.

FOLDER/images/000.png ...   8-bit RGBA, plain sRGB; alpha is the mask of the subject
       truth.ply            the subject's true surface, world frame, where there is a subject
       transforms.json      exact cameras as nerfstudio writes them; written last: without it the folder
                            is not finished
"""

import json
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from .camera_lens import pinhole_of, world_from_camera
from .kept_settings import Change, changed
from .png import critical_chunks
from .scenes import object_named
from .solved import SolvedCamera, write_cameras
from .true_mesh import TrueMesh, as_rendered, instanced_by, rendered_objects, subject_of, true_mesh, write_ply

IMAGES, TRANSFORMS, TRUTH = "images", "transforms.json", "truth.ply"
ENGINES = {"CYCLES": "CYCLES", "WORKBENCH": "BLENDER_WORKBENCH"}
"""Blender's ids; any other name means the scene's own engine."""
PENCILS = {"GREASEPENCIL", "GPENCIL"}
"""Type of the objects of Grease Pencil, from Blender 4.3 on and before."""
PLACE = ("location", "rotation_euler", "rotation_quaternion", "rotation_axis_angle", "scale")
"""What moves an object; which rotation counts is a choice of the object."""

_MUCH_PLAIN = 0.2


@dataclass(frozen=True, kw_only=True)
class View:
    """One picture to take."""

    camera: str
    """Full name of the object; empty for the scene's camera at the frame."""
    frame: int | None = None
    """None for the frame that is shown."""


@dataclass(frozen=True, kw_only=True)
class ViewRequest:
    """Everything that decides what is rendered."""

    scene: str
    """Full name."""
    view_layer: str
    views: tuple[View, ...]
    target: str | None
    """Full name of the subject's object; None to render the scene as it is."""
    engine: str
    samples: int
    """Of Cycles."""
    width: int
    height: int


def encode_request(request: ViewRequest) -> str:
    """The request as JSON."""
    return json.dumps(asdict(request))


def decode_request(text: str) -> ViewRequest:
    """The inverse of `encode_request`, for our own files. Raises ValueError, TypeError or KeyError."""
    found = json.loads(text)
    views = tuple(View(**view) for view in found.pop("views"))
    return ViewRequest(views=views, **found)


def render_views(request: ViewRequest, folder: Path) -> Generator[tuple[int, Path], None, None]:
    """Render the context's scene into a new folder, and give number and file of each view when it is done.

    The generator must be used up, or closed, before anything else touches the scene: only then is every
    setting as it was. Raises ValueError where the scene cannot be rendered so, RuntimeError where Blender
    fails to, OSError where the folder cannot be written.
    """
    scene = bpy.context.scene
    if (scene.name_full, bpy.context.view_layer.name) != (request.scene, request.view_layer):
        raise ValueError(f"{request.scene}, {request.view_layer} is not what Blender shows")
    if not request.views:
        raise ValueError("there are no cameras to render from")
    subject = () if request.target is None else _subject(object_named(scene, request.target))
    cameras = [object_named(scene, view.camera) for view in request.views if view.camera]
    (folder / IMAGES).mkdir(parents=True)
    taken: list[SolvedCamera] = []
    is_seen = False
    changes = (
        *_marker_changes(scene, request),
        *render_changes(scene, request),
        *(_fog_changes(scene) if subject else ()),
        *camera_changes(scene, cameras),
    )
    with _same_frame(scene), changed(changes):
        _go_to(scene, request.views[0])
        with as_rendered(subject):  # both ask for it: once is enough
            truth = _truth(subject) if subject else None
            masked = _mask_changes(scene, subject, scene.render.engine)
        with changed(masked):
            for index, view in enumerate(request.views):
                _go_to(scene, view)
                _check(masked)
                path = folder / IMAGES / f"{index:03d}.png"
                taken.append(_take(scene, path, noise_seed=index))
                is_seen = is_seen or _shows_something(path)
                yield index, path
    if truth is not None:
        if not is_seen:
            raise ValueError(f"{request.target} is in no picture: is it hidden from cameras?")
        write_ply(folder / TRUTH, truth)
    write_cameras(folder / TRANSFORMS, taken)


def render_changes(scene: bpy.types.Scene, request: ViewRequest) -> tuple[Change, ...]:
    """The settings under which pictures are as a plain camera takes them."""
    render, image, view = scene.render, scene.render.image_settings, scene.view_settings
    cycles = getattr(scene, "cycles", None)
    # A denoiser paints over the fine texture that stereo lives on.
    of_cycles = {"samples": request.samples, "use_denoising": False, "time_limit": 0.0, "seed": 0}
    of_render = {
        "engine": ENGINES.get(request.engine, render.engine),
        "resolution_x": request.width,
        "resolution_y": request.height,
        "resolution_percentage": 100,
        "film_transparent": True,
        "dither_intensity": 0.0,
        "filepath": "",
        "use_persistent_data": True,
        "use_file_extension": True,
        "use_overwrite": True,
        "use_placeholder": False,
    }
    off = (
        *("use_border", "use_crop_to_border", "use_compositing", "use_sequencer", "use_motion_blur"),
        *("use_multiview", "use_stamp", "use_freestyle"),
    )
    # The first ones of these decide which of the later ones are possible.
    of_image = {
        "media_type": "IMAGE",
        "file_format": "PNG",
        "color_mode": "RGBA",
        "color_depth": "8",
        "color_management": "FOLLOW_SCENE",
    }
    return (
        *((render, name, value) for name, value in of_render.items()),
        *((render, name, False) for name in off),
        *((image, name, value) for name, value in of_image.items()),
        (scene.display_settings, "display_device", "sRGB"),
        (view, "view_transform", "Standard"),
        (view, "look", "None"),
        (view, "gamma", 1.0),
        (view, "use_curve_mapping", False),
        (scene.display.shading, "show_xray", False),  # Workbench's: the mask would be half transparent
        *((cycles, name, value) for name, value in of_cycles.items() if cycles is not None),
        (scene.view_layers[request.view_layer], "samples", 0),  # they would count before the scene's
        (scene, "camera", scene.camera),
    )


def camera_changes(scene: bpy.types.Scene, cameras: Iterable[bpy.types.Object]) -> tuple[Change, ...]:
    """No depth of field: a blurred edge is no measurement."""
    markers = [marker.camera for marker in scene.timeline_markers]
    everyone = {camera.data for camera in (*cameras, scene.camera, *markers) if camera and camera.data}
    return tuple((data.dof, "use_dof", False) for data in everyone if isinstance(data, bpy.types.Camera))


def _marker_changes(scene: bpy.types.Scene, request: ViewRequest) -> tuple[Change, ...]:
    """Markers that are bound to cameras would change a view's own camera whenever it is rendered."""
    if not all(view.camera for view in request.views):
        return ()
    return tuple((marker, "camera", None) for marker in scene.timeline_markers if marker.camera)


def _fog_changes(scene: bpy.types.Scene) -> tuple[Change, ...]:
    """Without the world's volume: it lies before everything, and so all of a picture would be in the mask."""
    tree = None if scene.world is None else scene.world.node_tree
    links = () if tree is None else tree.links
    ends = (link for link in links if link.to_node.type == "OUTPUT_WORLD" and link.to_socket.name == "Volume")
    return tuple((link, "is_muted", True) for link in ends)


def _mask_changes(
    scene: bpy.types.Scene, subject: tuple[bpy.types.Object, ...], engine: str
) -> tuple[Change, ...]:
    """What is not the subject lights it and is reflected in it, but is no part of the picture's alpha."""
    if not subject:
        return ()
    kept = {*subject, *instanced_by(subject)}  # hiding what it is made of would hide it
    others = [made for made in _all_objects(scene) if made not in kept]
    # Workbench has neither light nor rays, and pencils are drawn over the picture without any.
    return tuple(
        (made, "hide_render", True)
        if engine == ENGINES["WORKBENCH"] or made.type in PENCILS
        else (made, "visible_camera", False)
        for made in others
    )


def _all_objects(scene: bpy.types.Scene) -> Iterator[bpy.types.Object]:
    """Also those of the scenes that are rendered behind this one."""
    shown: bpy.types.Scene | None = scene
    while shown is not None:
        yield from shown.objects
        shown = shown.background_set


def _check(masked: Iterable[Change]) -> None:
    """Raise ValueError where keys or a driver show what is to be no part of the picture."""
    for made, name, value in masked:
        if getattr(made, name) != value:
            label = made.bl_rna.properties[name].name
            raise ValueError(
                f"{made.name} would be in the mask: its '{label}' has keys or a driver; remove them, or "
                "render without an object"
            )


@contextmanager
def _same_frame(scene: bpy.types.Scene) -> Iterator[None]:
    """Return to the frame that was shown, to its camera, and to what was moved there without a key."""
    frame, subframe, camera = scene.frame_current, scene.frame_subframe, scene.camera
    places = [(made, name, tuple(getattr(made, name))) for made in scene.objects for name in PLACE]
    try:
        yield
    finally:
        if (scene.frame_current, scene.frame_subframe) != (frame, subframe):
            scene.frame_set(frame, subframe=subframe)
        scene.camera = camera
        for made, name, value in places:
            if tuple(getattr(made, name)) != value:
                setattr(made, name, value)


def _go_to(scene: bpy.types.Scene, view: View) -> None:
    """Show the view's frame through the view's camera, with all that has keys where these say.

    Also where the frame is shown already: rendering goes by the keys, not by what was moved since.
    """
    if view.frame is None:
        scene.frame_set(scene.frame_current, subframe=scene.frame_subframe)
    else:
        scene.frame_set(view.frame)  # a marker may change the scene's camera here
    if view.camera:
        scene.camera = object_named(scene, view.camera)
    if scene.camera is None:
        raise ValueError("the scene has no camera: add one, or render from other cameras")
    bpy.context.view_layer.update()


def _take(scene: bpy.types.Scene, path: Path, *, noise_seed: int) -> SolvedCamera:
    """Render what the scene's camera sees to the file; that camera."""
    if hasattr(scene, "cycles"):
        scene.cycles.seed = noise_seed
    camera = scene.camera
    pinhole, pose = pinhole_of(scene, camera), world_from_camera(camera)
    part = path.with_suffix(".part.png")
    scene.render.filepath = str(part)
    bpy.ops.render.render(write_still=True, layer=bpy.context.view_layer.name, scene=scene.name)
    if not part.is_file():
        raise RuntimeError(f"Blender rendered no picture from {camera.name}")
    part.write_bytes(critical_chunks(part.read_bytes()))
    part.replace(path)
    return SolvedCamera(name=f"{IMAGES}/{path.name}", world_from_camera=pose, pinhole=pinhole)


def is_ill_lit(path: Path) -> bool:
    """Whether a good part of what a rendered view shows is white or black, and so without texture."""
    rgba = _pixels_rgba(path)
    shown = rgba[rgba[:, 3] == 1.0, :3]
    plain = (shown == 1.0).all(axis=1) | (shown == 0.0).all(axis=1)
    return bool(plain.sum() > _MUCH_PLAIN * len(shown))


def _shows_something(path: Path) -> bool:
    return bool(_pixels_rgba(path)[:, 3].any())


def _pixels_rgba(path: Path) -> NDArray[np.float32]:
    """(pixels, 4), as stored."""
    image = bpy.data.images.load(str(path))
    try:
        values = np.empty(len(image.pixels), np.float32)
        image.pixels.foreach_get(values)
    finally:
        bpy.data.images.remove(image)
    return values.reshape(-1, 4)


def _subject(target: bpy.types.Object) -> tuple[bpy.types.Object, ...]:
    if target.hide_render:
        raise ValueError(f"{target.name} is hidden from renders: show it, or choose another object")
    if target not in rendered_objects(bpy.context.view_layer):
        raise ValueError(f"{target.name} is in no picture: is its collection hidden from renders?")
    return subject_of(target)


def _truth(subject: tuple[bpy.types.Object, ...]) -> TrueMesh:
    try:
        return true_mesh(subject)
    except ValueError as error:
        raise ValueError(f"{subject[0].name} cannot be rendered: {error}") from error
