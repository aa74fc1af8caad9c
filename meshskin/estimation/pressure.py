"""The pressure factor: what one reading says about its taxel's position and about E*.

Unknowns of a reading are x = (y_1, y_2, e): the taxel's coordinates in its chart in units of a
length L, and e = ln(E*/E*_nominal), shared. With u = u_0 + M y + g (y^T K y)/2 the taxel's offset
in the contact's tangent plane, in units of the contact radius a_0 at nominal E*, and with
a = a_0 exp(-e/3), p_0 ~ exp(2e/3),

    mu = p_0 exp(2e/3) disc_mean(|u| exp(e/3), s_0 exp(e/3)).

A reading y above the threshold costs (mu - y)^2 / 2 in units of the noise; a silent one is
censored (Tobit) and costs -log Phi(-(mu - threshold)). Hessians are Gauss-Newton: J^T J times the
curvature of the cost in mu, which is positive for both.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import casadi as ca
import numpy as np

from ..compiled import compiled
from ..physics.contact.disc import disc_mean_of_square
from ..se3 import Array
from .chart import Charts
from .measurements import Measurements

PARAMETERS = 14
"""u_0 (2), M (4, by columns), g (2), K (11, 12, 22), s_0, p_0 and y or threshold over sigma."""
LOWER = [(r, c) for c in range(3) for r in range(c, 3)]
"""Hessian entries, column by column."""


@dataclass(frozen=True)
class Kernel:
    """Compiled functions of one reading: (x (3,), parameters (14,)) -> value, or more."""

    value: ca.Function
    """Cost."""
    gradient: ca.Function
    """Cost, gradient (3,)."""
    hessian: ca.Function
    """Lower triangle of the Hessian (6,), in the order of `LOWER`."""
    residual: ca.Function
    """mu less y or threshold, over sigma; its derivatives (3,); the cost's curvature in mu."""


@functools.cache
def kernel(kind: str) -> Kernel:
    """The kernel of an "active" or a "silent" reading."""
    x, p = ca.SX.sym("x", 3), ca.SX.sym("p", PARAMETERS)
    residual = _residual(x, p)
    jacobian = ca.gradient(residual, x)
    if kind == "silent":
        cost, rate, curvature = _censored(residual)
    else:
        cost, rate, curvature = residual**2 / 2, residual, ca.SX(1.0)
    lower = ca.vertcat(*(curvature * jacobian[r] * jacobian[c] for r, c in LOWER))

    def function(name: str, *outputs: ca.SX) -> ca.Function:
        return compiled(ca.Function(f"{kind}_{name}", [x, p], list(outputs), {"cse": True}))

    return Kernel(
        value=function("value", cost),
        gradient=function("gradient", cost, rate * jacobian),
        hessian=function("hessian", lower),
        residual=function("residual", residual, jacobian, curvature),
    )


def _residual(x: ca.SX, p: ca.SX) -> ca.SX:
    y, e = x[:2], x[2]
    sag = (p[8] * y[0] ** 2 + 2 * p[9] * y[0] * y[1] + p[10] * y[1] ** 2) / 2
    u = p[:2] + p[2:4] * y[0] + p[4:6] * y[1] + p[6:8] * sag
    stretch = ca.exp(e / 3)
    mean = disc_mean_of_square(ca.dot(u, u) * stretch**2, p[11] * stretch)
    return p[12] * stretch**2 * mean - p[13]


def _censored(x: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """-log Phi(-x), its derivative lambda(x), and its curvature lambda (lambda - x).

    lambda is the inverse Mills ratio. Beyond x = 4, 1 - erf loses digits: a continued fraction
    (Abramowitz and Stegun 26.2.14) takes over.
    """
    near, far = ca.fmin(x, 4.0), ca.fmax(x, 4.0)
    tail = (1 - ca.erf(near / math.sqrt(2))) / 2
    density = ca.exp(-(near**2) / 2) / math.sqrt(2 * math.pi)
    ratio = far
    for k in range(40, 0, -1):
        ratio = far + k / ratio
    beyond = far**2 / 2 + ca.log(ratio * math.sqrt(2 * math.pi))
    cost = ca.if_else(x > 4.0, beyond, -ca.log(tail))
    rate = ca.if_else(x > 4.0, ratio, density / tail)
    return cost, rate, ca.fmax(rate * (rate - x), 0.0)


def parameters(
    data: Measurements,
    charts: Charts,
    contact: np.ndarray,
    taxel: np.ndarray,
    level: Array | float,
    length: float,
) -> Array:
    """Parameters (14, k) of readings (contact, taxel) with charts (n) of the taxels.

    `level`, Pa: the pressures of active readings, or the threshold of silent ones. `length`, m, is
    the unit L of the charts' coordinates.
    """
    a, n = data.radii[contact], data.normals[contact]
    plane = _plane(data.normals)[contact]  # (k, 3, 2)
    offset = charts.points[taxel] - data.points[contact]
    u = np.einsum("kij,ki->kj", plane, offset) / a[:, None]
    m = np.einsum("kij,kil->klj", plane, charts.tangents[taxel]) * (length / a)[:, None, None]
    g = -np.einsum("kij,ki->kj", plane, charts.normals[taxel]) * (length**2 / a)[:, None]
    k = charts.shape[taxel]
    return np.vstack(
        [
            u.T,
            m.reshape(len(n), 4).T,
            g.T,
            [k[:, 0, 0], k[:, 0, 1], k[:, 1, 1]],
            [data.disc / a, data.peaks[contact] / data.sigma],
            np.broadcast_to(level / data.sigma, len(n))[None],
        ]
    )


def _plane(normals: Array) -> Array:
    """An orthonormal basis (m, 3, 2) across each normal, without branches.

    Source: Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 6 (2017).
    """
    x, y, z = normals.T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=1)
    return np.stack([first, np.stack([b, sign + y * y * a, -y], axis=1)], axis=2)
