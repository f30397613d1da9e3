"""Lens parameters weighed between what photographs tell and what is known beforehand.

With few photographs the principal point and the focal length can slide far along a weak direction of the
adjustment; held fixed they bend every camera. So the adjustment runs with all free, its covariance says how
weak each direction is, and Bayes' rule for Gaussians joins it with the prior (one Kalman update). Then
cameras and points are adjusted once more to the lens so found.

Parameters of SIMPLE_RADIAL: focal length, principal point x, y (pixels), radial coefficient.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import PIL.Image  # noqa: F401 - pycolmap loaded before Pillow corrupts memory when Pillow next saves
import pycolmap
from jaxtyping import Float64

from ...scene import Decision
from .bundle_adjustment import adjust_bundle

_ROBUST_SCALE_PX = 0.5
"""Of the Cauchy loss: wrong matches pull the principal point further than anything else."""

_ERROR_INFLATION = 2.0
"""Matches err together, not one by one, so the covariance of independent errors is too small."""

_FOCAL_SIGMA_WITH_EXIF = 0.05
"""Relative. EXIF rounds to millimetres and knows nothing of focusing and of digital zoom."""
_FOCAL_SIGMA_WITHOUT = 0.35
"""Phones' and cameras' usual lenses are 0.7 to 2 longer sides; the guess is 1.2."""
_FOCAL_SIGMA_MAPPED_WELL = 0.05
"""Of what mapping found against EXIF, with the principal points held. Here they are free, and the lenses of
photographs that were cropped one by one would slide together (docs/experiments.md)."""
_CENTRE_SIGMA = 0.01
"""Of the longer side: what lenses and stabilised sensors are off by."""
_RADIAL_SIGMA = 0.1


_SANE_FOCAL_RATIO = (0.1, 10.0)
"""Of the longer side."""
_SANE_RADIAL = 1.0


@dataclass(frozen=True, kw_only=True)
class Gaussian:
    """A belief about parameters."""

    mean: Float64[np.ndarray, "parameters"]
    covariance: Float64[np.ndarray, "parameters parameters"]


def joined(one: Gaussian, other: Gaussian) -> Gaussian:
    """The product of two beliefs that are independent of each other, by information (inverse covariance)."""
    information, other_information = np.linalg.inv(one.covariance), np.linalg.inv(other.covariance)
    covariance = np.linalg.inv(information + other_information)
    mean = covariance @ (information @ one.mean + other_information @ other.mean)
    return Gaussian(mean=mean, covariance=covariance)


def refine_lenses(
    model: pycolmap.Reconstruction, *, mapped_well: Collection[int] = ()
) -> tuple[Decision, ...]:
    """Adjust the model and its SIMPLE_RADIAL lenses in place; say for each lens what was decided.

    A lens with `has_prior_focal_length` is expected to hold that focal length, and one of `mapped_well` (ids)
    what mapping found against EXIF. Two photographs alone say too little: their lenses stay.
    """
    mapped = {camera_id: np.array(camera.params) for camera_id, camera in model.cameras.items()}
    estimates = _estimates(model) if model.num_reg_images() >= 3 else {}
    decisions = []
    for camera_id, camera in sorted(model.cameras.items()):
        before, estimate = mapped[camera_id], estimates.get(camera_id)
        camera.params = before
        if estimate is not None:
            prior = _prior(camera, before[0], mapped_well=camera_id in mapped_well)
            camera.params = joined(estimate, prior).mean
            if camera.has_bogus_params(*_SANE_FOCAL_RATIO, _SANE_RADIAL):
                camera.params, estimate = before, None
        decisions.append(_decision(camera, before[0], estimate))
    adjust_bundle(model, free_lens=False, robust_scale_px=_ROBUST_SCALE_PX)
    model.update_point_3d_errors()
    return tuple(decisions)


def focal_sigma(camera: pycolmap.Camera) -> float:
    """How far off a focal length may be before photographs are asked, as a share of it."""
    return _FOCAL_SIGMA_WITH_EXIF if camera.has_prior_focal_length else _FOCAL_SIGMA_WITHOUT


def _prior(camera: pycolmap.Camera, focal_px: float, *, mapped_well: bool) -> Gaussian:
    """What is believed of a lens before the adjustment."""
    sigma = _FOCAL_SIGMA_MAPPED_WELL if mapped_well else focal_sigma(camera)
    centre_sigma_px = _CENTRE_SIGMA * max(camera.width, camera.height)
    sigmas = [sigma * focal_px, centre_sigma_px, centre_sigma_px, _RADIAL_SIGMA]
    return Gaussian(
        mean=np.array([focal_px, camera.width / 2, camera.height / 2, 0.0]),
        covariance=np.diag(np.square(sigmas)),
    )


def _estimates(model: pycolmap.Reconstruction) -> dict[int, Gaussian]:
    """Adjusts the model with all lens parameters free; what it says of each lens, where it says anything."""
    adjuster = adjust_bundle(model, free_lens=True, robust_scale_px=_ROBUST_SCALE_PX)
    model.update_point_3d_errors()
    error_px = _ERROR_INFLATION * model.compute_mean_reprojection_error()
    covariances = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), model, adjuster)
    if covariances is None:
        return {}
    estimates = {}
    for camera_id, camera in model.cameras.items():
        covariance = covariances.get_other_params_cov(camera.params)
        # A lens whose photographs were not placed is no part of the adjustment.
        if covariance is not None and np.isfinite(covariance).all():
            mean = np.array(camera.params)
            estimates[camera_id] = Gaussian(mean=mean, covariance=np.asarray(covariance) * error_px**2)
    return estimates


def _decision(camera: pycolmap.Camera, before_px: float, estimate: Gaussian | None) -> Decision:
    what = f"focal length of the {camera.width}x{camera.height} photographs"
    source = "EXIF" if camera.has_prior_focal_length else "the first pairs"
    if estimate is None:
        because = "the photographs alone do not determine it"
        return Decision(what=what, choice=f"{before_px:.0f} px, from {source}", because=because)
    sigma_px = float(np.sqrt(estimate.covariance[0, 0]))
    return Decision(
        what=what,
        choice=f"{camera.focal_length:.0f} px, refined ({source}: {before_px:.0f} px)",
        because=f"the photographs determine it to {sigma_px:.1f} px",
    )
