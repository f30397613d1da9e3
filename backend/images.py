"""Image files as arrays: upright, scaled to [0, 1], with what the file knows about the lens.

Arrays are [row, column, channel]; values are encoded as sRGB.
"""

import io
import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import tifffile
from jaxtyping import Float, Float32, Shaped
from PIL import ExifTags, Image, ImageCms, UnidentifiedImageError
from pillow_heif import register_heif_opener
from scipy.sparse import csr_array

from .errors import ErrorCode, ReconstructionError

FULL_FRAME_DIAGONAL_MM = math.hypot(36.0, 24.0)
"""A 35 mm equivalent is taken by the diagonal of the picture, as CIPA asks makers to do. Where the picture
has the 3:2 shape of the film this is the same as by the width, and upright or not makes no difference."""

_MILLIMETRES_PER_RESOLUTION_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
"""EXIF FocalPlaneResolutionUnit: inch, centimetre, millimetre, micrometre."""

_SHORTEST_FOCAL_RATIO = 0.1
"""Of the longer side, which then spans 157 degrees. With less, as of 1 mm, no photograph is placed."""

_STRIP_ROWS = 256
"""Rows of output made at a time, so that a large photograph is never held as floats at full size."""

_LARGEST_PIXELS = 500_000_000
"""Of a photograph: a phone's largest have 200 million, shifted sensors' 400."""
Image.MAX_IMAGE_PIXELS = _LARGEST_PIXELS // 2  # Pillow refuses from twice as many on

_UNREADABLE = (OSError, SyntaxError, ValueError, EOFError, IndexError)
"""What Pillow and tifffile raise for damaged files (UnidentifiedImageError is an OSError)."""


@dataclass(frozen=True, kw_only=True)
class DecodedImage:
    """An image file, upright."""

    image_srgb: Float32[np.ndarray, "height width 3"]
    mask: Float32[np.ndarray, "height width"] | None
    """The alpha channel; None where there is none or it is opaque everywhere."""
    original_width: int
    """Upright, before scaling down, in pixels."""
    original_height: int
    focal_px: float | None
    """From EXIF, in pixels of the original size; None where there is none."""
    exif_orientation: int
    """1 to 8: how the file's own pixels had to be turned; 1 where they stand upright."""


def read_image(path: Path, max_side_px: int | None = None) -> DecodedImage:
    """The photograph in a file, upright, its longer side at most max_side_px.

    JPEG, HEIC, PNG, TIFF, WebP and BMP; grey, grey with alpha, palette, RGB, RGBA and CMYK; 8 and 16 bits
    a channel (of colour PNG with 16 bits the upper 8 are used). A colour profile is applied, as phones'
    Display P3, but to grey and to TIFF of 16 bits.
    Raises ReconstructionError(PHOTO_UNREADABLE).
    """
    stored, focal_px, exif_orientation = _decoded(path)
    stored = upright(stored, exif_orientation)
    height, width = stored.shape[:2]
    small_width, small_height = fitted_size(width, height, max_side_px)
    pixels = resized(stored, small_width, small_height)
    pixels /= _largest_value(stored.dtype)
    if np.issubdtype(stored.dtype, np.floating) and np.median(pixels) > 1.0:
        text = f"Most of {path.name} is brighter than white: its values are floating point numbers beyond 1."
        raise ReconstructionError(ErrorCode.PHOTO_UNREADABLE, text, "Save it with 8 or 16 bits a colour.")
    np.clip(pixels, 0.0, 1.0, out=pixels)
    return DecodedImage(
        image_srgb=_three_channels(pixels),
        mask=_mask_from_alpha(pixels),
        original_width=width,
        original_height=height,
        focal_px=focal_px,
        exif_orientation=exif_orientation,
    )


def fitted_size(width: int, height: int, max_side_px: int | None) -> tuple[int, int]:
    """Width and height scaled down, in proportion, until the longer is at most max_side_px."""
    if max_side_px is None or max(width, height) <= max_side_px:
        return width, height
    scale = max_side_px / max(width, height)
    return max(1, round(width * scale)), max(1, round(height * scale))


def same_shape(width: int, height: int, other_width: int, other_height: int) -> bool:
    """Whether one size is the other scaled, up to the rounding to whole pixels."""
    excess = abs(width * other_height - height * other_width)
    return excess <= max(width, height, other_width, other_height)


