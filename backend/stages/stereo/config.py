"""How hard stereo looks."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class StereoConfig:
    """How hard to look."""

    num_sources: int = 3
    """Photographs that each one is compared with, at most."""
    first_pixel_size: int = 1
    """1 to compare photographs at full size, 2 at half, 4 at a quarter: a quarter of the time each."""
    coarse_pixels: int = 50_000
    """Pixels of the window in which all depths are tried."""
    num_planes: int = 192
    """Depths tried there, at most."""
    semi_global: bool = True
    """Whether depth is made smooth there; else each pixel chooses for itself."""
    sweep_again: bool = True
    """Whether all depths are tried again, at the first size, where nothing was measured so far."""
    lean: float = 0.7
    """Of planes that are tried where nothing was measured, to each of four sides: pixels that their match
    moves more from a pixel to the next. 0 for none.
    """
    patch_radius: int = 3
    """Half width of the patches, in pixels of the size at hand."""
    min_correlation: float = 0.3
    """Patches that agree less than this are not measurements."""
    full_sharpness: float = 0.03
    """Patches whose agreement drops by less than this one pixel off say less about depth."""
    edge_doubt: float = 1.0
    """Distance from an edge, in radii of a patch, at which a patch counts half; more than 0."""
    free_leverage: float | None = None
    """Patches whose texture lies further to one side say less about the depth of their middle; None: no less.

    That pays where photographs are compared at half their size; at full size patches are small beside what
    they show.
    """
    max_reprojection_px: float = 1.0
    """How far a point may move when carried to another photograph's depth map and back."""
    trust_of_half_size: float = 0.8
    """Share of its confidence that is left to what only photographs of half the size show.

    Where little is textured the fit weighs points by the cube of it: half.
    """
    trust_if_textured: float = 0.63
    """The same where the first size has texture, and yet showed nothing."""
    max_points: int = 500_000
    """Points kept, evenly over all that are measured; depth maps keep every pixel."""
    growth_rounds: tuple[int, int, int] = (2, 4, 4)
    """How often maps grow from what is measured, at the first size, at half of it, and at any smaller one."""
    growth_reach_px: int = 5
    """How far at a time, in pixels of the size at hand."""
    growth_correlation: float = 0.5
    """Patches must agree this well to be grown from: what is hardly measured is not passed on."""
    min_piece_px: int = 300
    """Pixels of a connected piece of measured surface, at least; six patches side by side."""
    without_ground: bool = False
    """Whether the flat ground that the subject stands on is left out of what was measured."""
    noise: float = 1.2 / 255
    """Standard deviation of sensor and coding noise in a flat patch of a well exposed photograph."""
