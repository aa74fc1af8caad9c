"""The measurement function: what a taxel reads, its derivatives, and the cost of a reading.

A taxel at x reads, in units of the noise,

    mu = g p_0 M + o,   M = disc mean of (1 - u^2/a^2 - v^2/b^2)^m about (d . t, d . n x t),

d = x - c being its offset from the contact point c, n the normal there, t the direction of the
patch's first semi-axis, a, b, p_0 and m the patch's semi-axes, peak and exponent (a = b, m = 1/2 on
a sphere), g and o the taxel's gain and offset. A reading y costs (mu - y)^2 / 2. A silent one
implies that y is below the threshold, a saturated one that y is above the sensor's range: they are
censored (Tobit) and cost -log Phi(-u), u = mu - threshold or range - mu. Hessians are Gauss-Newton:
J^T J times the cost's curvature in mu, which is positive for all kinds.
"""

from __future__ import annotations

import functools

import casadi as ca
import numpy as np
from scipy.special import erfcx, log_ndtr

from ...contact.disc import disc_mean_of_square
from ...contact.ellipse import ellipse_gradient
from ...contact.learned import ProfileCorrection
from ...core.arrays import Array
from ...core.many_points import ColumnFunction
from .contact_state import Contacts

OBSERVED, CENSORED, SATURATED = 0, 1, -1
"""Kinds of a reading: observed, censored at the threshold, censored at the end of the range; the
sign is that of the censored side."""
MAX_NEGATIVE = 25.0
"""Standard deviations at which u is clipped from below: erfcx overflows below -37, and lambda is
under 1e-135 there."""

MeanAndDerivatives = tuple[Array, Array, tuple[Array, ...]]
"""M (k,), its gradient (k, 3), 1/m, in the offset, and its derivatives (k,) in the patch's shape:
ln a, ln b and m, as far as the contact model has them."""


@functools.cache
def circular_kernel() -> ColumnFunction:
    """(d (3), n (3), a, s) by columns -> M, its gradient in d (3), its derivative in ln a.

    s is the disc's radius.
    """
    x = ca.SX.sym("x", 8)
    d, n, a, s = x[:3], x[3:6], x[6], x[7]
    across = d - n * ca.dot(d, n)
    q, ratio = ca.SX.sym("q"), ca.SX.sym("ratio")
    mean = disc_mean_of_square(q, ratio)
    point = [ca.dot(across, across) / a**2, s / a]
    outputs = (mean, ca.gradient(mean, q), ca.gradient(mean, ratio))
    m, by_q, by_ratio = ca.Function("disc", [q, ratio], outputs).call(point)
    by_log_a = -2 * point[0] * by_q - point[1] * by_ratio
    y = ca.vertcat(m, 2 * by_q / a**2 * across, by_log_a)
    return ColumnFunction("pressure", x, y)


@functools.cache
def elliptic_kernel() -> ColumnFunction:
    """(d (3), n (3), t (3), a, b, s) by columns, m = 1/2 -> M, its gradient in d (3), its
    derivatives in ln a and ln b.
    """
    x = ca.SX.sym("x", 12)
    return ColumnFunction("pressure_elliptic", x, ca.vertcat(*_elliptic_mean(x, 0.5)[:4]))


@functools.cache
def layered_kernel() -> ColumnFunction:
    """(d (3), n (3), t (3), a, b, s, m) by columns -> M, its gradient in d (3), its derivatives in
    ln a, ln b and m.
    """
    x = ca.SX.sym("x", 13)
    return ColumnFunction("pressure_profile", x, ca.vertcat(*_elliptic_mean(x, x[12])))


def _elliptic_mean(x: ca.SX, exponent: ca.SX | float) -> tuple[ca.SX, ...]:
    """M and its derivatives in d (3), ln a, ln b and the exponent, of the inputs `x`."""
    first, second = x[6:9], ca.cross(x[3:6], x[6:9])
    mean, by_x, by_y, *by_shape = ellipse_gradient(
        ca.dot(x[:3], first), ca.dot(x[:3], second), x[9], x[10], x[11], exponent
    )
    return mean, by_x * first + by_y * second, *by_shape