def resized(
    image: Shaped[np.ndarray, "height width *channels"], width: int, height: int
) -> Float32[np.ndarray, "new_height new_width *channels"]:
    """The image at another size, in the same units: the mean over each new pixel's area where it shrinks,
    linear interpolation where it grows. The borders of the picture stay where they are.
    """
    old_height, old_width = image.shape[:2]
    by_row = _resampling_weights(old_height, height)
    by_column = _resampling_weights(old_width, width)
    result = np.zeros((height, width, *image.shape[2:]), np.float32)
    for rows, sources in _strips(by_row):
        strip = image[sources].astype(np.float32)
        shrunk = by_row[rows, sources] @ strip.reshape(len(strip), -1)
        columns_first = np.swapaxes(shrunk.reshape(len(shrunk), old_width, -1), 0, 1)
        across = by_column @ columns_first.reshape(old_width, -1)
        strip_shape = (width, len(shrunk), *image.shape[2:])
        result[rows] = np.swapaxes(across.reshape(strip_shape), 0, 1)
    return result


def upright(
    image: Shaped[np.ndarray, "height width *channels"], exif_orientation: int
) -> Shaped[np.ndarray, "new_height new_width *channels"]:
    """The image turned and mirrored as its EXIF orientation (1 to 8) asks."""
    if exif_orientation in (5, 6, 7, 8):
        image = np.swapaxes(image, 0, 1)
    if exif_orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    if exif_orientation in (3, 4, 7, 8):
        image = image[::-1]
    return image


def focal_px_or_none(exif: Image.Exif, width: int, height: int) -> float | None:
    """Focal length in pixels of an image of this size, from EXIF.

    The 35 mm equivalent counts first: it belongs to the picture as it was saved. Otherwise the focal length
    and the density of the sensor's pixels, which are given for the size at which the camera saved. None where
    there are none, or no lens is so short.
    """
    focal_px = _told_focal_px_or_none(exif, width, height)
    too_short = focal_px is not None and focal_px < _SHORTEST_FOCAL_RATIO * max(width, height)
    return None if too_short else focal_px


