"""Pinhole cameras in pixels, and the same as Blender's lens settings; no Blender needed.

A pixel of the picture is `aspect_x` wide and `aspect_y` high. Blender measures lens, sensor and shift
against one side of the picture, `reach` pixels long counted in pixel widths: its width, or its height times
aspect_y / aspect_x. With that (`BKE_camera_params_compute_viewplane` is where Blender does it)

    fx = lens / sensor * reach               cx = width / 2 - shift_x * reach
    fy = fx * aspect_x / aspect_y            cy = height / 2 + shift_y * reach * aspect_x / aspect_y
"""

from dataclasses import dataclass

SENSOR_WIDTH_MM = 36.0
SHORTEST_LENS_MM, LONGEST_LENS_MM = 1.0, 5000.0
"""What Blender takes for `Camera.lens`; it silently changes what lies outside."""
SAME_ASPECT = 1e-6
"""Relative difference below which two pixel aspects are one."""


@dataclass(frozen=True, kw_only=True)
class Pinhole:
    """A camera without distortion; the centre of the top left pixel is (0.5, 0.5)."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    width: int
    height: int

    @property
    def pixel_aspect(self) -> float:
        """Height of a pixel over its width, if the lens itself is round."""
        return self.fx_px / self.fy_px


@dataclass(frozen=True, kw_only=True)
class Raster:
    """The part of Blender's camera that the scene holds: how many pixels, of which shape."""

    width: int
    height: int
    aspect_x: float = 1.0
    aspect_y: float = 1.0

    @property
    def pixel_aspect(self) -> float:
        """Height of a pixel over its width."""
        return self.aspect_y / self.aspect_x


@dataclass(frozen=True, kw_only=True)
class LensSettings:
    """The part of Blender's camera that the camera holds."""

    lens_mm: float
    sensor_fit: str = "HORIZONTAL"
    sensor_width_mm: float = SENSOR_WIDTH_MM
    sensor_height_mm: float = 24.0
    shift_x: float = 0.0
    shift_y: float = 0.0


def rendered_size(resolution_x: int, resolution_y: int, percentage: int) -> tuple[int, int]:
    """Width and height of what Blender renders: it cuts off fractions of a pixel."""
    return resolution_x * percentage // 100, resolution_y * percentage // 100


def pinhole_from_settings(lens: LensSettings, raster: Raster) -> Pinhole:
    """The pinhole that Blender renders with. Raises ValueError where it would render nothing."""
    if min(raster.width, raster.height) < 1:
        raise ValueError(f"a picture of {raster.width} x {raster.height} pixels is empty")
    aspect = raster.pixel_aspect
    horizontal = _fits_width(lens, raster)
    # Blender takes the sensor's width for AUTO even where the picture is higher than wide.
    sensor_mm = lens.sensor_height_mm if lens.sensor_fit == "VERTICAL" else lens.sensor_width_mm
    reach = raster.width if horizontal else raster.height * aspect
    fx_px = lens.lens_mm / sensor_mm * reach
    return Pinhole(
        fx_px=fx_px,
        fy_px=fx_px / aspect,
        cx_px=raster.width / 2 - lens.shift_x * reach,
        cy_px=raster.height / 2 + lens.shift_y * reach / aspect,
        width=raster.width,
        height=raster.height,
    )


def settings_from_pinhole(pinhole: Pinhole, *, pixel_aspect: float | None = None) -> LensSettings:
    """Blender's settings for the pinhole, always with the sensor fitted to the width.

    They are exact in a scene with the pinhole's own pixel aspect; give `pixel_aspect` for another scene, in
    which width, fx and the principal point are right and fy is what that scene makes of it.
    Raises ValueError for lenses that Blender does not have.
    """
    aspect = pinhole.pixel_aspect if pixel_aspect is None else pixel_aspect
    lens_mm = pinhole.fx_px * SENSOR_WIDTH_MM / pinhole.width
    if not SHORTEST_LENS_MM <= lens_mm <= LONGEST_LENS_MM:
        raise ValueError(
            f"a focal length of {pinhole.fx_px:g} pixels in a picture {pinhole.width} wide is not one that "
            "Blender has"
        )
    return LensSettings(
        lens_mm=lens_mm,
        shift_x=(pinhole.width / 2 - pinhole.cx_px) / pinhole.width,
        shift_y=(pinhole.cy_px - pinhole.height / 2) * aspect / pinhole.width,
    )


def aspect_pair(pixel_aspect: float) -> tuple[float, float]:
    """Blender's two numbers for a height over width of a pixel: the smaller one is 1."""
    return (1.0, pixel_aspect) if pixel_aspect >= 1.0 else (1.0 / pixel_aspect, 1.0)


def shared_aspect_or_none(pinholes: tuple[Pinhole, ...]) -> float | None:
    """The pixel aspect of all the pinholes; None where they differ, or there are none.

    Estimated focal lengths are alike but for noise of the last digit, which counts as square.
    """
    aspects = [pinhole.pixel_aspect for pinhole in pinholes]
    if not aspects or max(aspects) - min(aspects) > SAME_ASPECT * max(aspects):
        return None
    return 1.0 if abs(aspects[0] - 1.0) <= SAME_ASPECT else aspects[0]


def _fits_width(lens: LensSettings, raster: Raster) -> bool:
    """Whether the sensor is measured along the picture's width."""
    if lens.sensor_fit == "AUTO":
        return raster.aspect_x * raster.width >= raster.aspect_y * raster.height
    return lens.sensor_fit == "HORIZONTAL"
