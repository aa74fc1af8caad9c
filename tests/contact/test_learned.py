"""The learned profile's correction: smooth, even, of bounded extent, and of the stated variance."""

import numpy as np
import pytest
from scipy.interpolate import BSpline

from meshskin.contact.learned import PROFILE_SIZE, ProfileCorrection, whitening

PROFILE = ProfileCorrection(2.5)


def test_slopes_are_the_derivatives_of_the_values():
    u, step = np.linspace(0.01, 2.6, 40), 1e-6
    for whitened in np.eye(PROFILE_SIZE):
        ahead, behind = PROFILE(u + step, whitened)[1], PROFILE(u - step, whitened)[1]
        slope = PROFILE(u, whitened)[2]
        np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), atol=1e-7)


def test_even_about_the_contact_point_and_zero_from_the_extent_on():
    for whitened in np.eye(PROFILE_SIZE):
        _, value, slope = PROFILE(np.array([0.0, 2.5, 3.0, 1e-3, 2e-3]), whitened)
        assert np.all(slope[:3] == 0.0)
        assert np.all(value[1:3] == 0.0)
        curvature = (value[3:] - value[0]) / np.array([1e-6, 4e-6])
        np.testing.assert_allclose(curvature[0], curvature[1], rtol=1e-2)


def test_basis_is_that_of_scipy_s_cubic_splines():
    step = 2.5 / (PROFILE_SIZE + 1)
    knots = step * np.arange(-2, PROFILE_SIZE + 4)
    u = np.linspace(0.0, 2.49, 60)
    spline = np.stack(
        [
            BSpline.basis_element(knots[k : k + 5] - 0.0, extrapolate=False)(u)
            for k in range(PROFILE_SIZE)
        ]
    )
    spline = np.nan_to_num(spline)
    mirrored = np.nan_to_num(BSpline.basis_element(knots[:5] - step, extrapolate=False)(u))
    spline[1] += mirrored
    np.testing.assert_allclose(
        PROFILE(u, np.zeros(PROFILE_SIZE))[0], spline.T @ whitening(), atol=1e-12
    )


def test_whitened_coefficients_penalize_second_differences():
    inverse = np.linalg.inv(whitening())
    precision = inverse.T @ inverse
    smooth = np.cos(np.pi / 2 * np.arange(PROFILE_SIZE) / PROFILE_SIZE)
    rough = smooth + 0.2 * (-1.0) ** np.arange(PROFILE_SIZE)
    assert rough @ precision @ rough > 50 * (smooth @ precision @ smooth)
    variance = np.sum(whitening() ** 2, axis=1)
    assert np.mean(variance) == pytest.approx(1.0)
