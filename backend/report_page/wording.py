"""Numbers as the report's readers say them."""

import math
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

UNKNOWN = "–"

STAGE_TEXTS = MappingProxyType(
    {
        "photos": "Reading the photographs",
        "cameras": "Finding where each was taken",
        "cutout": "Cutting out the subject",
        "region": "Finding the subject",
        "stereo": "Measuring points",
        "train": "Fitting the surface",
        "mesh": "Making the mesh",
        "report": "This report",
    }
)


def stage_text(name: str) -> str:
    """What a stage does; its own name where it is not known here."""
    return STAGE_TEXTS.get(name, name)


def duration_text(seconds: float) -> str:
    """Seconds as people say them."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes_left = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes_left:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


def memory_text(num_bytes: int | None) -> str:
    """Bytes in MB or GB, decimal; a dash where unknown."""
    if num_bytes is None:
        return UNKNOWN
    return f"{num_bytes / 1e9:.1f} GB" if num_bytes >= 1e9 else f"{num_bytes / 1e6:.0f} MB"


def percent_text(share: float) -> str:
    """A share in percent; what is there is never told as 0 %, what is missing never as 100 %."""
    if 0 < share < 0.005:
        return "< 1 %"
    if 0.995 <= share < 1:
        return "> 99 %"
    return f"{share * 100:.0f} %"


def hundred_text(share: float) -> str:
    """A share as so many of 100; all and none are said of nothing less."""
    count = round(share * 100)
    return f"{min(max(count, 1), 99) if 0 < share < 1 else count} of 100"


def decibel_text(psnr_db: float | None) -> str:
    """A PSNR; a dash where nothing could be compared."""
    if psnr_db is None:
        return UNKNOWN
    return f"{psnr_db:.1f} dB" if math.isfinite(psnr_db) else "identical"


def count_text(count: int, one: str, many: str = "") -> str:
    """A count with its thing, in the plural unless it is one; the plural is `one` with an s by default."""
    return f"{count:,} {one if count == 1 else many or one + 's'}"


def css_gradient(stops_srgb: Float[np.ndarray, "stops 3"]) -> str:
    """A CSS background that runs from the first colour to the last."""
    colours = ", ".join(f"rgb({r:.0f} {g:.0f} {b:.0f})" for r, g, b in stops_srgb * 255)
    return f"linear-gradient(to right, {colours})"
