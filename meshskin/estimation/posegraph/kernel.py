"""The edge kernel: cost, gradient and Hessian of one displacement, the same for all graphs.

Unknowns of an edge (i, j) are local increments x = (p, a) of its two poses, six numbers each, with
the Cayley retraction R <- R C(l_r a), t <- t + R l_t p and the scales (l_t, l_r) in m and rad. The
displacement that follows from the current poses is a parameter, and so are the measured one and
the root W of the information matrix (W^T W = Omega): relinearising and reweighting need no new
kernel. With q_err the rotation by which the displacement misses its measurement, the residual is

    e = (t - delta_t, Log(q_err))     "log": the geodesic objective
    e = (t - delta_t, 2 vec(q_err))   "vec": the chordal objective, and a wide basin

and the cost |W e|^2 / 2. The Hessian is J^T J + blend * (curvature of the residual): Gauss-Newton
at blend 0, exact at 1.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import casadi as ca
import numpy as np

from ...core import se3

RELATIVE = 7
"""Numbers of a displacement: translation (3) in m, quaternion (4) xyzw."""
ROOT = 21
"""Entries of the upper triangle of W, row by row."""
EDGE = 2 * RELATIVE + ROOT
"""Numbers of an edge: displacement now, displacement measured, W."""
LOWER = [(r, c) for r in range(6) for c in range(r + 1)]
"""Lower triangle of a block, row by row."""


@dataclass(frozen=True)
class Kernel:
    """Functions of one edge: (x (12,), edge (35,), scale (2,)[, blend]) -> their value."""

    gradient: ca.Function
    """Cost, gradient (12,)."""
    gauss_newton: ca.Function
    """As `hessian` at blend 0, at a third of its price."""
    hessian: ca.Function
    """78 entries of the Hessian in three outputs: of pose i (21,) and of pose j (21,) the lower
    triangle, row by row; between them the block (6, 6) with the rows of i, row by row (36,)."""


@functools.cache
def kernel(residual: str) -> Kernel:
    """The kernel of a `residual`, "log" or "vec"."""
    x, edge, scale = ca.SX.sym("x", 12), ca.SX.sym("edge", EDGE), ca.SX.sym("s", 2)
    blend, fixed = ca.SX.sym("blend"), ca.SX.sym("fixed", 6)
    e = error(residual, x, edge[:RELATIVE], edge[RELATIVE : 2 * RELATIVE], scale)
    root = _upper(edge[2 * RELATIVE :])
    weighted = ca.mtimes(root, e)
    cost = ca.dot(weighted, weighted) / 2
    jacobian = ca.mtimes(root, ca.jacobian(e, x))
    curvature = ca.hessian(ca.dot(fixed, e), x)[0]
    curvature = ca.substitute(curvature, fixed, ca.mtimes(root.T, weighted))
    square = ca.mtimes(jacobian.T, jacobian)
    inputs = [x, edge, scale]

    def function(name: str, inputs: list[ca.SX], outputs: list[ca.SX]) -> ca.Function:
        return ca.Function(f"{residual}_{name}", inputs, outputs, {"cse": True})

    return Kernel(
        gradient=function("gradient", inputs, [cost, ca.gradient(cost, x)]),
        gauss_newton=function("gauss_newton", inputs, _blocks(square)),
        hessian=function("hessian", [*inputs, blend], _blocks(square + blend * curvature)),
    )


def _blocks(hessian: ca.SX) -> list[ca.SX]:
    """The three outputs of `Kernel.hessian`."""
    return [
        ca.vertcat(*(hessian[r, c] for r, c in LOWER)),
        ca.vertcat(*(hessian[6 + r, 6 + c] for r, c in LOWER)),
        ca.vec(hessian[:6, 6:].T),
    ]


def error(residual: str, x: ca.SX, relative: ca.SX, measured: ca.SX, scale: ca.SX) -> ca.SX:
    """e (6,) of the displacement D(x_i)^-1 T_ij D(x_j) against the measured one."""
    p_i, p_j = scale[0] * x[:3], scale[0] * x[6:9]
    c_i, c_j = se3.casadi_cayley(scale[1] * x[3:6]), se3.casadi_cayley(scale[1] * x[9:])
    t, q = relative[:3], relative[3:]
    moved = t + ca.mtimes(se3.casadi_rotation(q), p_j) - p_i
    translation = ca.mtimes(se3.casadi_rotation(se3.casadi_conjugate(c_i)), moved)
    turned = se3.casadi_quaternion_product(q, c_j)
    turned = se3.casadi_quaternion_product(se3.casadi_conjugate(c_i), turned)
    missed = se3.casadi_quaternion_product(se3.casadi_conjugate(measured[3:]), turned)
    rotation = 2 * missed[:3] if residual == "vec" else se3.casadi_log(missed)
    return ca.vertcat(translation - measured[:3], rotation)


def _upper(entries: ca.SX) -> ca.SX:
    """Upper-triangular matrix (6, 6) from its entries (21,), row by row."""
    matrix = ca.SX.zeros(6, 6)
    for k, (r, c) in enumerate(zip(*np.triu_indices(6), strict=True)):
        matrix[int(r), int(c)] = entries[k]
    return matrix
