"""Cameras that are given: nerfstudio's transforms.json, or a COLMAP model, matched to the photographs."""

import typing
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path, PurePosixPath
from types import MappingProxyType

import numpy as np
import PIL.Image  # noqa: F401 - pycolmap loaded before Pillow corrupts memory when Pillow next saves
import pycolmap
from jaxtyping import Bool, Float64

from ...errors import ErrorCode, ReconstructionError
from ...images import same_shape
from ...mesh_files import SPARSE, MeshFileError, read_sparse
from ...scene import Camera, Decision, Photo, Unplaced
from ...wire.photographs import first_names, is_named, spelling
from .lenses import PlacedPhoto, Placement, rigid_matrix, sparse_points, undistorted_view
from .nerfstudio import (
    CAMERAS,
    Estimate,
    estimate_or_none,
    frame_lens,
    is_ours,
    read_frames,
    world_from_camera,
)
from .stored_pixels import is_of_stored_pixels, turned_upright

_ROTATION_TOLERANCE = 5e-3
"""Poses are often written with few digits; nearer than this they are made exact."""

LARGEST_SIDE_PX = 20_000
"""Of a picture to render: 400 million pixels are a slip of the pen."""

_NOTHING: Mapping[int, str] = MappingProxyType({})
_CHECK = "Check that the cameras belong to these photographs."


def read_placement(photos: Sequence[Photo], given: Path, *, as_stored: bool = False) -> Placement:
    """The cameras in a transforms.json, a COLMAP model, or the folder of one or of a finished run.

    Cameras and photographs are matched by file name; photographs without a camera are not placed. COLMAP does
    not look at the EXIF orientation, so cameras of a model are turned with their photographs; those of a
    transforms.json only where they would not fit else, or `as_stored` says that they are of stored pixels.
    Raises ReconstructionError(CAMERAS_UNUSABLE).
    """
    source = cameras_source(given)
    if source.is_dir():
        return _from_model(photos, source)
    return _from_transforms(photos, source, as_stored=as_stored)


def read_cameras(given: Path) -> tuple[tuple[str, Camera], ...]:
    """Names and pinhole cameras of a transforms.json or a COLMAP model, without any photographs.

    A lens that bends light gives the pinhole camera that its photograph would have been undistorted to. The
    file has to tell the pictures' sizes. Raises ReconstructionError(CAMERAS_UNUSABLE).
    """
    source = cameras_source(given)
    blanks = _blanks_of_model(source) if source.is_dir() else _blanks_of_transforms(source)
    if not blanks:
        raise _unusable(f"{source.name} holds no cameras.", "Export it again.")
    placed = read_placement(blanks, given).placed
    return tuple((blanks[one.index].name, undistorted_view(blanks[one.index], one).camera) for one in placed)


def may_be_unturned(given: Path) -> bool:
    """Whether cameras that are taken to be of upright photographs may not be.

    Those that others wrote as transforms.json: they may have looked at the EXIF orientation or not.
    """
    source = cameras_source(given)
    return source.is_file() and not is_ours(read_frames(source))


def _blanks_of_transforms(path: Path) -> tuple[Photo, ...]:
    """Photographs as the file tells of them, with nothing on them."""
    blanks = []
    for frame in read_frames(path):
        name, sides = str(frame["file_path"]), (frame.get("w"), frame.get("h"))
        if not all(isinstance(side, int | float) and 1 <= side <= LARGEST_SIDE_PX for side in sides):
            text = f"{path.name} does not tell how large the picture {name} is."
            raise _unusable(text, "Add its width and height in pixels as w and h.")
        width, height = (round(typing.cast(float, side)) for side in sides)
        blanks.append(_blank(name, width, height))
    return tuple(blanks)


def _blanks_of_model(folder: Path) -> tuple[Photo, ...]:
    model = _model(folder)
    images = [model.images[number] for number in sorted(model.reg_image_ids())]
    lenses = [model.cameras[image.camera_id] for image in images]
    pairs = zip(images, lenses, strict=True)
    return tuple(_blank(image.name, lens.width, lens.height) for image, lens in pairs)


def _blank(name: str, width: int, height: int) -> Photo:
    return Photo(
        name=name,
        path=Path(name),
        image_srgb=np.broadcast_to(np.float32(0), (height, width, 3)),
        mask=None,
        original_width=width,
        original_height=height,
        focal_px=None,
    )


def match_by_name(photo_paths: Sequence[str], camera_paths: Sequence[str]) -> dict[int, int]:
    """Index of the camera for each photograph that has one.

    The file name decides, whatever its letter case and, where nothing fits better, its extension; where
    cameras in several folders have it, the folders decide. Raises ReconstructionError(CAMERAS_UNUSABLE)
    where they do not.
    """
    fits = {
        (photo, camera): _likeness(photo_path, camera_path)
        for photo, photo_path in enumerate(photo_paths)
        for camera, camera_path in enumerate(camera_paths)
    }
    matched: dict[int, int] = {}
    for (photo, camera), fit in sorted(fits.items(), key=lambda item: (-item[1], item[0])):
        if fit == 0 or photo in matched or camera in matched.values():
            continue
        rivals = [c for c in range(len(camera_paths)) if c not in matched.values() and fits[photo, c] == fit]
        if len(rivals) > 1:
            name = PurePosixPath(photo_paths[photo]).name
            text = f"{len(rivals)} of the cameras could be that of {name}."
            raise _unusable(text, "Give each photograph a name of its own.")
        matched[photo] = camera
    return matched


