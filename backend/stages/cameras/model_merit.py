"""Which of two models of the same photographs is the better one."""

import PIL.Image  # noqa: F401 - pycolmap loaded before Pillow corrupts memory when Pillow next saves
import pycolmap

from .confirmation import num_confirming
from .lenses import sparse_points

_CONFIRMED_ERROR_PX = 1.0
_CLEARLY_MORE = 1.05


def merit(model: pycolmap.Reconstruction) -> tuple[int, int, int]:
    """More photographs first, then points that three of them confirm to a pixel, then points."""
    num_confirmed = sum(
        point.track.length() >= 3 and point.error < _CONFIRMED_ERROR_PX for point in model.points3D.values()
    )
    return model.num_reg_images(), num_confirmed, model.num_points3D()


def is_clearly_better(model: pycolmap.Reconstruction, than: pycolmap.Reconstruction | None) -> bool:
    """Whether by more than chance; than None every model is."""
    if than is None:
        return True
    (placed, confirmed, _), (placed_than, confirmed_than, _) = merit(model), merit(than)
    # Points of two photographs alone decide nothing: they follow any focal length.
    return placed > placed_than or (placed == placed_than and confirmed > _CLEARLY_MORE * confirmed_than)


def fewest_confirming(model: pycolmap.Reconstruction) -> int:
    """Points that three photographs see, of the photograph with the fewest."""
    _, visibility = sparse_points(model, list(model.reg_image_ids()))
    return int(num_confirming(visibility).min())
