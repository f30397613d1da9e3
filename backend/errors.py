"""What can go wrong for a user, in words a user understands."""

from enum import StrEnum


class ErrorCode(StrEnum):
    """Stable names of the failures a caller may want to tell apart."""

    NO_PHOTOS = "no_photos"
    TOO_FEW_PHOTOS = "too_few_photos"
    PHOTO_UNREADABLE = "photo_unreadable"
    MASK_UNUSABLE = "mask_unusable"
    NO_OVERLAP = "no_overlap"
    TOO_FEW_PLACED = "too_few_placed"
    NO_PARALLAX = "no_parallax"
    CAMERAS_UNUSABLE = "cameras_unusable"
    NO_SURFACE = "no_surface"
    OUT_OF_MEMORY = "out_of_memory"
    DISK_FULL = "disk_full"
    OUTPUT_UNUSABLE = "output_unusable"
    SETTINGS_INVALID = "settings_invalid"
    TRUTH_UNREADABLE = "truth_unreadable"
    NETWORK_UNAVAILABLE = "network_unavailable"
    CLOUD_UNUSABLE = "cloud_unusable"
    MISSING_DEPENDENCY = "missing_dependency"
    DEVICE_UNAVAILABLE = "device_unavailable"
    INTERNAL = "internal"


class ReconstructionError(Exception):
    """A failure the user can do something about: a sentence of what happened and a remedy."""

    def __init__(self, code: ErrorCode, text: str, remedy: str) -> None:
        super().__init__(f"{text} {remedy}")
        self.code = code
        self.text = text
        self.remedy = remedy


class Cancelled(Exception):  # noqa: N818 - it is a request, not an error
    """Raised by a progress callback when the user asked to stop."""