def checked_pose(b_from_a: Float64[np.ndarray, "4 4"], photo_name: str) -> Float64[np.ndarray, "4 4"]:
    """The pose with its rotation made exact and its translation as it is.

    Raises ReconstructionError(CAMERAS_UNUSABLE) where it is none.
    """
    if not np.isfinite(b_from_a).all():
        raise _unusable(f"The camera of {photo_name} has numbers that are not finite.")
    rotation = b_from_a[:3, :3]
    left, stretches, right = np.linalg.svd(rotation)
    if np.abs(stretches - 1).max() > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        text = f"The camera matrix of {photo_name} is no rotation with a position: it stretches or mirrors."
        raise _unusable(text, "Export the cameras without scale.")
    if not np.allclose(b_from_a[3], [0, 0, 0, 1]):
        raise _unusable(f"The camera matrix of {photo_name} does not end in 0 0 0 1.")
    exact = np.eye(4)
    exact[:3, :3] = left @ right
    exact[:3, 3] = b_from_a[:3, 3]
    return exact


def cameras_source(given: Path) -> Path:
    """The file or the model folder that is meant. Raises ReconstructionError(CAMERAS_UNUSABLE)."""
    if given.is_file() and given.suffix.lower() == ".json":
        return given
    if given.is_file():
        # One of the files of a COLMAP model.
        given = given.parent
    if (given / "transforms.json").is_file():
        return given / "transforms.json"
    for folder in (given, given / "sparse" / "0", given / "sparse", given / "0"):
        if any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            return folder
    if (given / CAMERAS).is_file():
        return given / CAMERAS
    text = f"There are no cameras in {given}."
    raise _unusable(
        text, "Give a nerfstudio transforms.json, or the folder of a COLMAP model or a finished run."
    )


def _from_transforms(photos: Sequence[Photo], path: Path, *, as_stored: bool) -> Placement:
    frames = read_frames(path)
    estimate = estimate_or_none(frames)
    why = _why_unplaced(photos, estimate)
    matched = _matched(photos, [str(frame["file_path"]) for frame in frames], path, left_out=why)
    read = []
    for index, number in sorted(matched.items()):
        photo, frame = photos[index], frames[number]
        lens = frame_lens(frame, photo)
        # exact before it is inverted: far from the origin the position keeps its digits, not the rotation's
        pose = checked_pose(world_from_camera(frame, photo.name), photo.name)
        read.append(PlacedPhoto(index=index, lens=lens, camera_from_world=np.linalg.inv(pose)))
    placed, decisions = _upright(photos, read, path, as_stored=as_stored)
    columns = [number for _, number in sorted(matched.items())]
    positions, visibility = np.zeros((0, 3)), np.zeros((0, len(placed)), bool)
    if estimate is not None:
        positions, visibility = _points_beside(path, columns, len(frames))
    because = f"{path.name} says that FewView estimated them"
    return Placement(
        placed=placed,
        unplaced=_unplaced(photos, matched, path, why),
        sparse_positions=positions,
        sparse_visibility=visibility,
        reprojection_error_px=None if estimate is None else estimate.reprojection_error_px,
        estimated=estimate is not None,
        decisions=decisions
        if estimate is None
        else (Decision(what="cameras", choice="as found before", because=because), *decisions),
    )


def _why_unplaced(photos: Sequence[Photo], estimate: Estimate | None) -> dict[int, str]:
    """Why an earlier job could not place some of the photographs."""
    told = {} if estimate is None else estimate.why_unplaced
    return {
        i: why for i, photo in enumerate(photos) for name, why in told.items() if is_named(photo.path, name)
    }


def _points_beside(
    path: Path, columns: Sequence[int], num_cameras: int
) -> tuple[Float64[np.ndarray, "points 3"], Bool[np.ndarray, "points columns"]]:
    """The points that two of these cameras see, of the sparse.ply beside the file; none where it has none."""
    try:
        positions, visibility = read_sparse(path.with_name(SPARSE), num_cameras)
    except (OSError, MeshFileError):
        return np.zeros((0, 3)), np.zeros((0, len(columns)), bool)
    visibility = visibility[:, list(columns)]
    shared = visibility.sum(axis=1) >= 2
    return positions[shared], visibility[shared]


def _model(folder: Path) -> pycolmap.Reconstruction:
    try:
        model = pycolmap.Reconstruction(folder)
    except (ValueError, RuntimeError, IndexError) as error:
        raise _unusable(
            f"The COLMAP model in {folder} cannot be read ({error}).", "Export it again."
        ) from error
    if not (folder / "images.bin").is_file():
        for image_id, name in _names_in_text(folder / "images.txt").items():
            model.images[image_id].name = name
    return model


