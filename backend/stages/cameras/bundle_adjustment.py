"""Bundle adjustment as this project asks pycolmap for it."""

import PIL.Image  # noqa: F401 - pycolmap loaded before Pillow corrupts memory when Pillow next saves
import pycolmap


def adjust_bundle(
    model: pycolmap.Reconstruction, *, free_lens: bool, free_focal: bool = False, robust_scale_px: float
) -> pycolmap.CeresBundleAdjuster:
    """Move the model's cameras and points to where they reproject best, and with `free_lens` its lenses.

    With `free_focal` of the lenses the focal lengths alone. Errors count by a Cauchy loss of the given scale.
    """
    adjuster = bundle_adjuster(
        model, free_lens=free_lens, free_focal=free_focal, robust_scale_px=robust_scale_px
    )
    adjuster.solve()
    return adjuster


def bundle_adjuster(
    model: pycolmap.Reconstruction,
    *,
    free_lens: bool,
    free_focal: bool = False,
    robust_scale_px: float | None,
) -> pycolmap.CeresBundleAdjuster:
    """The adjustment, not yet done: of all placed photographs, the first two of which hold frame and scale.

    Without a robust scale errors count by their squares.
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = free_lens or free_focal
    options.refine_principal_point = options.refine_extra_params = free_lens
    if robust_scale_px is not None:
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = robust_scale_px
    options.ceres.solver_options.function_tolerance = 1e-6
    # One thread: sums in another order would be another result.
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    return pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
