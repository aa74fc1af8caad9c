"""The pressure factor against the world's readings, finite differences and scipy."""

import casadi as ca
import numpy as np
import pytest
from scipy.special import log_ndtr

from meshskin.estimation import chart
from meshskin.estimation.measurements import gather, near_pairs
from meshskin.estimation.pressure import LOWER, _censored, kernel, parameters


@pytest.fixture(scope="module")
def case(world):
    """Pairs near each other, their true pressures, and the kernel's parameters at the truth."""
    data = gather(world.record(), world.belief())
    contact, taxel = (v[::23] for v in near_pairs(data, world.truth))
    level = world.pressures()[contact, taxel]
    charts = chart.about(world.body, world.truth)
    return data, level, parameters(data, charts, contact, taxel, level, 1e-3)


def test_mean_is_the_world_s_reading(case):
    data, level, p = case
    residual = kernel("active").residual.map(p.shape[1])(np.zeros((3, 1)), p)[0].full()[0]
    assert (level > 0).sum() > 100
    assert np.abs(residual).max() * data.sigma < 5e-6 * data.peaks.max()


def test_modulus_acts_as_in_hertz(world, case):
    data, _, p = case
    softer = gather(world.record(), world.belief(young=0.8 * 0.2e6))
    contact, taxel = (v[::23] for v in near_pairs(data, world.truth))
    q = parameters(softer, chart.about(world.body, world.truth), contact, taxel, 0.0, 1e-3)
    p = p.copy()
    p[13] = 0
    x = np.zeros((3, p.shape[1]))
    x[2] = np.log(0.8)
    moved = kernel("active").residual.map(p.shape[1])(x, p)[0].full() * data.sigma
    direct = kernel("active").residual.map(p.shape[1])(np.zeros((3, 1)), q)[0].full()
    assert np.allclose(moved, direct * softer.sigma, atol=1e-6 * data.peaks.max())


@pytest.mark.parametrize("kind", ["active", "silent"])
def test_derivatives(case, kind):
    _, _, p = case
    p = p.copy()
    p[13] = 0.3 * p[12] if kind == "silent" else p[13] + 1.0
    k, one = p.shape[1], kernel(kind)
    x = np.random.default_rng(3).normal(scale=0.3, size=(3, k))
    cost, gradient = (v.full() for v in one.gradient.map(k)(x, p))
    assert np.array_equal(one.value.map(k)(x, p).full(), cost)
    assert np.isfinite(gradient).all()
    h = 1e-6
    for r in range(3):
        step = h * np.eye(3)[:, r : r + 1]
        ahead, behind = (one.value.map(k)(x + s, p).full()[0] for s in (step, -step))
        scale = np.abs(gradient[r]).max()
        assert np.allclose((ahead - behind) / (2 * h), gradient[r], atol=2e-3 * scale)
    lower = one.hessian.map(k)(x, p).full()
    _, slope, curvature = (v.full() for v in one.residual.map(k)(x, p))
    for row, (r, c) in enumerate(LOWER):
        assert np.allclose(lower[row], curvature[0] * slope[r] * slope[c])
    assert (curvature >= 0).all()


def test_censored_cost_against_scipy():
    x = ca.SX.sym("x")
    f = ca.Function("f", [x], list(_censored(x))).map(200)
    points = np.linspace(-30, 40, 200)
    cost, rate, curvature = (v.full()[0] for v in f(points[None]))
    log_density = -(points**2) / 2 - np.log(2 * np.pi) / 2
    mills = np.exp(log_density - log_ndtr(-points))
    assert np.allclose(cost, -log_ndtr(-points), rtol=1e-10, atol=1e-16)
    assert np.allclose(rate, mills, rtol=1e-10, atol=1e-300)
    assert np.allclose(curvature, mills * (mills - points), rtol=1e-6, atol=1e-9)