def _names_in_text(path: Path) -> dict[int, str]:
    """The images' names, by their numbers: of a text model pycolmap reads them only up to the first blank."""
    lines = map(str.strip, path.read_text(encoding="utf-8", errors="surrogateescape").split("\n"))
    names = {}
    for line in lines:
        if line and not line.startswith("#"):
            number, *_, name = line.split(maxsplit=9)
            names[int(number)] = name
            next(lines, None)  # the image's points, of which there may be none
    return names


def _from_model(photos: Sequence[Photo], folder: Path) -> Placement:
    model = _model(folder)
    image_ids = sorted(model.reg_image_ids())
    matched = _matched(photos, [model.images[i].name for i in image_ids], folder)
    read, ids = [], []
    for index, number in sorted(matched.items()):
        image = model.images[image_ids[number]]
        lens = model.cameras[image.camera_id]
        pose = checked_pose(rigid_matrix(image.cam_from_world()), photos[index].name)
        read.append(PlacedPhoto(index=index, lens=lens, camera_from_world=pose))
        ids.append(image_ids[number])
    placed, decisions = _upright(photos, read, folder, as_stored=True)
    positions, visibility = sparse_points(model, ids)
    return Placement(
        placed=placed,
        unplaced=_unplaced(photos, matched, folder),
        sparse_positions=positions,
        sparse_visibility=visibility,
        reprojection_error_px=None,
        decisions=decisions,
    )


def _matched(
    photos: Sequence[Photo], camera_paths: Sequence[str], source: Path, *, left_out: Collection[int] = ()
) -> dict[int, int]:
    """Index of the camera for each photograph that has one, but for those left out."""
    rest = [index for index in range(len(photos)) if index not in left_out]
    found = match_by_name([photos[index].path.as_posix() for index in rest], camera_paths)
    matched = {rest[photo]: camera for photo, camera in found.items()}
    if not matched:
        theirs = camera_paths[0] if camera_paths else "nothing"
        text = (
            f"No camera in {source.name} is named like a photograph: {theirs} there, {photos[0].name} here."
        )
        raise _unusable(text)
    return matched


def _unplaced(
    photos: Sequence[Photo], matched: Mapping[int, int], source: Path, why: Mapping[int, str] = _NOTHING
) -> tuple[Unplaced, ...]:
    """The photographs that no camera is named like, and why where that is known."""
    unnamed = f"no camera in {source.name} has its name"
    rest = (index for index in range(len(photos)) if index not in matched)
    return tuple(Unplaced(name=photos[index].name, why=why.get(index, unnamed)) for index in rest)


def _likeness(photo_path: str, camera_path: str) -> int:
    """0 for another file; more for the same extension, and more for each folder above that agrees."""
    photo = PurePosixPath(spelling(photo_path))
    camera = PurePosixPath(spelling(camera_path).replace("\\", "/"))
    # A camera may be named without extension: then its stem can have dots.
    if photo.stem not in (camera.stem, camera.name):
        return 0
    likeness = 2 if photo.name == camera.name else 1
    for ours, theirs in zip(photo.parts[-2::-1], camera.parts[-2::-1], strict=False):
        if ours != theirs:
            break
        likeness += 2
    return likeness


def _upright(
    photos: Sequence[Photo], read: Sequence[PlacedPhoto], source: Path, *, as_stored: bool
) -> tuple[tuple[PlacedPhoto, ...], tuple[Decision, ...]]:
    """The cameras that were read, checked, and turned where they are of their file's own pixels.

    as_stored: whether to take them for such where their shape does not tell.
    """
    placed, turned = [], []
    for one in read:
        photo = photos[one.index]
        _check_lens(photo, one.lens)
        if is_of_stored_pixels(photo, one.lens, where_both_fit=as_stored):
            one = turned_upright(photo, one)
            turned.append(photo.name)
        _check_shape(photo, one.lens)
        placed.append(one)
    because = f"{source.name} is of pixels as they are stored, and EXIF turns {first_names(turned)}"
    decision = Decision(what="cameras", choice="turned with their photographs", because=because)
    return tuple(placed), (decision,) if turned else ()


def _check_shape(photo: Photo, lens: pycolmap.Camera) -> None:
    if not same_shape(lens.width, lens.height, photo.original_width, photo.original_height):
        ours = f"{photo.original_width}x{photo.original_height}"
        text = (
            f"The camera of {photo.name} is for {lens.width}x{lens.height} pixels, the photograph has {ours}."
        )
        raise _unusable(text)


def _check_lens(photo: Photo, lens: pycolmap.Camera) -> None:
    if not lens.is_perspective():  # asked for its focal length, pycolmap would crash
        text = f"The camera of {photo.name} is a panorama ({lens.model.name}), which cannot be used."
        raise _unusable(text, "Give photographs and cameras of one direction each.")
    if not np.isfinite(lens.params).all() or min(lens.focal_length_x, lens.focal_length_y) <= 0:
        raise _unusable(f"The focal length or distortion of {photo.name} is not finite and positive.")


def _unusable(text: str, remedy: str = _CHECK) -> ReconstructionError:
    return ReconstructionError(ErrorCode.CAMERAS_UNUSABLE, text, remedy)
