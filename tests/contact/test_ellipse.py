"""Disc means of elliptic patches: quadrature, the circular case, derivatives, inverse."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import quad

from meshskin.contact.disc import disc_mean, invert_disc_mean
from meshskin.contact.ellipse import ellipse_gradient, ellipse_mean, invert_ellipse_mean
from meshskin.contact.patch import Patch


def by_rings(x, y, a, b, s, exponent):
    """The mean by adaptive double quadrature in polar coordinates about the disc's centre."""

    def ring(t):
        def height(phi):
            q = ((x + t * np.cos(phi)) / a) ** 2 + ((y + t * np.sin(phi)) / b) ** 2
            return max(1 - q, 0.0) ** exponent

        return t * quad(height, 0, 2 * np.pi, limit=300, epsabs=1e-6)[0]

    return quad(ring, 0, s, limit=300, epsabs=1e-5)[0] / (np.pi * s**2)


@pytest.mark.parametrize("exponent", [0.5, 0.8])
@pytest.mark.parametrize(
    ("x", "y", "a", "b", "s"),
    [
        (0.0, 0.0, 1.0, 0.7, 0.3),
        (0.5, 0.3, 1.2, 0.9, 0.6),
        (0.9, -0.4, 1.0, 0.7, 0.5),
        pytest.param(0.1, 0.2, 1.0, 0.8, 1.9, marks=pytest.mark.slow),
        (0.0, 1.0, 0.6, 1.4, 0.4),
    ],
)
def test_mean_equals_adaptive_quadrature(x, y, a, b, s, exponent):
    found = ellipse_mean(x, y, a, b, s, exponent)
    assert found == pytest.approx(by_rings(x, y, a, b, s, exponent), abs=1e-4)


@pytest.fixture(scope="module")
def samples():
    rng = np.random.default_rng(0)
    s, angle = rng.uniform(0.2, 1.6, 3000), rng.uniform(0, 2 * np.pi, 3000)
    rho = rng.uniform(0, 1.1, 3000) * (1 + s)
    return rho, angle, s


@pytest.mark.parametrize(("aspect", "limit"), [(1.0, 7e-5), (1.5, 1e-4), (3.0, 4e-4), (10.0, 2e-3)])
def test_documented_error_of_the_nodes(samples, aspect, limit):
    rho, angle, s = samples
    a, b = np.sqrt(aspect), 1 / np.sqrt(aspect)
    at = rho * np.cos(angle) * a, rho * np.sin(angle) * b, a, b, s
    fine = ellipse_mean(*at, nodes=3000)
    errors = [np.abs(ellipse_mean(*at, nodes=n) - fine).max() for n in (24, 48, 96)]
    assert errors[1] < limit
    assert errors[0] > 3 * errors[1] > 9 * errors[2]  # nodes^-2.5, at least nodes^-1.6


def test_circle_equals_the_disc_mean(samples):
    rho, angle, s = samples
    found = ellipse_mean(rho * np.cos(angle), rho * np.sin(angle), 1.0, 1.0, s)
    assert np.allclose(found, disc_mean(rho, s, nodes=40), atol=7e-5)
    general = ellipse_mean(rho * np.cos(angle), rho * np.sin(angle), 1.0, 1.0, s, np.array(0.5))
    assert np.allclose(found, general, atol=1e-8)


def test_casadi_agrees_and_gradients_are_finite(samples):
    rho, angle, s = samples
    x = ca.SX.sym("x", 5)
    value = ellipse_mean(x[0], x[1], x[2], 0.8, x[3], x[4])
    f = ca.Function("f", [x], [value, ca.gradient(value, x)]).map(len(s))
    at = np.stack([rho * np.cos(angle), rho * np.sin(angle), 1 + 0.3 * s, s, 0.5 + 0.2 * s])
    at[:2, :50], at[:2, 50] = 0.0, 0.0
    value, gradient = (v.full() for v in f(at))
    plain = ellipse_mean(at[0], at[1], at[2], 0.8, at[3], at[4])
    assert np.allclose(value[0], plain, atol=1e-13)
    assert np.isfinite(gradient).all()
    step = 1e-6
    for row in range(5):
        up, down = at.copy(), at.copy()
        up[row] += step
        down[row] -= step
        change = (
            ellipse_mean(up[0], up[1], up[2], 0.8, up[3], up[4])
            - ellipse_mean(down[0], down[1], down[2], 0.8, down[3], down[4])
        ) / (2 * step)
        assert np.allclose(gradient[row], change, atol=2e-5)


