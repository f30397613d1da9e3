"""The sRGB curve: against the standard's own figures."""

import numpy as np
import pytest

from backend.maths.srgb import linear_from_srgb, srgb_from_linear


def test_the_two_are_inverse() -> None:
    values = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(srgb_from_linear(linear_from_srgb(values)), values, atol=1e-6)


@pytest.mark.parametrize(("srgb", "linear"), [(0.0, 0.0), (0.04045, 0.0031308), (0.5, 0.21404), (1.0, 1.0)])
def test_it_meets_the_standard(srgb: float, linear: float) -> None:
    assert linear_from_srgb(np.array(srgb)) == pytest.approx(linear, abs=1e-5)
