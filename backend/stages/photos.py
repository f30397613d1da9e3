"""First stage: photographs from files, upright and at working size, each with its mask."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from ..errors import ErrorCode, ReconstructionError
from ..images import DecodedImage, read_image, resized, same_shape, upright
from ..maths.pieces import along_border
from ..scene import Photo, Progress
from ..wire.photographs import (
    KINDS,
    MASK_ENDINGS,
    first_names,
    is_readable,
    masks_among,
    names_of,
    passed_over,
    passed_over_text,
    photographs_in,
    pictures_in,
    spelling,
)

_WHITE_ON_BLACK = "Make the subject white and the rest black."
_ALONG_EDGES = 0.95
"""Of the edges of every photograph: the masks of walls and floors reach them too, but end somewhere."""
_OPAQUE = "Make the subject opaque, or save the photograph without transparency."


@dataclass(frozen=True, kw_only=True)
class PhotosConfig:
    """How the photographs are read."""

    max_side_px: int = 1600
    """Larger photographs are scaled down until their longer side is this."""


def load_photos(
    sources: Sequence[Path],
    masks_folder: Path | None,
    config: PhotosConfig,
    *,
    progress: Progress,
) -> tuple[Photo, ...]:
    """The photographs among the sources, which are files or folders, in natural order.

    A mask in masks_folder counts before the alpha channel. Photographs without either have no mask.
    Raises ReconstructionError: NO_PHOTOS, TOO_FEW_PHOTOS, PHOTO_UNREADABLE, MASK_UNUSABLE.
    """
    files = named_photos(sources)
    masks = {} if masks_folder is None else match_masks(files, masks_folder)
    photos = []
    for index, (name, path) in enumerate(files.items()):
        progress(index / len(files), f"Reading {name}")
        photos.append(_load_photo(path, name, masks.get(name), config))
    return tuple(photos)


def named_photos(sources: Sequence[Path]) -> dict[str, Path]:
    """The files that `find_photos` finds, in its order, by the names that the photographs have."""
    paths = find_photos(sources)
    return dict(zip(names_of(paths), paths, strict=True))


def find_photos(sources: Sequence[Path]) -> list[Path]:
    """Photographs among the sources, each once, in natural order; of a folder its visible image files.

    Masks of the others, as a_mask.png beside a.jpg, are none. Nor are files of kinds that cannot be read:
    of a raw photograph it would be the thumbnail.
    """
    found: dict[Path, Path] = {}
    for source in sources:
        if not source.exists():
            raise ReconstructionError(
                ErrorCode.NO_PHOTOS, f"There is no file or folder {source}.", "Check the path."
            )
        members = photographs_in(source) if source.is_dir() else [source]
        found.update({path.resolve(): path for path in members if is_readable(path)})
    masks = masks_among(found.values())
    found = {place: path for place, path in found.items() if path not in masks}
    skipped = passed_over_text(passed_over(sources))
    if not found:
        places = ", ".join(str(source) for source in sources) or "the list"
        text = f"There are no photographs in {places}."
        raise ReconstructionError(
            ErrorCode.NO_PHOTOS,
            text,
            skipped or f"Give a folder with photographs: {KINDS} can be read.",
        )
    if len(found) == 1:
        text = "There is only one photograph."
        raise ReconstructionError(
            ErrorCode.TOO_FEW_PHOTOS,
            text,
            skipped or "Take at least two, or better three or more, from different places.",
        )
    return sorted(found.values(), key=lambda path: (natural_order(path.name), str(path)))


def natural_order(name: str) -> tuple[tuple[int, int, str], ...]:
    """A sorting key by which 2.jpg stands before 10.jpg."""
    parts = re.split(r"([0-9]+)", name.lower())
    return tuple((0, int(part), "") if index % 2 else (1, 0, part) for index, part in enumerate(parts))


def match_masks(photos: Mapping[str, Path], masks_folder: Path) -> dict[str, Path]:
    """The mask file of each photograph that has one, by the photograph's name.

    For a.jpg: a.jpg_mask.png, a.jpg.mask.png, a.jpg.png, a_mask.png, a.mask.png or a.png, in any image
    format and letter case; the first of these that there is. No photograph is a mask, and no mask that of
    two photographs.
    Raises ReconstructionError(MASK_UNUSABLE).
    """
    if not masks_folder.is_dir():
        text = f"There is no folder {masks_folder} with masks."
        raise ReconstructionError(ErrorCode.MASK_UNUSABLE, text, "Check the path.")
    places = {path.resolve() for path in photos.values()}
    others = (path for path in sorted(pictures_in(masks_folder)) if path.resolve() not in places)
    by_stem = {spelling(path.stem): path for path in others}
    photo_of: dict[Path, str] = {}
    for name in photos:
        base = Path(name)
        stems = [own + ending for own in (base.name, base.stem) for ending in (*MASK_ENDINGS, "")]
        mask = next((by_stem[spelling(stem)] for stem in stems if spelling(stem) in by_stem), None)
        if mask in photo_of:
            text = f"The mask {mask.name} could be that of {photo_of[mask]} or of {name}."
            remedy = "Give each photograph a name of its own, and its mask the same."
            raise ReconstructionError(ErrorCode.MASK_UNUSABLE, text, remedy)
        if mask is not None:
            photo_of[mask] = name
    if not photo_of:
        text = f"No mask in {masks_folder} is named like a photograph."
        remedy = passed_over_text(passed_over([masks_folder])) or _naming_text(next(iter(photos)))
        raise ReconstructionError(ErrorCode.MASK_UNUSABLE, text, remedy)
    return {name: mask for mask, name in photo_of.items()}


def without_masks_text(names: Sequence[str]) -> str:
    """What to say of photographs without masks where others have some."""
    return (
        f"There is no mask for {first_names(names)}: their background may stay in the mesh. "
        f"{_naming_text(names[0])}"
    )


def white_masks_text(photos: Sequence[Photo]) -> str:
    """What to say of masks that cut nothing out of any photograph, or all the middle; empty without such."""
    masks = [photo.mask for photo in photos if photo.mask is not None]
    if not masks or any(_share_along_edges(mask) <= _ALONG_EDGES for mask in masks):
        return ""
    if not any((mask <= 0.5).any() for mask in masks):
        return f"The masks are white all over, so that they cut nothing out. {_WHITE_ON_BLACK}"
    return (
        "The masks are white along all edges of the photographs and black inside, "
        f"as if they were of the background. {_WHITE_ON_BLACK}"
    )


def turned_text(what: str, photos: Sequence[Photo]) -> str:
    """What to say of photographs whose masks or cameras, which `what` tells, may be of the files' own pixels.

    Empty where EXIF turns none of them, or only such whose shape tells: those taken on their side.
    """
    names = [photo.name for photo in photos if photo.exif_orientation != 1 and _keeps_shape(photo)]
    if not names:
        return ""
    return (
        f"EXIF asks to turn {first_names(names)}: their {what} are taken to be of what is then upright. "
        f"If they are not, save these photographs upright and make {what} of them again."
    )


def _keeps_shape(photo: Photo) -> bool:
    return photo.exif_orientation < 5 or photo.original_width == photo.original_height


def unused_masks_text(sources: Sequence[Path]) -> str:
    """What to say of masks that lie among the photographs where none were asked for; empty without any."""
    pictures = [path for source in sources for path in (pictures_in(source) if source.is_dir() else [source])]
    names = sorted({path.name for path in masks_among(pictures)}, key=natural_order)
    if not names:
        return ""
    return (
        f"By their names these are masks, no photographs, and are not used: {first_names(names)}. "
        "Name their folder as that of the masks to use them."
    )


def _naming_text(name: str) -> str:
    # beside the photographs, too, this name makes it a mask
    return f"Name the mask of {name} {Path(name).stem}_mask.png."


def _load_photo(path: Path, name: str, mask_path: Path | None, config: PhotosConfig) -> Photo:
    decoded = read_image(path, config.max_side_px)
    if mask_path is None:
        mask = decoded.mask if decoded.mask is None or is_outline(decoded.mask) else None
    else:
        mask = _load_mask(mask_path, name, decoded)
    if mask is not None and mask.max() == 0:
        what, remedy = ("mask", _WHITE_ON_BLACK) if mask_path else ("alpha channel", _OPAQUE)
        text = f"The {what} of {name} is empty: it leaves nothing of the photograph."
        raise ReconstructionError(ErrorCode.MASK_UNUSABLE, text, remedy)
    return Photo(
        name=name,
        path=path,
        image_srgb=decoded.image_srgb,
        mask=mask,
        original_width=decoded.original_width,
        original_height=decoded.original_height,
        focal_px=decoded.focal_px,
        exif_orientation=decoded.exif_orientation,
    )


def is_outline(alpha: Float32[np.ndarray, "height width"]) -> bool:
    """Whether an alpha channel cuts out a subject.

    One that is opaque along most of a frame just inside the picture only marks pixels that hold nothing,
    as undistortion and stitching leave them at the edges.
    """
    return _share_along_edges(alpha) < 0.5


def _share_along_edges(alpha: Float32[np.ndarray, "height width"]) -> float:
    """Of a frame just inside the picture, what is opaque or white; 0 where there is no inside."""
    height, width = alpha.shape
    inset = max(1, round(0.04 * min(height, width)))
    inner = alpha[inset : height - inset, inset : width - inset] > 0.5
    if min(inner.shape, default=0) < 2:
        return 0.0
    return float(along_border(inner).mean())


def _load_mask(path: Path, photo_name: str, photo: DecodedImage) -> Float32[np.ndarray, "height width"]:
    """The mask in a file, scaled to the size of its photograph and to values from 0 to 1.

    One that EXIF does not turn and that fits only the photograph's pixels as stored is turned as they are.
    """
    height, width = photo.image_srgb.shape[:2]
    try:
        decoded = read_image(path)
    except ReconstructionError as error:
        raise ReconstructionError(ErrorCode.MASK_UNUSABLE, error.text, error.remedy) from error
    values = _mask_values(decoded)
    if decoded.exif_orientation == 1 and not _has_shape(values, width, height):
        values = upright(values, photo.exif_orientation)
    if not _has_shape(values, width, height):
        size = f"{decoded.original_width}x{decoded.original_height}"
        text = f"The mask {path.name} ({size}) has another shape than {photo_name} ({width}x{height})."
        raise ReconstructionError(
            ErrorCode.MASK_UNUSABLE, text, "Make masks from the photographs as they are."
        )
    return resized(values, width, height)


def _has_shape(values: Float32[np.ndarray, "_ _"], width: int, height: int) -> bool:
    return same_shape(values.shape[1], values.shape[0], width, height)


def _mask_values(decoded: DecodedImage) -> Float32[np.ndarray, "height width"]:
    """An alpha channel that cuts out a subject, or else the brightness; 1 where it is largest.

    Some tools write 1 of 255; some leave an alpha channel that cuts out nothing, or all, beside a mask in
    colours. Where those are even, as of a subject before nothing, alpha counts whatever it cuts out.
    """
    brightness, alpha = decoded.image_srgb.mean(axis=2), decoded.mask
    is_cut_out = alpha is not None and is_outline(alpha) and alpha.max() > 0.5
    values = alpha if alpha is not None and (is_cut_out or np.ptp(brightness) == 0) else brightness
    largest = float(values.max())
    return values if largest == 0 else (values / largest).astype(np.float32)
