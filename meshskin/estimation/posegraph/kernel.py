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
    root = _upper(edge[2 * DISPLACEMENT :])
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
    c_i, c_j = se3.casadi_cayley(scale[1] * x[3:6]), se3.casadi_cayley(scale[1] * x[9:])
    t, q = current[:3], current[3:]
    moved = t + ca.mtimes(se3.casadi_rotation(q), p_j) - p_i
    translation = ca.mtimes(se3.casadi_rotation(se3.casadi_conjugate(c_i)), moved)
    rotated = se3.casadi_quaternion_product(q, c_j)
    rotated = se3.casadi_quaternion_product(se3.casadi_conjugate(c_i), rotated)
    q_err = se3.casadi_quaternion_product(se3.casadi_conjugate(measured[3:]), rotated)
    rotation = 2 * q_err[:3] if residual == "vec" else se3.casadi_log(q_err)
    return ca.vertcat(translation - measured[:3], rotation)


def weighted_errors(edges: Array, residual: str) -> Array:
    """W e (6, m) at x = 0 of the parameters `edges` (m, 35), for the "log" or "vec" residual."""
    return np.asarray(edge_kernel(residual).weighted_error.map(len(edges))(edges.T).full())


def _upper(entries: ca.SX) -> ca.SX:
    """Upper-triangular matrix (6, 6) of its entries (21,), by rows."""
    matrix = ca.SX.zeros(6, 6)
    for k, (r, c) in enumerate(zip(*UPPER, strict=True)):
        matrix[int(r), int(c)] = entries[k]
    return matrix
