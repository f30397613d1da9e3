"""Cameras that suit the outlines of their subject, and the features that photographs share."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from .lines import nearest_to_lines
from .outline_agreement import Lines, incoherences, tangencies
from .posed_views import POSE, PosedViews
from .silhouette import Silhouette

_STAGES = ((4.0, 3.0), (1.0, 2.0), (0.25, 0.5))
"""Pixels within which outlines and features agree, one after the other: cameras that are far off have to come
near before what is exact can be asked of them."""
_STEPS = 40
_DAMPINGS = 8
_SETTLED = 1e-4
"""Share of the cost by which a step has to lower it for a further one."""
_RAY_WEIGHT = 0.3
"""Of a ray through an outline beside a tangent plane: neighbouring rays say nearly the same."""
_REACH = 1.5
"""Of the subject's half width across the views: how far before and behind its middle rays are asked."""
_HELD = 1e-8
"""How weakly steps are held: frame and scale of the world are told by nothing."""


@dataclass(frozen=True, kw_only=True)
class Features:
    """Places that photographs share, and where these show them."""

    view: Int64[np.ndarray, "sightings"]
    pixels: Float64[np.ndarray, "sightings 2"]
    place: Int64[np.ndarray, "sightings"]
    """Number of the place, from 0 on; each is seen by two views or more."""

    @property
    def num_places(self) -> int:
        """How many there are."""
        return int(self.place.max(initial=-1)) + 1


@dataclass(frozen=True, kw_only=True)
class OutlineFit:
    """Views, and where they see the features."""

    views: PosedViews
    places: Float64[np.ndarray, "places 3"]
    """World frame."""

    def beside_px(self, features: Features) -> Float64[np.ndarray, "sightings 2"]:
        """From where each feature is seen to where its place is shown."""
        shown, _ = self.views.shown(features.view, self.places[features.place])
        return np.asarray(shown - features.pixels)


@dataclass(frozen=True, kw_only=True)
class _Asked:
    """All that is asked of the views."""

    silhouettes: Sequence[Silhouette]
    features: Features
    expected: PosedViews
    """Of these the focal lengths."""
    focal_sigma: Float64[np.ndarray, "views"]
    """To what share of them."""
    outlines_px: float
    features_px: float

    @property
    def focal_weight(self) -> Float64[np.ndarray, "views"]:
        """Of each view's focal length; together those of a lens count as one."""
        sharing = np.bincount(self.expected.lens)[self.expected.lens]
        return np.asarray(1 / (self.focal_sigma**2 * sharing))

    def log_focal(self, views: PosedViews) -> Float64[np.ndarray, "views"]:
        """How far focal lengths are from what is expected, as logarithms."""
        return np.asarray(np.log(views.focal_px / self.expected.focal_px))

    def lines(self, views: PosedViews) -> tuple[Lines, Lines]:
        """Tangent planes, and rays that miss the subject."""
        silhouettes = self.silhouettes
        return tangencies(views, silhouettes), incoherences(views, silhouettes, *_depths(views, silhouettes))

    def cost(self, fit: OutlineFit, lines: tuple[Lines, Lines]) -> float:
        """Half squares where errors are small, logarithms of them where they are large."""
        tangents, rays = (np.log1p((found.beside_px / self.outlines_px) ** 2).sum() for found in lines)
        off2 = (fit.beside_px(self.features) ** 2).sum(axis=1) / self.features_px**2
        focal = (self.focal_weight * self.log_focal(fit.views) ** 2).sum()
        return float(tangents + _RAY_WEIGHT * rays + self.features_px**2 * np.log1p(off2).sum() + focal)


def fit_to_outlines(
    views: PosedViews,
    silhouettes: Sequence[Silhouette],
    features: Features,
    focal_sigma: Float64[np.ndarray, "views"],
    on_step: Callable[[], None] = lambda: None,
) -> OutlineFit:
    """The nearest views in which outlines and most features agree, both by a Cauchy loss.

    Focal lengths are expected where they are, to a share of focal_sigma. Steps are Levenberg's and
    Marquardt's, with lines found anew after each; before one `on_step` is called, which may raise.
    """
    fit = OutlineFit(views=views, places=_places(views, features))
    for outlines_px, features_px in _STAGES:
        asked = _Asked(
            silhouettes=silhouettes,
            features=features,
            expected=views,
            focal_sigma=focal_sigma,
            outlines_px=outlines_px,
            features_px=features_px,
        )
        fit = _descended(asked, fit, on_step)
    return fit


def outlines_miss_px(views: PosedViews, silhouettes: Sequence[Silhouette]) -> float:
    """How far outlines miss each other: the root of the mean square over all rays through them."""
    rays = incoherences(views, silhouettes, *_depths(views, silhouettes))
    num_rays = sum(len(silhouette.outline_px) for silhouette in silhouettes)
    return float(np.sqrt((rays.beside_px**2).sum() / num_rays))


