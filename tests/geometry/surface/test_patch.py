"""Quintic patches: derivatives, curvature, and the CasADi foot against NumPy."""

import casadi as ca
import numpy as np
import pytest

from meshskin.geometry.body import Body
from meshskin.geometry.surface import patch


def polynomial(coefficients, u, v):
    return sum(c * u**i * v**j for c, (i, j) in zip(coefficients, patch.POWERS, strict=True))


def test_values_and_derivatives_are_those_of_the_polynomial():
    rng = np.random.default_rng(0)
    c = rng.normal(size=(7, 21, 3))
    u, v = rng.uniform(0.0, 0.5, size=(2, 7))
    u_, v_ = ca.SX.sym("u"), ca.SX.sym("v")
    for k in range(7):
        s = ca.vertcat(*(polynomial(c[k, :, a], u_, v_) for a in range(3)))
        su, sv = ca.jacobian(s, u_), ca.jacobian(s, v_)
        suu, suv, svv = ca.jacobian(su, u_), ca.jacobian(su, v_), ca.jacobian(sv, v_)
        oracle = ca.Function("s", [u_, v_], [s, su, sv, suu, suv, svv])(u[k], v[k])
        for ours, theirs in zip(patch.evaluate(c, u, v), oracle, strict=True):
            np.testing.assert_allclose(ours[k], np.array(theirs).ravel(), atol=1e-12)


def test_shape_of_a_graph_with_known_curvatures():
    # z = -(k1 x^2 + k2 y^2) / 2 seen from above is convex with curvatures k1, k2 at the origin
    zero = np.zeros((1, 3))
    su, sv = np.array([[2.0, 0.0, 0.0]]), np.array([[1.0, 3.0, 0.0]])  # oblique parameters
    k1, k2 = 7.0, -2.0

    def bend(a, b):
        return np.array([[0.0, 0.0, -(k1 * a[0, 0] * b[0, 0] + k2 * a[0, 1] * b[0, 1])]]) + zero

    second = bend(su, su), bend(su, sv), bend(sv, sv)
    normal, curvature, direction = patch.shape((su, sv), second)
    np.testing.assert_allclose(normal, [[0.0, 0.0, 1.0]], atol=1e-15)
    np.testing.assert_allclose(curvature, [[k1, k2]], atol=1e-12)
    np.testing.assert_allclose(np.abs(direction), [[1.0, 0.0, 0.0]], atol=1e-12)


@pytest.fixture(scope="module")
def foot():
    c, p = ca.SX.sym("c", 21, 3), ca.SX.sym("p", 3)
    u, v = ca.SX.sym("u"), ca.SX.sym("v")
    return {
        n: ca.Function("foot", [c, u, v, p], list(patch.casadi_foot(c, u, v, p, iterations=n)))
        for n in (1, 4)
    }


@pytest.mark.parametrize("body", [Body.sphere(), Body.ellipsoid((0.1, 0.07, 0.05))])
def test_casadi_foot_agrees_with_numpy(body, foot):
    rng = np.random.default_rng(1)
    d = rng.normal(size=(20, 3))
    on = body.exact.closest(0.1 * d / np.linalg.norm(d, axis=1, keepdims=True))
    points = on.point + rng.uniform(-2e-3, 8e-3, size=(20, 1)) * on.normal
    hit = body.closest(points)
    for k in range(20):
        c = body.surface.patches[hit.face[k]]
        u, v = hit.uv[k] + rng.uniform(-0.1, 0.1, size=2)
        out = [np.array(x).ravel() for x in foot[4](c, u, v, points[k])]
        np.testing.assert_allclose(np.concatenate(out[:2]), hit.uv[k], atol=1e-9)
        np.testing.assert_allclose(out[2], hit.point[k], atol=1e-12)
        np.testing.assert_allclose(out[3], hit.normal[k], atol=1e-10)
        np.testing.assert_allclose(out[4], hit.curvature[k], rtol=1e-6)


def test_one_iteration_tracks_a_moving_foot(foot):
    """A step of the closed loop moves the foot by well under a hundredth of a face."""
    body = Body.ellipsoid((0.1, 0.07, 0.05))
    hit = body.closest([[0.05, 0.04, 0.03]])
    c = body.surface.patches[hit.face[0]]
    p = hit.point[0] + 8e-3 * hit.normal[0]
    exact = body.closest([p], face=hit.face)
    u, v, s, n, k = foot[1](c, *(exact.uv[0] + [0.005, -0.005]), p)
    np.testing.assert_allclose(np.array(s).ravel(), exact.point[0], atol=5e-9)
    np.testing.assert_allclose(np.array(n).ravel(), exact.normal[0], atol=1e-6)
    np.testing.assert_allclose(np.array(k).ravel(), exact.curvature[0], rtol=2e-3)
    again = foot[1](c, u, v, p)
    np.testing.assert_allclose(np.array(again[2]).ravel(), exact.point[0], atol=1e-12)


def test_casadi_curvature_has_a_finite_derivative_on_a_sphere():
    body = Body.sphere()
    hit = body.closest([[0.0, 0.0, 0.12]])
    c, p = ca.SX.sym("c", 21, 3), ca.SX.sym("p", 3)
    k = patch.casadi_foot(c, 0.3, 0.3, p)[4]
    jacobian = ca.Function("j", [c, p], [ca.jacobian(k, p)])
    value = jacobian(body.surface.patches[hit.face[0]], [0.0, 0.0, 0.12])
    assert np.isfinite(np.array(value)).all()
