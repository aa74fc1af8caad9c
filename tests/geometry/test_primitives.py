"""Exact primitives: the defining equations, and curvatures against automatic differentiation."""

import casadi as ca
import numpy as np
import pytest
from scipy.spatial import KDTree

from meshskin.geometry.primitives import Capsule, Cylinder, Ellipsoid, Sphere, Torus

IMPLICIT = [
    (Sphere(0.1), lambda x: ca.sumsqr(x) / 0.01 - 1),
    (
        Ellipsoid((0.1, 0.07, 0.05)),
        lambda x: (x[0] / 0.1) ** 2 + (x[1] / 0.07) ** 2 + (x[2] / 0.05) ** 2 - 1,
    ),
    (Torus(0.1, 0.04), lambda x: (ca.norm_2(x[:2]) - 0.1) ** 2 + x[2] ** 2 - 0.04**2),
]


@pytest.mark.parametrize(("exact", "level"), IMPLICIT, ids=["sphere", "ellipsoid", "torus"])
def test_foot_normal_and_curvature_follow_from_the_implicit_surface(exact, level):
    x = ca.SX.sym("x", 3)
    f = level(x)
    hessian, gradient = ca.hessian(f, x)
    oracle = ca.Function("f", [x], [f, gradient, hessian])
    points = np.random.default_rng(0).normal(size=(200, 3)) * 0.08
    hit = exact.closest(points)
    for k in range(200):
        value, g, h = (np.array(a) for a in oracle(hit.point[k]))
        assert abs(float(value[0, 0])) < 1e-12
        n = g.ravel() / np.linalg.norm(g)
        np.testing.assert_allclose(hit.normal[k], n, atol=1e-9)
        np.testing.assert_allclose(
            hit.point[k] + hit.distance[k] * hit.normal[k], points[k], atol=1e-9
        )
        p = np.eye(3) - np.outer(n, n)  # shape operator: the Hessian across n, over the slope
        values = np.sort(np.linalg.eigvalsh(p @ h @ p / np.linalg.norm(g)))
        tangential = np.delete(values, np.argmin(np.abs(values)))
        np.testing.assert_allclose(np.sort(hit.curvature[k]), tangential, rtol=1e-6, atol=1e-6)


@pytest.mark.deep
def test_ellipsoid_foot_is_the_nearest():
    exact = Ellipsoid((0.1, 0.07, 0.05))
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.12, 0.12, size=(300, 3))
    points[:50, 2] = 0.0  # on a symmetry plane, some inside the focal curve
    points[50:60] = 0.0
    d = rng.normal(size=(400_000, 3))
    sample = d / np.linalg.norm(d, axis=1, keepdims=True) * [0.1, 0.07, 0.05]
    nearest = KDTree(sample).query(points)[0]
    distance = np.abs(exact.closest(points).distance)
    assert np.all(distance <= nearest + 1e-12)
    assert np.all(nearest - distance < 2e-4)


def test_capsule():
    exact = Capsule(0.05, 0.2)
    hit = exact.closest([[0.07, 0.0, 0.03], [0.0, 0.0, 0.2], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(hit.distance, [0.02, 0.05, -0.05], atol=1e-15)
    np.testing.assert_allclose(hit.curvature, [[20, 0], [20, 20], [20, 0]], atol=1e-12)
    np.testing.assert_allclose(hit.point[1], [0.0, 0.0, 0.15], atol=1e-15)


def test_cylinder():
    exact = Cylinder(0.05, 0.2)
    points = [[0.07, 0, 0.03], [0, 0.01, 0.12], [0.08, 0, 0.14], [0.04, 0, 0], [0, 0, -0.095]]
    hit = exact.closest(points)
    np.testing.assert_allclose(hit.distance, [0.02, 0.02, 0.05, -0.01, -0.005], atol=1e-15)
    np.testing.assert_allclose(hit.point[2], [0.05, 0.0, 0.1], atol=1e-15)
    np.testing.assert_allclose(hit.normal[2], [0.6, 0.0, 0.8], atol=1e-15)
    np.testing.assert_allclose(hit.point[4], [0.0, 0.0, -0.1], atol=1e-15)
    np.testing.assert_allclose(hit.curvature, [[20, 0], [0, 0], [20, 0], [20, 0], [0, 0]])


def test_torus_is_hollow_inside_the_ring():
    hit = Torus(0.1, 0.04).closest([[0.05, 0.0, 0.0]])
    np.testing.assert_allclose(hit.curvature, [[25.0, -1.0 / 0.06]], atol=1e-9)
    np.testing.assert_allclose(hit.distance, 0.01, atol=1e-15)


@pytest.mark.parametrize(
    "exact", [Sphere(0.1), Capsule(0.05, 0.2), Cylinder(0.05, 0.2), Torus(0.1, 0.04)]
)
def test_symmetric_points_have_finite_answers(exact):
    hit = exact.closest(np.zeros((1, 3)))
    assert np.isfinite(hit.point).all()
    np.testing.assert_allclose(np.linalg.norm(hit.normal, axis=1), 1.0)


@pytest.mark.parametrize(
    "shape",
    [Sphere(0.1), Ellipsoid((0.1, 0.07, 0.05)), Capsule(0.05, 0.2), Cylinder(0.05, 0.2),
     Torus(0.1, 0.04)],
)  # fmt: skip
def test_first_direction_is_where_the_normal_turns_fastest(shape):
    """dn/ds = k1 along the first direction, k2 across it (Rodrigues' formula)."""
    rng = np.random.default_rng(3)
    hit = shape.closest(rng.normal(size=(200, 3)) * [0.06, 0.05, 0.08])
    step = 1e-6
    np.testing.assert_allclose(np.linalg.norm(hit.direction, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(np.sum(hit.direction * hit.normal, axis=1), 0.0, atol=1e-9)
    for k, way in enumerate((hit.direction, np.cross(hit.normal, hit.direction))):
        there, here = (shape.closest(hit.point + s * step * way).normal for s in (1, -1))
        turn = (there - here) / (2 * step)
        error = np.linalg.norm(turn - hit.curvature[:, k : k + 1] * way, axis=1)
        smooth = np.linalg.norm(there - here, axis=1) < 0.1  # not on a rim
        assert np.quantile(error[smooth], 0.95) < 1e-3  # but for a capsule's seams
        assert smooth.sum() > 100