def _told_focal_px_or_none(exif: Image.Exif, width: int, height: int) -> float | None:
    details = exif.get_ifd(ExifTags.IFD.Exif)
    equivalent_mm = _positive_or_none(details.get(ExifTags.Base.FocalLengthIn35mmFilm))
    if equivalent_mm is not None:
        return equivalent_mm / FULL_FRAME_DIAGONAL_MM * math.hypot(width, height)
    focal_mm = _positive_or_none(details.get(ExifTags.Base.FocalLength))
    density = _positive_or_none(details.get(ExifTags.Base.FocalPlaneXResolution))
    # The standard's default unit is the inch.
    unit_mm = _MILLIMETRES_PER_RESOLUTION_UNIT.get(details.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    if focal_mm is None or density is None or unit_mm is None:
        return None
    saved_sides = (
        _positive_or_none(details.get(ExifTags.Base.ExifImageWidth)),
        _positive_or_none(details.get(ExifTags.Base.ExifImageHeight)),
    )
    saved_longer_px = max((side for side in saved_sides if side is not None), default=max(width, height))
    return focal_mm / unit_mm * density * max(width, height) / saved_longer_px


def _decoded(path: Path) -> tuple[Shaped[np.ndarray, "height width *channels"], float | None, int]:
    """Pixels as stored, the focal length in pixels, and the EXIF orientation."""
    try:
        register_heif_opener()  # Pillow has none of its own
        # Pillow warns of large and of damaged files; what it cannot read it raises as well.
        with warnings.catch_warnings(action="ignore"), Image.open(path) as file:
            exif = file.getexif()
            focal_px = focal_px_or_none(exif, *file.size)
            deep = _deep_colour_or_none(path) if file.format == "TIFF" else None
            pixels = np.asarray(_in_srgb(file)) if deep is None else deep
            orientation = exif.get(ExifTags.Base.Orientation, 1)
            return pixels, focal_px, orientation if orientation in range(1, 9) else 1
    except UnidentifiedImageError as error:
        deep = _deep_colour_or_none(path)
        if deep is None:
            _refuse(path, error)
        return deep, None, 1
    except Image.DecompressionBombError as error:
        text = f"{path.name} is too large: more than {_LARGEST_PIXELS // 1_000_000} million pixels."
        remedy = "Save it smaller, or leave it out."
        raise ReconstructionError(ErrorCode.PHOTO_UNREADABLE, text, remedy) from error
    except _UNREADABLE as error:
        _refuse(path, error)


def _deep_colour_or_none(path: Path) -> Shaped[np.ndarray, "height width channels"] | None:
    """Pixels of a TIFF with more than 8 bits a colour, which Pillow cuts to 8 or does not know.

    None where it is none such, as of inks, or compressed in a way that only Pillow can undo.
    """
    try:
        with tifffile.TiffFile(path) as file:
            page = file.pages.first
            if page.bitspersample <= 8 or page.photometric != tifffile.PHOTOMETRIC.RGB:
                return None
            pixels = np.asarray(page.asarray())
    except (ValueError, tifffile.TiffFileError):
        return None
    return np.moveaxis(pixels, 0, -1) if page.planarconfig == tifffile.PLANARCONFIG.SEPARATE else pixels


def _in_srgb(file: Image.Image) -> Image.Image:
    """The image in a plain mode, its colours taken from the file's own profile to sRGB where it has one."""
    plain = _plain_mode(file)
    coloured = file if file.mode == "CMYK" else plain
    profile = file.info.get("icc_profile")
    if not profile or coloured.mode not in ("RGB", "RGBA", "CMYK"):
        return plain
    try:
        own, srgb = ImageCms.ImageCmsProfile(io.BytesIO(profile)), ImageCms.createProfile("sRGB")
        return ImageCms.profileToProfile(coloured, own, srgb, outputMode=plain.mode) or plain
    except (OSError, ImageCms.PyCMSError):
        return plain  # a damaged profile, or one of other colours than the file's


def _plain_mode(file: Image.Image) -> Image.Image:
    """The image as grey, RGB or RGBA, keeping 16-bit grey as it is."""
    if file.mode.startswith(("I", "F")):
        # "I" holds 16-bit grey in 32 bits.
        return file.convert("I;16") if file.mode == "I" else file
    if file.mode == "1":
        return file.convert("L")
    if file.mode in ("L", "RGB", "RGBA"):
        has_transparent_colour = "transparency" in file.info
        return file.convert("RGBA") if has_transparent_colour else file
    has_alpha = file.mode in ("LA", "La", "PA", "RGBa") or "transparency" in file.info
    return file.convert("RGBA" if has_alpha else "RGB")


def _refuse(path: Path, error: Exception) -> NoReturn:
    if not path.exists():
        text, remedy = f"There is no file {path}.", "Check the path."
    else:
        text = f"{path.name} cannot be read: it is damaged, cut short or no picture ({error})."
        remedy = "Copy it again from the camera, or leave it out."
    raise ReconstructionError(ErrorCode.PHOTO_UNREADABLE, text, remedy) from error


def _largest_value(dtype: np.dtype[Any]) -> float:
    return float(np.iinfo(dtype).max) if np.issubdtype(dtype, np.integer) else 1.0


def _three_channels(
    pixels: Float[np.ndarray, "height width *channels"],
) -> Float32[np.ndarray, "height width 3"]:
    if pixels.ndim == 2 or pixels.shape[2] < 3:
        grey = pixels if pixels.ndim == 2 else pixels[..., 0]
        return np.repeat(grey[..., None], 3, axis=2)
    return np.ascontiguousarray(pixels[..., :3])


def _mask_from_alpha(
    pixels: Float[np.ndarray, "height width *channels"],
) -> Float32[np.ndarray, "height width"] | None:
    if pixels.ndim == 2 or pixels.shape[2] not in (2, 4):
        return None
    alpha = np.ascontiguousarray(pixels[..., -1])
    return None if alpha.min() == 1.0 else alpha


def _positive_or_none(value: Any) -> float | None:
    """EXIF numbers may be missing, zero over zero, or text."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def _resampling_weights(num_old: int, num_new: int) -> Any:
    """Sparse (num_new, num_old) matrix, float32, whose rows sum to 1."""
    scale = num_old / num_new
    if scale >= 1:
        edges = np.arange(num_new + 1) * scale
        reach = math.ceil(scale) + 1
        first = np.floor(edges[:-1]).astype(np.int64)
        sources = first[:, None] + np.arange(reach)
        low = np.maximum(sources, edges[:-1, None])
        high = np.minimum(sources + 1, edges[1:, None])
        weights = np.maximum(high - low, 0.0) / scale
    else:
        centres = np.clip((np.arange(num_new) + 0.5) * scale - 0.5, 0, num_old - 1)
        first = np.floor(centres).astype(np.int64)
        sources = first[:, None] + np.arange(2)
        weights = np.stack([1 - (centres - first), centres - first], axis=1)
    rows = np.broadcast_to(np.arange(num_new)[:, None], sources.shape)
    columns = np.minimum(sources, num_old - 1)
    return csr_array(
        (weights.ravel().astype(np.float32), (rows.ravel(), columns.ravel())), shape=(num_new, num_old)
    )


def _strips(by_row: Any) -> Iterator[tuple[slice, slice]]:
    """Slices of output rows, each with the input rows it needs."""
    for start in range(0, by_row.shape[0], _STRIP_ROWS):
        rows = slice(start, min(start + _STRIP_ROWS, by_row.shape[0]))
        needed = by_row[rows].indices
        yield rows, slice(int(needed.min()), int(needed.max()) + 1)