def test_inverse_round_trip(samples):
    rho, angle, s = samples
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    at = rho * unit[:, 0], rho * unit[:, 1]
    m = ellipse_mean(*at, 1.3, 0.8, s)
    found = invert_ellipse_mean(m, unit, 1.3, 0.8, s)
    steep = (m > 1e-3) & (m < ellipse_mean(0.0, 0.0, 1.3, 0.8, s) - 1e-3)
    assert steep.sum() > 1000
    assert np.allclose(found[steep], rho[steep], atol=2e-4)
    m = disc_mean(rho, s)
    steep = (m > 1e-2) & (m < disc_mean(0 * s, s) - 1e-2)
    found = invert_ellipse_mean(m, unit, 1.0, 1.0, s)
    assert np.allclose(found[steep], invert_disc_mean(m, s)[steep], atol=2e-3)


@pytest.mark.parametrize("exponent", [0.5, np.array(0.5), np.array(0.8)])
def test_gradient_equals_automatic_differentiation(samples, exponent):
    rho, angle, s = samples
    x = ca.SX.sym("x", 5)  # x, y, ln a, ln b, exponent
    power = exponent if isinstance(exponent, float) else x[4]
    value = ellipse_mean(x[0], x[1], 1.3 * ca.exp(x[2]), 0.8 * ca.exp(x[3]), 0.6, power)
    f = ca.Function("f", [x], [value, ca.gradient(value, x[:4])]).map(len(s))
    at = np.zeros((5, len(s)))
    at[:2], at[4] = (rho * np.cos(angle), rho * np.sin(angle)), exponent
    mean, slopes = (v.full() for v in f(at))
    found = ellipse_gradient(at[0], at[1], 1.3, 0.8, 0.6, exponent)
    assert np.allclose(found[0], mean[0], atol=1e-13)
    assert np.allclose(found[1:5], slopes, atol=3e-6)
    up, down = (ellipse_mean(at[0], at[1], 1.3, 0.8, 0.6, exponent + h) for h in (1e-6, -1e-6))
    assert np.allclose(found[5], (up - down) / 2e-6, atol=1e-7)


def test_inverse_at_and_beyond_the_ends_of_its_range():
    peak = float(ellipse_mean(0.0, 0.0, 1.0, 0.7, 0.5))
    m = np.array([peak, peak + 0.3, 0.0, -0.1, np.nan])
    found = invert_ellipse_mean(m, [1.0, 0.0], 1.0, 0.7, 0.5)
    assert np.allclose(found, [0, 0, 1.5, 1.5, np.nan], equal_nan=True)
    falling = invert_ellipse_mean(np.linspace(-0.1, 1.0, 200), [0.6, 0.8], 1.0, 0.7, 0.5)
    assert np.all(np.diff(falling) <= 1e-9)


def test_reading_is_the_mean_pressure():
    patch = Patch(np.array([3e-3, 2e-3]), 5e4, 1e-3, "elliptic")
    xy = np.array([[0.0, 0.0], [1e-3, 1e-3], [2.5e-3, 0.0], [9e-3, 0.0]])
    t = (np.arange(300) + 0.5) / 150 - 1
    disc = 2e-3 * np.stack(np.meshgrid(t, t), axis=-1)
    disc = disc[np.hypot(*np.moveaxis(disc, -1, 0)) < 2e-3]
    brute = [patch.pressure(centre + disc).mean() for centre in xy]
    assert patch.reading(xy, 2e-3) == pytest.approx(np.array(brute), abs=5e4 * 1e-3)
    assert patch.reading(xy, 2e-3)[3] == 0.0
