"""The pressure factor: what one reading says about its taxel's position and the contact.

A taxel at x reads, in units of the noise,

    mu = g p_0 M(|v| / a, s / a) + o,   v = d - (d . n) n,   d = x - c,

c being the contact point, n its normal, a and p_0 the radius and the peak of the Hertz patch, s the
disc's radius, M the disc mean, g and o the taxel's gain and offset (patches that are no circles:
pressure_elliptic.py). A reading y costs (mu - y)^2 / 2. A silent one says that y is below the
threshold, a saturated one that y is above the sensor's range: they are censored (Tobit) and cost
-log Phi(-u), u = mu - threshold or range - mu. Hessians are Gauss-Newton: J^T J times the cost's
curvature in mu, which is positive for all.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from ...contact.disc import disc_mean_of_square
from ...core.codegen import compile_function
from ...core.se3 import Array
from .batch import BATCH, evaluate

if TYPE_CHECKING:
    from .contacts import Contacts

INPUTS = 8
OBSERVED, CENSORED, SATURATED = 0, 1, -1
"""Kinds of a reading; the sign is that of the censored side."""


@functools.cache
def kernel() -> ca.Function:
    """(d (3), n (3), a, s) by columns -> M, its gradient in d (3), its derivative in ln a."""
    x = ca.SX.sym("x", INPUTS)
    d, n, a, s = x[:3], x[3:6], x[6], x[7]
    across = d - n * ca.dot(d, n)
    q, ratio = ca.SX.sym("q"), ca.SX.sym("ratio")
    mean = disc_mean_of_square(q, ratio)
    point = [ca.dot(across, across) / a**2, s / a]
    outputs = (mean, ca.gradient(mean, q), ca.gradient(mean, ratio))
    m, by_q, by_ratio = ca.Function("disc", [q, ratio], outputs).call(point)
    by_log_a = -2 * point[0] * by_q - point[1] * by_ratio
    out = ca.vertcat(m, 2 * by_q / a**2 * across, by_log_a)
    return compile_function(ca.Function("pressure", [x], [out], {"cse": True})).map(BATCH)


def mean_pressure(d: Array, n: Array, a: Array, s: float) -> tuple[Array, Array, Array]:
    """M (k,), its gradient in d (k, 3), 1/m, and its derivative in ln a (k,).

    d, n (k, 3): the taxel's offset from the contact, m, and the contact's normal; a (k,), m.
    """
    out = evaluate(kernel(), len(a), d, n, a, s)
    return out[:, 0], out[:, 1:4], out[:, 4]


def circle(
    offset: Array, rows: np.ndarray, contacts: Contacts, disc: float
) -> tuple[Array, Array, tuple[Array, ...]]:
    """M (k,) of taxels `offset` (k, 3), m, from the contacts `rows`, its gradient, 1/m, and its
    derivatives in the patch's shape: ln a.
    """
    mean, by_point, by_log_a = mean_pressure(
        offset, contacts.normals[rows], contacts.patches.first[rows], disc
    )
    return mean, by_point, (by_log_a,)


def censored(u: Array) -> tuple[Array, Array, Array]:
    """-log Phi(-u) (k,), its derivative lambda(u), and its curvature lambda (lambda - u).

    lambda is the inverse Mills ratio phi(u) / Phi(-u).
    """
    from scipy.special import erfcx, log_ndtr

    cost = -log_ndtr(-u)
    tail = np.sqrt(2 / np.pi) / erfcx(np.maximum(u, -25.0) / np.sqrt(2))
    return cost, tail, np.maximum(tail * (tail - u), 0.0)


def costs(mu: Array, level: Array, kind: Array) -> tuple[Array, Array, Array]:
    """Cost (k,) of readings, its derivative and its curvature in mu, all in units of the noise.

    `level`: the reading, the threshold, or the end of the range, by `kind`.
    """
    residual = mu - level
    cost, rate, curvature = residual**2 / 2, residual.copy(), np.ones_like(mu)
    rows = np.flatnonzero(kind)
    if len(rows):
        side = kind[rows]
        cost[rows], slope, curvature[rows] = censored(side * residual[rows])
        rate[rows] = side * slope
    return cost, rate, curvature
