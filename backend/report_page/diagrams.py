"""Diagrams of the cameras' page as SVG, coloured by the page's style sheet: they suit light and dark."""

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from markupsafe import Markup
from PIL import Image

from ..images import resized
from ..maths.projection import up_of
from ..scene import Region, View

_THUMBNAIL_PX = 96
_GRAPH_WIDTH, _GRAPH_HEIGHT = 720, 640
_MAP_WIDTH, _MAP_HEIGHT = 720, 560
_BARS_WIDTH, _BARS_HEIGHT = 480, 240
_MOST_POINTS = 2500
"""Drawn; more make the page large and the map no clearer."""
_LARGEST_HALO = 34.0
_MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000)
_NAME_LENGTH = 16


@dataclass(frozen=True)
class Bar:
    """One of a histogram."""

    label: str
    count: int
    kind: str
    """A class of the style sheet: guessed, weak or measured."""


@dataclass(frozen=True, kw_only=True)
class TopView:
    """The map, and by how much its halos are too large."""

    svg: Markup
    magnification: int | None
    """None where there are no halos."""


def thumbnail(image_srgb: Float32[np.ndarray, "height width 3"]) -> str:
    """The middle square of a photograph, small, as an address that holds it."""
    height, width = image_srgb.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    square = resized(image_srgb[top : top + side, left : left + side], _THUMBNAIL_PX, _THUMBNAIL_PX)
    file = io.BytesIO()
    Image.fromarray(np.round(square.clip(0, 1) * 255).astype(np.uint8)).save(file, "JPEG", quality=80)
    return "data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode("ascii")


def match_graph(
    photos: Sequence[tuple[str, str | None]], pairs: Sequence[tuple[int, int, int, str]]
) -> Markup:
    """Photographs (name, picture or None) on a circle, joined where they share (one, other, count, kind)."""
    count = len(photos)
    reach = _GRAPH_HEIGHT / 2 - 64
    radius = float(min(0.38 * 2 * np.pi * reach / max(count, 1), 42))
    angles = 2 * np.pi * (np.arange(count) + 0.5) / max(count, 1)
    middle = np.array([_GRAPH_WIDTH / 2, _GRAPH_HEIGHT / 2 - 8])
    places = middle + np.stack([-np.sin(angles), np.cos(angles)], axis=1) * reach
    most = max((pair[2] for pair in pairs), default=1)
    parts = [_opening(_GRAPH_WIDTH, _GRAPH_HEIGHT, "Which photographs share features")]
    for one, other, number, kind in reversed(pairs):
        told = f"{photos[one][0]} and {photos[other][0]}: {number} verified matches"
        width = 1 + 9 * np.sqrt(number / most)
        line = (
            '<line class="tie {}" x1="{}" y1="{}" x2="{}" y2="{}" stroke-width="{}"><title>{}</title></line>'
        )
        parts.append(Markup(line).format(kind, *_px(*places[one], *places[other], width), told))
    for index, ((name, picture), (x, y)) in enumerate(zip(photos, places, strict=True)):
        parts.append(_photograph(index, name, picture, (float(x), float(y)), radius))
    return Markup("").join([*parts, Markup("</svg>")])


def _photograph(
    index: int, name: str, picture: str | None, place: tuple[float, float], radius: float
) -> Markup:
    x, y = place
    disc = Markup("")
    if picture is not None:
        disc = Markup(
            '<clipPath id="disc{}"><circle cx="{}" cy="{}" r="{}"/></clipPath>'
            '<image href="{}" x="{}" y="{}" width="{}" height="{}" clip-path="url(#disc{})"/>'
        ).format(
            index, *_px(x, y, radius), picture, *_px(x - radius, y - radius, 2 * radius, 2 * radius), index
        )
    return Markup(
        '<g><title>{}</title><circle class="{}" cx="{}" cy="{}" r="{}"/>{}'
        '<circle class="rim" cx="{}" cy="{}" r="{}"/><text class="name" x="{}" y="{}">{}</text></g>'
    ).format(
        name,
        "disc" if picture is not None else "disc lost",
        *_px(x, y, radius),
        disc,
        *_px(x, y, radius, x, y + radius + 15),
        shortened(name),
    )


def histogram(bars: Sequence[Bar], title: str) -> Markup:
    """Counts as columns with their numbers above and their labels below."""
    most = max((bar.count for bar in bars), default=0)
    foot, top = _BARS_HEIGHT - 46.0, 24.0
    step = _BARS_WIDTH / max(len(bars), 1)
    parts = [_opening(_BARS_WIDTH, _BARS_HEIGHT, title)]
    for index, bar in enumerate(bars):
        height = (foot - top) * bar.count / most if most else 0.0
        left, width = index * step + 0.12 * step, 0.76 * step
        middle = index * step + step / 2
        parts.append(
            Markup(
                '<rect class="{}" x="{}" y="{}" width="{}" height="{}" rx="3"/>'
                '<text class="count" x="{}" y="{}">{}</text><text class="tick" x="{}" y="{}">{}</text>'
            ).format(
                bar.kind,
                *_px(left, foot - height, width, height),
                *_px(middle, foot - height - 6),
                f"{bar.count:,}" if bar.count else "",
                *_px(middle, foot + 17),
                bar.label,
            )
        )
    axis = (
        '<line class="axis" x1="0" y1="{0}" x2="{1}" y2="{0}"/><text class="title" x="{2}" y="{3}">{4}</text>'
    )
    parts.append(Markup(axis).format(foot, _BARS_WIDTH, _BARS_WIDTH / 2, _BARS_HEIGHT - 8, title))
    return Markup("").join([*parts, Markup("</svg>")])


