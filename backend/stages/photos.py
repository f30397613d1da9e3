"""First stage: photographs from files, upright and at working size, each with its mask."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from ..errors import ErrorCode, ReconstructionError
from ..images import DecodedImage, read_image, resized, same_shape
from ..scene import Photo, Progress
from ..wire.photographs import KINDS, first_names, names_of, photographs_in


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
    masks = {} if masks_folder is None else match_masks(tuple(files), masks_folder)
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
    """Image files among the sources, each once, in natural order; of a folder its visible image files."""
    found: dict[Path, Path] = {}
    for source in sources:
        if not source.exists():
            raise ReconstructionError(
                ErrorCode.NO_PHOTOS, f"There is no file or folder {source}.", "Check the path."
            )
        members = photographs_in(source) if source.is_dir() else [source]
        found.update({path.resolve(): path for path in members})
    if not found:
        places = ", ".join(str(source) for source in sources) or "the list"
        text = f"There are no photographs in {places}."
        raise ReconstructionError(
            ErrorCode.NO_PHOTOS, text, f"Give a folder with photographs: {KINDS} can be read."
        )
    if len(found) == 1:
        text = "There is only one photograph."
        raise ReconstructionError(
            ErrorCode.TOO_FEW_PHOTOS,
            text,
            "Take at least two, or better three or more, from different places.",
        )
    return sorted(found.values(), key=lambda path: (natural_order(path.name), str(path)))


def natural_order(name: str) -> tuple[tuple[int, int, str], ...]:
    """A sorting key by which 2.jpg stands before 10.jpg."""
    parts = re.split(r"([0-9]+)", name.lower())
    return tuple((0, int(part), "") if index % 2 else (1, 0, part) for index, part in enumerate(parts))


def match_masks(names: Sequence[str], masks_folder: Path) -> dict[str, Path]:
    """The mask file of each photograph that has one, by the photograph's name.

    For a.jpg: a.png, a_mask.png, a.jpg.png or a.jpg_mask.png, in any image format and letter case.
    """
    if not masks_folder.is_dir():
        text = f"There is no folder {masks_folder} with masks."
        raise ReconstructionError(ErrorCode.MASK_UNUSABLE, text, "Check the path.")
    by_stem = {path.stem.lower(): path for path in sorted(photographs_in(masks_folder))}
    matched = {}
    for name in names:
        base = Path(name)
        stems = [base.stem, f"{base.stem}_mask", base.name, f"{base.name}_mask"]
        masks = [by_stem[stem.lower()] for stem in stems if stem.lower() in by_stem]
        if masks:
            matched[name] = masks[0]
    if not matched:
        text = f"No mask in {masks_folder} is named like a photograph."
        remedy = f"Name the mask of {names[0]} {Path(names[0]).stem}.png."
        raise ReconstructionError(ErrorCode.MASK_UNUSABLE, text, remedy)
    return matched


def without_masks_text(names: Sequence[str]) -> str:
    """What to say of photographs without masks where others have some."""
    return (
        f"There is no mask for {first_names(names)}: their background may stay in the mesh. "
        f"Name the mask of {names[0]} {Path(names[0]).stem}.png."
    )


def _load_photo(path: Path, name: str, mask_path: Path | None, config: PhotosConfig) -> Photo:
    decoded = read_image(path, config.max_side_px)
    height, width = decoded.image_srgb.shape[:2]
    if mask_path is None:
        mask = decoded.mask if decoded.mask is None or is_outline(decoded.mask) else None
    else:
        mask = _load_mask(mask_path, name, width, height)
    if mask is not None and mask.max() == 0:
        text = f"The mask of {name} is empty: it leaves nothing of the photograph."
        raise ReconstructionError(ErrorCode.MASK_UNUSABLE, text, "Make the subject white and the rest black.")
    return Photo(
        name=name,
        path=path,
        image_srgb=decoded.image_srgb,
        mask=mask,
        original_width=decoded.original_width,
        original_height=decoded.original_height,
        focal_px=decoded.focal_px,
    )


def is_outline(alpha: Float32[np.ndarray, "height width"]) -> bool:
    """Whether an alpha channel cuts out a subject.

    One that is opaque along most of a frame just inside the picture only marks pixels that hold nothing,
    as undistortion and stitching leave them at the edges.
    """
    height, width = alpha.shape
    inset = max(1, round(0.04 * min(height, width)))
    inner = alpha[inset : height - inset, inset : width - inset] > 0.5
    if min(inner.shape, default=0) < 2:
        return True
    frame = np.concatenate([inner[0], inner[-1], inner[:, 0], inner[:, -1]])
    return bool(frame.mean() < 0.5)


def _load_mask(path: Path, photo_name: str, width: int, height: int) -> Float32[np.ndarray, "height width"]:
    """The mask in a file, scaled to the size of its photograph and to values from 0 to 1."""
    try:
        decoded = read_image(path)
    except ReconstructionError as error:
        raise ReconstructionError(ErrorCode.MASK_UNUSABLE, error.text, error.remedy) from error
    if not same_shape(decoded.original_width, decoded.original_height, width, height):
        size = f"{decoded.original_width}x{decoded.original_height}"
        text = f"The mask {path.name} ({size}) has another shape than {photo_name} ({width}x{height})."
        raise ReconstructionError(
            ErrorCode.MASK_UNUSABLE, text, "Make masks from the photographs as they are."
        )
    return resized(_mask_values(decoded), width, height)


def _mask_values(decoded: DecodedImage) -> Float32[np.ndarray, "height width"]:
    """The alpha channel, or else the brightness; 1 where it is largest: some tools write 1 of 255."""
    values = decoded.image_srgb.mean(axis=2) if decoded.mask is None else decoded.mask
    largest = float(values.max())
    return values if largest == 0 else (values / largest).astype(np.float32)