def disc_means(
    model: str, offset: Array, rows: np.ndarray, contacts: Contacts, disc: float
) -> MeanAndDerivatives:
    """M of taxels `offset` (k, 3), m, from the contacts `rows` (k,), with its derivatives.

    model: name of the contact model; disc: radius of a taxel, m.
    """
    patch, normals = contacts.patches, contacts.normals[rows]
    if model == "hertz":
        out = circular_kernel()(len(rows), offset, normals, patch.first[rows], disc)
    else:
        columns = (
            offset, normals, contacts.directions[rows], patch.first[rows], patch.second[rows], disc
        )  # fmt: skip
        if model == "elliptic":
            out = elliptic_kernel()(len(rows), *columns)
        else:
            out = layered_kernel()(len(rows), *columns, patch.exponent[rows])
    return out[0], out[1:4].T, tuple(out[4:])


def corrected_means(
    means: MeanAndDerivatives,
    profile: ProfileCorrection,
    offset: Array,
    rows: np.ndarray,
    contacts: Contacts,
) -> tuple[Array, MeanAndDerivatives]:
    """The basis functions (k, PROFILE_SIZE) of a learned profile, and `means` with its correction;
    offset and rows as in `disc_means`."""
    along, across = contacts.directions[rows], contacts.across[rows]
    a, b = contacts.patches.first[rows], contacts.patches.second[rows]
    x, y = np.einsum("ki,ki->k", offset, along) / a, np.einsum("ki,ki->k", offset, across) / b
    u = np.sqrt(x**2 + y**2 + 1e-12)
    basis, value, slope = profile(u, contacts.profile)
    slope /= u
    mean, by_point, by_shape = means
    by_point = by_point + (slope * x / a)[:, None] * along
    by_point += (slope * y / b)[:, None] * across
    squares = (x**2 + y**2,) if len(contacts.shape) == 1 else (x**2, y**2)
    axes = (by - slope * square for by, square in zip(by_shape, squares, strict=False))
    return basis, (mean + value, by_point, (*axes, *by_shape[len(squares) :]))


def censored(u: Array) -> tuple[Array, Array, Array]:
    """-log Phi(-u) (k,), its derivative lambda(u), and its curvature lambda (lambda - u).

    lambda is the inverse Mills ratio phi(u) / Phi(-u).
    """
    cost = -log_ndtr(-u)
    tail = np.sqrt(2 / np.pi) / erfcx(np.maximum(u, -MAX_NEGATIVE) / np.sqrt(2))
    return cost, tail, np.maximum(tail * (tail - u), 0.0)


def costs(mu: Array, level: Array, kind: Array) -> tuple[Array, Array, Array]:
    """Cost (k,) of readings, its derivative and its curvature in mu, all in units of the noise.

    level: the reading, the threshold, or the end of the range, by `kind`.
    """
    residual = mu - level
    cost, rate, curvature = residual**2 / 2, residual.copy(), np.ones_like(mu)
    rows = np.flatnonzero(kind)
    if len(rows):
        side = kind[rows]
        cost[rows], slope, curvature[rows] = censored(side * residual[rows])
        rate[rows] = side * slope
    return cost, rate, curvature


def robust_costs(mu: Array, level: Array, kind: Array, limit: float) -> tuple[Array, Array, Array]:
    """As `costs`, but those of recorded readings grow linearly from residuals of `limit` on.

    Source: Huber, "Robust estimation of a location parameter", Ann. Math. Stat. 35 (1964).
    """
    cost, rate, curvature = costs(mu, level, kind)
    r = np.abs(mu - level)
    far = (kind == OBSERVED) & (r > limit)
    share = np.where(far, limit / np.maximum(r, limit), 1.0)
    return np.where(far, limit * r - limit**2 / 2, cost), rate * share, curvature * share
