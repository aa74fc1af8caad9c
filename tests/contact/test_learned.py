"""The learned profile's correction: smooth, even, of bounded extent, and of the stated variance."""

import numpy as np
import pytest
from scipy.interpolate import BSpline

from meshskin.contact.learned import PROFILE_SIZE, ProfileCorrection

PROFILE = ProfileCorrection(2.5)


def test_slopes_are_the_derivatives_of_the_values():
    u, step = np.linspace(0.01, 2.6, 40), 1e-6
    ahead, behind = PROFILE(u + step)[0], PROFILE(u - step)[0]
    np.testing.assert_allclose(PROFILE(u)[1], (ahead - behind) / (2 * step), atol=1e-7)


def test_even_about_the_contact_point_and_zero_from_the_extent_on():
    value, slope = PROFILE(np.array([0.0, 2.5, 3.0]))
    assert np.all(slope[0] == 0.0)
    assert np.all(value[1:] == 0.0)
    assert np.all(slope[1:] == 0.0)
    curvature = (PROFILE(np.array([1e-3]))[0] - value[0]) / 1e-6
    np.testing.assert_allclose(
        curvature, (PROFILE(np.array([2e-3]))[0] - value[0]) / 4e-6, rtol=1e-2
    )


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
    np.testing.assert_allclose(PROFILE(u)[0], spline.T @ PROFILE.whitening, atol=1e-12)


def test_whitened_coefficients_penalize_second_differences():
    inverse = np.linalg.inv(PROFILE.whitening)
    precision = inverse.T @ inverse
    smooth = np.cos(np.pi / 2 * np.arange(PROFILE_SIZE) / PROFILE_SIZE)
    rough = smooth + 0.2 * (-1.0) ** np.arange(PROFILE_SIZE)
    assert rough @ precision @ rough > 50 * (smooth @ precision @ smooth)
    variance = np.sum(PROFILE.whitening**2, axis=1)
    assert np.mean(variance) == pytest.approx(1.0)