def top_view(
    views: Sequence[View],
    points: Float64[np.ndarray, "points 3"],
    colours_srgb: UInt8[np.ndarray, "points 3"],
    region: Region,
    place_covariances: Float64[np.ndarray, "views 3 3"] | None,
) -> TopView:
    """Cameras, points and region from above, the cameras below; halos show how sure the places are."""
    axes = _map_axes(views, region)
    cameras = np.array([view.camera.position for view in views]) @ axes.T
    looks = np.array([view.camera.camera_from_world[2, :3] for view in views]) @ axes.T
    centre, radius = axes @ region.centre_world, region.radius_world
    corners = np.concatenate([cameras, [centre - radius, centre + radius]])
    low, high = corners.min(axis=0), corners.max(axis=0)
    size = np.array([_MAP_WIDTH - 110, _MAP_HEIGHT - 90])
    scale = float((size / np.maximum(high - low, 1e-12 * radius)).min())
    shift = np.array([_MAP_WIDTH, _MAP_HEIGHT]) / 2 - scale * np.array([1, -1]) * (low + high) / 2

    def on_page(flat: Float64[np.ndarray, "*batch 2"]) -> Float64[np.ndarray, "*batch 2"]:
        return np.asarray(shift + scale * flat * np.array([1, -1]))

    parts = [_opening(_MAP_WIDTH, _MAP_HEIGHT, "Cameras and points from above")]
    x, y = on_page(centre)
    parts.append(Markup('<circle class="region" cx="{}" cy="{}" r="{}"/>').format(*_px(x, y, scale * radius)))
    parts.append(_dots(on_page(points @ axes.T), colours_srgb))
    magnification = None
    if place_covariances is not None:
        flat = scale**2 * (axes @ place_covariances @ axes.T)
        magnification = _magnification(float(np.sqrt(np.linalg.eigvalsh(flat)[:, -1].max())))
        parts += [_halo(place, cov, magnification) for place, cov in zip(on_page(cameras), flat, strict=True)]
    for view, place, look in zip(views, on_page(cameras), looks, strict=True):
        parts.append(_camera(view, place, look))
    return TopView(svg=Markup("").join([*parts, Markup("</svg>")]), magnification=magnification)


def _map_axes(views: Sequence[View], region: Region) -> Float64[np.ndarray, "2 3"]:
    """Right and up on the page: seen from above, with the cameras' mean place below the subject."""
    up = up_of([view.camera for view in views])
    towards = np.mean([view.camera.position for view in views], axis=0) - region.centre_world
    level = towards - towards @ up * up
    if np.linalg.norm(level) < 1e-6 * region.radius_world:  # cameras all around
        level = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    away = -level / np.linalg.norm(level)
    return np.stack([np.cross(away, up), away])


def _dots(places: Float64[np.ndarray, "points 2"], colours_srgb: UInt8[np.ndarray, "points 3"]) -> Markup:
    inside = ((places > 0) & (places < (_MAP_WIDTH, _MAP_HEIGHT))).all(axis=1)
    rows = np.flatnonzero(inside)
    rows = rows[:: max(1, -(-len(rows) // _MOST_POINTS))]
    dots = "".join(
        f'<circle cx="{x:.0f}" cy="{y:.0f}" r="1.7" fill="#{r:02x}{g:02x}{b:02x}"/>'
        for (x, y), (r, g, b) in zip(places[rows], colours_srgb[rows], strict=True)
    )
    return Markup(f"<g>{dots}</g>")


def _camera(view: View, place: Float64[np.ndarray, "2"], look: Float64[np.ndarray, "2"]) -> Markup:
    """A wedge that opens as the picture does, as long on the page as the camera looks level."""
    half = view.camera.width / 2 / view.camera.fx_px
    ahead = 30 * look * np.array([1, -1])
    across = min(half, 1.5) * 30 * np.array([look[1], look[0]]) / max(float(np.linalg.norm(look)), 1e-3)
    left, right = place + ahead - across, place + ahead + across
    label = place - 22 * look * np.array([1, -1]) / max(float(np.linalg.norm(look)), 1e-3)
    return Markup(
        '<g><title>{}</title><path class="camera" d="M{} {}L{} {}L{} {}Z"/>'
        '<circle class="eye" cx="{}" cy="{}" r="4"/><text class="name" x="{}" y="{}">{}</text></g>'
    ).format(view.name, *_px(*place, *left, *right, *place, label[0], label[1] + 4), shortened(view.name))


def _magnification(largest_px: float) -> int:
    """The largest round number that leaves the largest halo on the page."""
    fitting = [number for number in _MAGNIFICATIONS if number * largest_px <= _LARGEST_HALO]
    return fitting[-1] if fitting else 1


def _halo(
    place: Float64[np.ndarray, "2"], covariance: Float64[np.ndarray, "2 2"], magnification: int
) -> Markup:
    """One standard deviation, enlarged."""
    values, vectors = np.linalg.eigh(covariance)
    minor, major = magnification * np.sqrt(np.maximum(values, 0.0))
    turn_deg = -np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    x, y = place
    return Markup('<ellipse class="halo" rx="{}" ry="{}" transform="translate({} {}) rotate({})"/>').format(
        *_px(major, minor, x, y, turn_deg)
    )


def shortened(name: str) -> str:
    """A file name that fits under a picture: without its ending, its end where it is long."""
    stem = name.rpartition(".")[0] or name
    return stem if len(stem) <= _NAME_LENGTH else "…" + stem[1 - _NAME_LENGTH :]


def _opening(width: int, height: int, title: str) -> Markup:
    return Markup('<svg viewBox="0 0 {} {}" role="img" aria-label="{}">').format(width, height, title)


def _px(*lengths: float) -> tuple[str, ...]:
    """To a tenth of a pixel."""
    return tuple(f"{length:.1f}" for length in lengths)
