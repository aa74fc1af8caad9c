"""The edge kernel against finite differences and CasADi's own derivatives."""

import casadi as ca
import numpy as np
import pytest

from meshskin.core import se3
from meshskin.estimation.posegraph import edge_assembly as kernel
from meshskin.estimation.posegraph.edge_assembly import LOWER, edge_kernel, error, weighted_errors
from meshskin.estimation.posegraph.solve import RESIDUALS

SCALE = np.array([1e-2, 0.3])


def random_edge(rng, angle=None):
    """Parameters (35,) of an edge; `angle`: of the rotation between displacements, rad."""
    w = rng.normal(size=3)
    miss = se3.exp_so3(w if angle is None else w / np.linalg.norm(w) * angle)
    measured = se3.exp_so3(rng.normal(size=3))
    now = measured @ miss
    root = np.triu(rng.normal(size=(6, 6)))
    return np.concatenate(
        [
            rng.normal(size=3),
            se3.quaternion(now),
            rng.normal(size=3),
            se3.quaternion(measured),
            root[np.triu_indices(6)],
        ]
    )


def assembled_hessian(one, x, edge, blend):
    i, j, between = (out.full()[:, 0] for out in one.hessian.call([x, edge, SCALE, blend]))
    matrix = np.zeros((12, 12))
    for k, (r, c) in enumerate(LOWER):
        matrix[r, c] = matrix[c, r] = i[k]
        matrix[6 + r, 6 + c] = matrix[6 + c, 6 + r] = j[k]
    matrix[:6, 6:] = between.reshape(6, 6)
    matrix[6:, :6] = matrix[:6, 6:].T
    return matrix


@pytest.mark.parametrize("residual", RESIDUALS.values())
def test_gradient_and_hessian_are_the_derivatives(residual):
    one, rng = edge_kernel(residual), np.random.default_rng(1)
    for _ in range(5):
        edge, x = random_edge(rng), 0.2 * rng.normal(size=12)

        def gradient(at, edge=edge):
            return one.gradient.call([at, edge, SCALE])[1].full()[:, 0]

        def cost(at, edge=edge):
            return float(one.gradient.call([at, edge, SCALE])[0])

        h = 1e-5
        steps = h * np.eye(12)
        slope = np.array([(cost(x + s) - cost(x - s)) / (2 * h) for s in steps])
        curvature = np.array([(gradient(x + s) - gradient(x - s)) / (2 * h) for s in steps])
        exact = assembled_hessian(one, x, edge, 1.0)
        assert np.allclose(gradient(x), slope, atol=1e-7 * np.abs(slope).max())
        assert np.allclose(exact, curvature, atol=1e-6 * np.abs(curvature).max())


@pytest.mark.parametrize("residual", RESIDUALS.values())
def test_gauss_newton_at_blend_zero(residual):
    one, rng = edge_kernel(residual), np.random.default_rng(2)
    edge, x = random_edge(rng), 0.1 * rng.normal(size=12)
    root = np.zeros((6, 6))
    root[np.triu_indices(6)] = edge[14:]

    def residual_of(at):
        return root @ error_of(residual)(at, edge, SCALE).full()[:, 0]

    jacobian = np.array(
        [(residual_of(x + s) - residual_of(x - s)) / 2e-5 for s in 1e-5 * np.eye(12)]
    ).T
    hessian = assembled_hessian(one, x, edge, 0.0)
    assert np.allclose(hessian, jacobian.T @ jacobian, atol=1e-7 * np.abs(hessian).max())
    blocks = one.gauss_newton.call([x, edge, SCALE])
    for block, exact in zip(blocks, one.hessian.call([x, edge, SCALE, 0.0]), strict=True):
        assert np.allclose(block.full(), exact.full(), atol=1e-12 * np.abs(hessian).max())


def error_of(residual):
    """The kernel's residual e (6,) as a function of its inputs."""
    x, edge, scale = ca.SX.sym("x", 12), ca.SX.sym("edge", 35), ca.SX.sym("scale", 2)
    return ca.Function("e", [x, edge, scale], [error(residual, x, edge[:7], edge[7:14], scale)])


def test_errors_follow_their_definition():
    rng = np.random.default_rng(3)
    for angle in (1e-9, 0.5, 3.0):
        edge = random_edge(rng, angle)
        log, vec = (error_of(r)(np.zeros(12), edge, SCALE).full()[:, 0] for r in RESIDUALS.values())
        assert np.allclose(log[:3], edge[:3] - edge[7:10])
        assert np.isclose(np.linalg.norm(log[3:]), angle, rtol=1e-6)
        assert np.isclose(np.linalg.norm(vec[3:]), 2 * np.sin(angle / 2), rtol=1e-6)
        for residual in RESIDUALS.values():  # the cost is half the squared weighted error
            weighted = weighted_errors(edge[None], residual)
            cost = edge_kernel(residual).gradient.call([np.zeros(12), edge, SCALE])[0]
            assert np.isclose(0.5 * np.sum(weighted**2), float(cost), rtol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, np.pi - 1e-9, np.pi - 1e-12, np.pi])
def test_finite_at_zero_and_near_pi(angle):
    one, rng = edge_kernel("log"), np.random.default_rng(4)
    edge = random_edge(rng, angle)
    cost, gradient = one.gradient.call([np.zeros(12), edge, SCALE])
    assert np.isfinite(float(cost))
    assert np.isfinite(gradient.full()).all()
    assert np.isfinite(assembled_hessian(one, np.zeros(12), edge, 1.0)).all()
    error = error_of("log")(np.zeros(12), edge, SCALE).full()[3:]
    assert np.isclose(np.linalg.norm(error), angle, atol=1e-7)


def test_casadi_rotations_equal_numpy():
    rng, q = np.random.default_rng(5), ca.SX.sym("q", 4)
    rotation, log = (ca.Function("f", [q], [f(q)]) for f in (se3.casadi_rotation, kernel.log))
    a = ca.SX.sym("a", 3)
    cayley = ca.Function("f", [a], [se3.casadi_rotation(kernel.cayley(a))])
    for _ in range(5):
        w = rng.normal(size=3)
        matrix = se3.exp_so3(w)
        quaternion = se3.quaternion(matrix)
        assert np.allclose(rotation(quaternion).full(), matrix)
        assert np.allclose(rotation(-quaternion).full(), matrix)
        assert np.allclose(log(-quaternion).full()[:, 0], se3.log_so3(matrix))
        assert np.allclose(cayley(w).full(), se3.cayley(w))
    assert np.allclose(se3.cayley(1e-3 * w), se3.exp_so3(1e-3 * w), atol=1e-8)
