"""The edge kernel: cost, gradient and Hessian of one displacement, the same for all graphs.

Unknowns of an edge (i, j) are local increments x = (p, a) of its two poses, six numbers each, with
the Cayley retraction R <- R C(l_r a), t <- t + R l_t p and the scales (l_t, l_r) in m and rad. The
current displacement, the measured displacement and the square root W of the information matrix
(W^T W = Omega) are parameters: relinearization and reweighting need no new kernel. With q_err the
rotation between the measured and the current displacement, the residual is

    e = (t - delta_t, Log(q_err))     "log": the geodesic objective
    e = (t - delta_t, 2 vec(q_err))   "vec": the chordal objective, with a wide basin of convergence

and the cost |W e|^2 / 2. The Hessian is J^T J + blend * (curvature of the residual): Gauss-Newton
at blend 0, exact at 1.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import casadi as ca
import numpy as np

from ...core import se3
from ...core.arrays import Array

DISPLACEMENT = 7
"""Numbers of a displacement: translation (3) in m, quaternion (4) xyzw."""
SQRT_INFORMATION = 21
"""Entries of the upper triangle of W, by rows."""
EDGE = 2 * DISPLACEMENT + SQRT_INFORMATION
"""Parameters of an edge: current displacement, measured displacement, W."""
UPPER = np.triu_indices(6)
"""Entries of the upper triangle of a block, by rows."""
LOWER = [(r, c) for r in range(6) for c in range(r + 1)]
"""Entries of the lower triangle of a block, by rows."""


@dataclass(frozen=True)
class EdgeKernel:
    """Functions of one edge: (x (12,), edge (35,), scale (2,)[, blend]) -> their value."""

    weighted_error: ca.Function
    """edge -> W e (6,) at x = 0."""
    gradient: ca.Function
    """Cost, gradient (12,)."""
    gauss_newton: ca.Function
    """`hessian` at blend 0, at a third of its cost."""
    hessian: ca.Function
    """78 entries of the Hessian in three outputs: of pose i (21,) and of pose j (21,) the lower
    triangle, by rows; and the block (6, 6) of the rows of i and the columns of j, by rows (36,)."""


@functools.cache
def edge_kernel(residual: str) -> EdgeKernel:
    """The kernel of a `residual`, "log" or "vec"."""
    x, edge, scale = ca.SX.sym("x", 12), ca.SX.sym("edge", EDGE), ca.SX.sym("s", 2)
    blend, fixed = ca.SX.sym("blend"), ca.SX.sym("fixed", 6)
    e = error(residual, x, edge[:DISPLACEMENT], edge[DISPLACEMENT : 2 * DISPLACEMENT], scale)
    root = ca.densify(ca.SX(ca.Sparsity.lower(6), edge[2 * DISPLACEMENT :]).T)
    weighted = ca.mtimes(root, e)
    cost = ca.dot(weighted, weighted) / 2
    jacobian = ca.mtimes(root, ca.jacobian(e, x))
    curvature = ca.hessian(ca.dot(fixed, e), x)[0]
    curvature = ca.substitute(curvature, fixed, ca.mtimes(root.T, weighted))
    square = ca.mtimes(jacobian.T, jacobian)
    inputs = [x, edge, scale]

    def function(name: str, inputs: list[ca.SX], outputs: list[ca.SX]) -> ca.Function:
        return ca.Function(f"{residual}_{name}", inputs, outputs, {"cse": True})

    at_zero = ca.substitute(weighted, ca.vertcat(x, scale), ca.vertcat(ca.SX.zeros(12), 1, 1))
    return EdgeKernel(
        weighted_error=function("weighted_error", [edge], [at_zero]),
        gradient=function("gradient", inputs, [cost, ca.gradient(cost, x)]),
        gauss_newton=function("gauss_newton", inputs, _blocks(square)),
        hessian=function("hessian", [*inputs, blend], _blocks(square + blend * curvature)),
    )


def _blocks(hessian: ca.SX) -> list[ca.SX]:
    """The three outputs of `EdgeKernel.hessian`."""
    return [
        ca.vertcat(*(hessian[r, c] for r, c in LOWER)),
        ca.vertcat(*(hessian[6 + r, 6 + c] for r, c in LOWER)),
        ca.vec(hessian[:6, 6:].T),
    ]


def error(residual: str, x: ca.SX, current: ca.SX, measured: ca.SX, scale: ca.SX) -> ca.SX:
    """e (6,) of the displacement D(x_i)^-1 T_ij D(x_j), T_ij the `current` one."""
    p_i, p_j = scale[0] * x[:3], scale[0] * x[6:9]
    c_i, c_j = cayley(scale[1] * x[3:6]), cayley(scale[1] * x[9:])
    t, q = current[:3], current[3:]
    moved = t + ca.mtimes(se3.casadi_rotation(q), p_j) - p_i
    translation = ca.mtimes(se3.casadi_rotation(conjugate(c_i)), moved)
    rotated = quaternion_product(q, c_j)
    rotated = quaternion_product(conjugate(c_i), rotated)
    q_err = quaternion_product(conjugate(measured[3:]), rotated)
    rotation = 2 * q_err[:3] if residual == "vec" else log(q_err)
    return ca.vertcat(translation - measured[:3], rotation)


def quaternion_product(p: ca.SX, q: ca.SX) -> ca.SX:
    """Hamilton product of quaternions (4,), xyzw: the rotation `q`, followed by `p`."""
    v = p[3] * q[:3] + q[3] * p[:3] + ca.cross(p[:3], q[:3])
    return ca.vertcat(v, p[3] * q[3] - ca.dot(p[:3], q[:3]))


def conjugate(q: ca.SX) -> ca.SX:
    """Inverse of a unit quaternion (4,), xyzw."""
    return ca.vertcat(-q[:3], q[3])


def cayley(a: ca.SX) -> ca.SX:
    """Unit quaternion (4,), xyzw, of the increment `a` (3,): (a/2, 1) / sqrt(1 + |a|^2/4).

    Equal to the exponential map to second order at 0 (the angle is 2 atan(|a|/2)), and cheaper.
    """
    return ca.vertcat(a / 2, 1) / ca.sqrt(1 + ca.dot(a, a) / 4)


def log(q: ca.SX) -> ca.SX:
    """Rotation vector (3,), in rad, of a unit quaternion (4,), xyzw.

    Value, gradient and Hessian are finite everywhere, also at the identity and at pi.
    """
    v, w = q[:3], q[3]
    sign = ca.if_else(w < 0, -1, 1)
    n = ca.sqrt(ca.dot(v, v) + 1e-24)
    return 2 * ca.atan2(n, sign * w) / n * sign * v


def weighted_errors(edges: Array, residual: str) -> Array:
    """W e (6, m) at x = 0 of the parameters `edges` (m, 35), for the "log" or "vec" residual."""
    return np.asarray(edge_kernel(residual).weighted_error.map(len(edges))(edges.T).full())
