"""Canary: fails when a test run does not enforce the shape annotations."""

import jaxtyping
import numpy as np
import pytest
import torch

from backend.maths.geometry import Pinhole
from backend.maths.losses import taylor_at_point
from backend.maths.volume import log_transmittance
from backend.scene import transform_points


def test_a_missing_axis_is_refused() -> None:
    with pytest.raises(jaxtyping.TypeCheckError):
        log_transmittance(torch.zeros(7), 1.0)


def test_axes_of_one_name_must_agree() -> None:
    with pytest.raises(jaxtyping.TypeCheckError):
        taylor_at_point(torch.zeros(4), torch.zeros(4, 3), torch.zeros(1, 3))


def test_integers_are_no_distances() -> None:
    with pytest.raises(jaxtyping.TypeCheckError):
        log_transmittance(torch.zeros(2, 7, dtype=torch.int64), 1.0)


def test_records_are_checked_too() -> None:
    with pytest.raises(jaxtyping.TypeCheckError):
        Pinhole(intrinsics=torch.eye(3), camera_from_object=torch.eye(3), width=4, height=4)


def test_arrays_of_numpy_are_checked_too() -> None:
    with pytest.raises(jaxtyping.TypeCheckError):
        transform_points(np.eye(3), np.zeros((5, 3)))
