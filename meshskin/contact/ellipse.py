"""The reading of a round taxel under an elliptic patch with a profile (1 - q)^m, and its inverse.

With u = x/a, v = y/b and q = u^2 + v^2 the pressure, continued by zero, is the divergence of

    V = phi(q) (u, v) / (2 (m + 1)),  phi(q) = (1 - max(1 - q, 0)^(m+1)) / q,

which is finite and C1 everywhere. By the divergence theorem the mean over a disc of radius s is a
line integral over its edge,

    M = mean over theta of phi (s + x cos theta + y sin theta) / ((m + 1) s),

whether the disc lies inside the patch, across its edge, around it or beside it. The trapezoidal
rule on the periodic edge converges as nodes^-2.5 (the edge of the patch is a kink of order m + 1),
and exponentially where the disc does not meet the edge of the patch.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import Array
from .array_backend import functions
from .disc import MAX_ITERATIONS

NODES = 48
"""Default number of nodes. Largest error relative to the peak, m = 1/2, 0.2 < s/sqrt(ab) < 1.6:
6e-5 on a circle, 8e-5 at a/b = 1.5, 3e-4 at 3, 2e-3 at 10 (RMS a fifth of that;
tests/contact/test_ellipse.py)."""
ROOT_TOLERANCE = 1e-10
"""Residual of sqrt(M) at which `invert_ellipse_mean` ends, far below the quadrature error."""
_MIN_ROOTED = 1e-12
"""Lower bound of 1 - q under roots and logarithms, whose derivatives stay finite."""
_MIN_Q = 1e-8
"""Lower bound of q where phi divides by it: 1 - (1 - q)^(m+1) has eight digits there."""


def ellipse_mean(
    x: Any, y: Any, a: Any, b: Any, s: Any, exponent: Any = 0.5, nodes: int = NODES
) -> Any:
    """Mean of (1 - x^2/a^2 - y^2/b^2)^exponent over the disc of radius `s` centred at (x, y).

    NumPy arrays (broadcast) or CasADi expressions, all lengths in the same unit; a and b are the
    semi-axes along x and y, in either order. Value and gradient are finite everywhere. For the
    error see `NODES`.
    """
    f = functions(x, y, a, b, s, exponent)
    total = 0.0
    for k in range(nodes):
        angle = 2 * math.pi * (k + 0.5) / nodes
        cosine, sine = math.cos(angle), math.sin(angle)
        q = ((x + s * cosine) / a) ** 2 + ((y + s * sine) / b) ** 2
        total = total + _flux(f, q, exponent) * (s + cosine * x + sine * y)
    return total / (nodes * (exponent + 1) * s)


def ellipse_gradient(
    x: Any, y: Any, a: Any, b: Any, s: Any, exponent: Any = 0.5, nodes: int = NODES
) -> tuple[Any, Any, Any, Any, Any, Any]:
    """`ellipse_mean` and its derivatives by x, y, ln a, ln b and the exponent.

    They are the derivatives of the quadrature sum, so that cost and gradient of an estimate are
    consistent whatever the quadrature error (within 2e-6 of the derivative, because of the lower
    bounds under roots). Arguments as in `ellipse_mean`.
    """
    f = functions(x, y, a, b, s, exponent)
    total: list[Any] = [0.0] * 8
    for k in range(nodes):
        angle = 2 * math.pi * (k + 0.5) / nodes
        cosine, sine = math.cos(angle), math.sin(angle)
        u, v = x / a + s / a * cosine, y / b + s / b * sine
        radial = s + cosine * x + sine * y
        flux, by_q, by_exponent = _derivatives(f, u * u + v * v, exponent)
        flux_q = 2 * by_q * radial
        terms = (
            flux * radial, flux * cosine, flux * sine, flux_q * u, flux_q * v,
            flux_q * u * u, flux_q * v * v, by_exponent * radial,
        )  # fmt: skip
        total = [t + term for t, term in zip(total, terms, strict=True)]
    scale = 1 / (nodes * (exponent + 1) * s)
    mean, direct_x, direct_y, by_u, by_v, by_a, by_b, by_m = (scale * t for t in total)
    return (
        mean,
        direct_x + by_u / a,
        direct_y + by_v / b,
        -by_a,
        -by_b,
        by_m - mean / (exponent + 1),
    )


def _is_hertzian(exponent: Any) -> bool:
    return isinstance(exponent, float) and exponent == 0.5


def _flux(f: Any, q: Any, exponent: Any) -> Any:
    """phi, for m = 1/2 without cancellation: (1 - w^3) / (1 - w^2) with w = sqrt(1 - q)."""
    if _is_hertzian(exponent):
        w = f.sqrt(f.fmax(1 - q, _MIN_ROOTED))
        return (1 + w * w / (1 + w)) / f.fmax(q, 1.0)
    q = f.fmax(q, _MIN_Q)
    return (1 - f.exp((exponent + 1) * f.log(f.fmax(1 - q, _MIN_ROOTED)))) / q


def _derivatives(f: Any, q: Any, exponent: Any) -> tuple[Any, Any, Any]:
    """phi and its derivatives by q and by the exponent."""
    inside, floor = f.fmax(1 - q, _MIN_ROOTED), f.fmax(q, _MIN_Q)
    log = f.log(inside)
    if _is_hertzian(exponent):
        w, outside = f.sqrt(inside), 1 / f.fmax(q, 1.0)
        r = 1 / (1 + w)
        # 1/q^2 outside, where w is about 0
        by_q = -0.5 * (1 + r) * r * outside * outside
        return (1 + w * w * r) * outside, by_q, -inside * w * log / floor
    power = f.exp(exponent * log)
    flux = (1 - power * inside) / floor
    return flux, ((exponent + 1) * power - flux) / floor, -power * inside * log / floor


def invert_ellipse_mean(
    m: ArrayLike,
    direction: ArrayLike,
    a: ArrayLike,
    b: ArrayLike,
    s: ArrayLike,
    exponent: ArrayLike = 0.5,
    nodes: int = NODES,
) -> Array:
    """The distance from the patch's centre along `direction` (..., 2), unit, with disc mean `m`.

    Batched. Non-increasing in m (the mean falls along every ray, by Anderson's theorem): `m` at or
    above the maximum gives 0; `m` <= 0 gives a distance at which the disc has left the patch; NaN
    gives NaN. The Illinois variant of regula falsi on sqrt(M), which is steep at the patch's edge.
    """
    unit = np.asarray(direction, dtype=float)
    broadcast = np.broadcast_arrays(m, unit[..., 0], unit[..., 1], a, b, s, exponent)
    target, ux, uy, first, second, radius, power = (np.ravel(v).astype(float) for v in broadcast)
    # a supporting half-plane of the patch, moved outwards by s, bounds where the disc meets it
    end = (np.hypot(first * ux, second * uy) + radius) / np.maximum(ux**2 + uy**2, _MIN_ROOTED)
    out = np.where(target > 0, 0.0, end)
    out[np.isnan(target)] = np.nan
    peak = ellipse_mean(0.0, 0.0, first, second, radius, _profile(power), nodes)
    row = np.flatnonzero((target > 0) & (target < peak))
    top, root = np.sqrt(peak[row]), np.sqrt(target[row])
    ray = tuple(v[row] for v in (ux, uy, first, second, radius, power))
    out[row] = _roots(root, top, end[row], ray, nodes)
    return out.reshape(broadcast[0].shape)


def _roots(root: Array, top: Array, end: Array, ray: tuple[Array, ...], nodes: int) -> Array:
    """The distances (k,) along k rays at which sqrt(M) is `root` (k,).

    Between 0, where it is `top` (k,), and `end` (k,), where it is 0.
    """
    out, row = end.copy(), np.arange(len(end))
    low, high, at_low, at_high = np.zeros_like(end), end, top - root, -root
    side = np.zeros_like(end)
    for _ in range(MAX_ITERATIONS):
        at = (low * at_high - high * at_low) / (at_high - at_low)
        ux, uy, a, b, s, power = ray
        mean = ellipse_mean(at * ux, at * uy, a, b, s, _profile(power), nodes)
        value = np.sqrt(np.maximum(mean, 0.0)) - root
        out[row] = at
        above = value >= 0  # Illinois: halve the value at the end that stays
        at_low = np.where(above, value, np.where(side < 0, at_low / 2, at_low))
        at_high = np.where(above, np.where(side > 0, at_high / 2, at_high), value)
        low, high = np.where(above, at, low), np.where(above, high, at)
        side = np.where(above, 1.0, -1.0)
        open_ = np.abs(value) > ROOT_TOLERANCE
        if not open_.any():
            break
        ray = tuple(v[open_] for v in ray)
        row, root, low, high, at_low, at_high, side = (
            v[open_] for v in (row, root, low, high, at_low, at_high, side)
        )
    return out


def _profile(power: Array) -> Any:
    """The exponents (k,), or the number 1/2 where all are that of Hertz."""
    return 0.5 if np.all(power == 0.5) else power