def _descended(asked: _Asked, fit: OutlineFit, on_step: Callable[[], None]) -> OutlineFit:
    damping, lines = 1e-3, asked.lines(fit.views)
    cost = asked.cost(fit, lines)
    for _ in range(_STEPS):
        on_step()
        equations = _Equations.of(asked, fit, lines)
        before = cost
        for _ in range(_DAMPINGS):
            stepped = equations.stepped(fit, damping)
            lines_there = asked.lines(stepped.views)
            if (there := asked.cost(stepped, lines_there)) < cost:
                break
            damping *= 5
        else:
            break
        fit, lines, cost, damping = stepped, lines_there, there, damping / 5
        if before - cost < _SETTLED * before:
            break
    return fit


@dataclass(frozen=True, kw_only=True)
class _Equations:
    """Normal equations of a step; those of places stand apart, for each knows nothing of the others."""

    of_views: Float64[np.ndarray, "unknowns unknowns"]
    right_of_views: Float64[np.ndarray, "unknowns"]
    of_places: Float64[np.ndarray, "places 3 3"]
    right_of_places: Float64[np.ndarray, "places 3"]
    shared: Float64[np.ndarray, "places unknowns 3"]

    @staticmethod
    def of(asked: _Asked, fit: OutlineFit, lines: tuple[Lines, Lines]) -> "_Equations":
        """With each error weighed by what its loss makes of it where it is."""
        views, features = fit.views, asked.features
        unknowns, num_places = views.num_unknowns, features.num_places
        left, right = _HELD * np.eye(unknowns), np.zeros(unknowns)
        for found, weight in zip(lines, (1.0, _RAY_WEIGHT), strict=True):
            change = found.change(views)
            weighed = change * (weight / (asked.outlines_px**2 + found.beside_px**2))[:, None]
            left += weighed.T @ change
            right += weighed.T @ found.beside_px
        focal = POSE * len(views.focal_px) + views.lens
        np.add.at(left, (focal, focal), asked.focal_weight)
        np.add.at(right, focal, asked.focal_weight * asked.log_focal(views))
        beside = fit.beside_px(features)
        by_step, by_place = views.change_of_shown(features.view, fit.places[features.place])
        weight = 1 / (1 + (beside**2).sum(axis=1) / asked.features_px**2)
        left += np.einsum("k,kiu,kiv->uv", weight, by_step, by_step, optimize=True)
        right += np.einsum("k,kiu,ki->u", weight, by_step, beside, optimize=True)
        of_places, right_of_places = np.zeros((num_places, 3, 3)), np.zeros((num_places, 3))
        shared = np.zeros((num_places, unknowns, 3))
        np.add.at(of_places, features.place, np.einsum("k,kia,kib->kab", weight, by_place, by_place))
        np.add.at(right_of_places, features.place, np.einsum("k,kia,ki->ka", weight, by_place, beside))
        np.add.at(shared, features.place, np.einsum("k,kiu,kia->kua", weight, by_step, by_place))
        return _Equations(
            of_views=left,
            right_of_views=right,
            of_places=of_places,
            right_of_places=right_of_places,
            shared=shared,
        )

    def stepped(self, fit: OutlineFit, damping: float) -> OutlineFit:
        """After the step with that damping."""
        diagonal = np.einsum("paa->pa", self.of_places)
        damped = self.of_places + (damping * diagonal + _HELD)[:, :, None] * np.eye(3)
        inverse = np.linalg.inv(damped)
        carried = self.shared @ inverse
        left = self.of_views + damping * np.diag(np.diag(self.of_views))
        left = left - np.einsum("pua,pva->uv", carried, self.shared, optimize=True)
        right = self.right_of_views - np.einsum("pua,pa->u", carried, self.right_of_places)
        step = -np.linalg.solve(left, right)
        of_places = self.right_of_places + np.einsum("pua,u->pa", self.shared, step)
        places = fit.places - np.einsum("pab,pb->pa", inverse, of_places)
        return replace(fit, views=fit.views.moved(step), places=places)


def _places(views: PosedViews, features: Features) -> Float64[np.ndarray, "places 3"]:
    """Nearest to the rays of their sightings."""
    rays = views.directions(features.view, features.pixels)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return nearest_to_lines(views.positions[features.view], rays, features.place)


def _depths(views: PosedViews, silhouettes: Sequence[Silhouette]) -> tuple[float, float]:
    """Nearest and farthest that the subject may be from a camera."""
    axes = views.rotation[:, 2]
    middle = nearest_to_lines(views.positions, axes)
    distance = np.einsum("vi,vi->v", axes, middle - views.positions)
    half_widths = [
        np.linalg.norm(s.hull_px - s.hull_px.mean(axis=0), axis=1).max() * d / f
        for s, d, f in zip(silhouettes, distance, views.focal_px, strict=True)
    ]
    reach = _REACH * float(max(half_widths))
    return max(float(distance.min()) - reach, 0.05 * float(distance.min())), float(distance.max()) + reach
