"""Bundle adjustment as this project asks pycolmap for it."""

import PIL.Image  # noqa: F401 - pycolmap loaded before Pillow corrupts memory when Pillow next saves
import pycolmap


def adjust_bundle(
    model: pycolmap.Reconstruction, *, free_lens: bool, robust_scale_px: float
) -> pycolmap.CeresBundleAdjuster:
    """Move the model's cameras and points to where they reproject best, and with `free_lens` its lenses.

    Errors count by a Cauchy loss of the given scale. The first two cameras hold the frame and its scale.
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = free_lens
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = robust_scale_px
    options.ceres.solver_options.function_tolerance = 1e-6
    # One thread: sums in another order would be another result.
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    adjuster.solve()
    return adjuster
