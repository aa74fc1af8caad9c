"""Disc mean of the Hertz pressure: adaptive quadrature, derivatives, inverse."""

import casadi as ca
import mpmath
import numpy as np
import pytest
from scipy.integrate import quad

from meshskin.contact.disc import disc_mean, disc_mean_of_square, disc_slope, invert_disc_mean


def by_rings(rho, s):
    """The mean by adaptive double quadrature in polar coordinates about the disc's centre."""

    def ring(t):
        def height(phi):
            return np.sqrt(max(1 - rho**2 - t**2 - 2 * rho * t * np.cos(phi), 0.0))

        return 2 * t * quad(height, 0, np.pi, limit=200)[0]

    kinks = [k for k in (abs(1 - rho), 1 + rho) if 0 < k < s]
    return quad(ring, 0, s, points=kinks or None, limit=200)[0] / (np.pi * s**2)


@pytest.fixture(scope="module")
def samples():
    rng = np.random.default_rng(0)
    s = rng.uniform(0.05, 1.6, 5000)
    return rng.uniform(0, 1, 5000) * (1.1 + s), s


@pytest.mark.parametrize("s", [0.1, 0.46, 0.9, 1.0, 1.5])
@pytest.mark.parametrize("fraction", [0.0, 0.2, 0.5, 0.8, 0.97])
def test_mean_equals_adaptive_quadrature(s, fraction):
    rho = fraction * (1 + s)
    assert disc_mean(rho, s) == pytest.approx(by_rings(rho, s), abs=3e-6)


def test_closed_forms():
    s = np.array([0.2, 0.7, 1.0])
    centred = 2 * (1 - (1 - s**2) ** 1.5) / (3 * s**2)
    assert np.allclose(disc_mean(np.zeros(3), s), centred, atol=1e-5)
    assert disc_mean(0.3, 1.5) == pytest.approx(2 / (3 * 1.5**2), rel=1e-12)  # patch inside disc
    assert disc_mean(1.7, 0.6) == 0.0
    assert disc_mean(0.4, 1e-3) == pytest.approx(float(mpmath.sqrt(1 - mpmath.mpf("0.16"))), 1e-5)


def test_error_decreases_with_the_nodes(samples):
    fine = disc_mean(*samples, nodes=40)
    errors = [np.abs(disc_mean(*samples, nodes=n) - fine).max() for n in (4, 8, 16)]
    assert errors[1] < 5e-6
    assert errors[0] > 10 * errors[1] > 50 * errors[2]


def test_casadi_agrees_and_derivatives_are_finite(samples):
    rho, s = (v.copy() for v in samples)
    rho[:100], rho[100:200], rho[200:300] = 0.0, 1 + s[100:200], np.abs(1 - s[200:300])
    x = ca.SX.sym("x", 2)
    value = disc_mean(x[0], x[1])
    hessian, gradient = ca.hessian(value, x)
    f = ca.Function("f", [x], [value, gradient, hessian]).map(len(rho))
    value, gradient, hessian = (v.full() for v in f(np.stack([rho, s])))
    assert np.allclose(value[0], disc_mean(rho, s), atol=1e-14)
    assert np.isfinite(gradient).all()
    assert np.isfinite(hessian).all()
    assert np.allclose(gradient[0], disc_slope(rho, s), atol=2e-3)


def test_square_form_has_derivatives_at_zero():
    q = ca.SX.sym("q")
    y = disc_mean_of_square(q, 0.4)
    f = ca.Function("f", [q], [y, ca.gradient(y, q), ca.hessian(y, q)[0]])
    assert np.isfinite([float(v) for v in f(0.0)]).all()
    assert float(f(0.25)[0]) == pytest.approx(disc_mean(0.5, 0.4))


def test_inverse_round_trip(samples):
    rho, s = samples
    m = disc_mean(rho, s)
    found = invert_disc_mean(m, s)
    assert np.allclose(disc_mean(found, s), m, atol=1e-9)
    steep = (m > 1e-6) & (m < disc_mean(0 * s, s) - 1e-4)
    assert np.allclose(found[steep], rho[steep], atol=1e-6)


def test_inverse_at_and_beyond_the_ends_of_its_range():
    s = 0.5
    peak = float(disc_mean(0.0, s))
    m = np.array([peak, peak + 0.3, 0.0, -0.1, np.nan])
    assert np.array_equal(invert_disc_mean(m, s), [0, 0, 1.5, 1.5, np.nan], equal_nan=True)
    falling = invert_disc_mean(np.linspace(-0.1, 1.0, 400), s)
    assert np.all(np.diff(falling) <= 0)
    assert invert_disc_mean(np.full((2, 3), 0.2), s).shape == (2, 3)
