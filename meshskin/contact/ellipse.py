"""What a round taxel reads under any elliptic patch with a profile (1 - q)^m, and its inverse.

With u = x/a, v = y/b and q = u^2 + v^2 the pressure, continued by zero, is the divergence of

    V = phi(q) (u, v) / (2 (m + 1)),  phi(q) = (1 - max(1 - q, 0)^(m+1)) / q,

which is finite and C1 everywhere. By Gauss' theorem the mean over a disc of radius s is a line
integral over its edge,

    M = mean over theta of phi (s + x cos theta + y sin theta) / ((m + 1) s),

without cases: the disc may lie inside the patch, across its edge, around it or beside it. On the
periodic edge the trapezoidal rule converges like nodes^-2.5 (the patch's edge is a kink of order
m + 1), and exponentially where the disc does not meet the patch's edge.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.se3 import Array
from .array_backend import functions

NODES = 48
"""Default nodes; largest error in parts of the peak, m = 1/2, 0.2 < s/sqrt(ab) < 1.6:
6e-5 on a circle, 8e-5 at a/b = 1.5, 3e-4 at 3, 2e-3 at 10 (RMS a fifth of that)."""
_TINY = 1e-12


def ellipse_mean(
    x: Any, y: Any, a: Any, b: Any, s: Any, exponent: Any = 0.5, nodes: int = NODES
) -> Any:
    """Mean of (1 - x^2/a^2 - y^2/b^2)^exponent over the disc of radius `s` centred at (x, y).

    NumPy arrays (broadcast) or CasADi expressions; lengths in one unit; a and b, the semi-axes
    along x and y, in either order. Value and gradient are finite everywhere. The error is given
    at `NODES`.
    """
    f = functions(x, y, a, b, s, exponent)
    hertzian = _is_hertzian(exponent)
    total = 0.0
    for k in range(nodes):
        angle = 2 * math.pi * (k + 0.5) / nodes
        cosine, sine = math.cos(angle), math.sin(angle)
        q = ((x + s * cosine) / a) ** 2 + ((y + s * sine) / b) ** 2
        flux = _hertz_flux(f, q) if hertzian else _flux(f, q, exponent)
        total = total + flux * (s + cosine * x + sine * y)
    return total / (nodes * (exponent + 1) * s)


def ellipse_gradient(
    x: Any, y: Any, a: Any, b: Any, s: Any, exponent: Any = 0.5, nodes: int = NODES
) -> tuple[Any, Any, Any, Any, Any, Any]:
    """`ellipse_mean` and its derivatives by x, y, ln a, ln b and the exponent: those of its sum.

    So cost and gradient of an estimate belong together, whatever the sum's own error (to 2e-6 of
    the derivative, by the floors of what is rooted). Arguments as `ellipse_mean`.
    """
    f = functions(x, y, a, b, s, exponent)
    total: list[Any] = [0.0] * 8
    for k in range(nodes):
        angle = 2 * math.pi * (k + 0.5) / nodes
        cosine, sine = math.cos(angle), math.sin(angle)
        u, v = x / a + s / a * cosine, y / b + s / b * sine
        way = s + cosine * x + sine * y
        flux, by_q, by_exponent = _derivatives(f, u * u + v * v, exponent)
        pull = 2 * by_q * way
        terms = (
            flux * way, flux * cosine, flux * sine, pull * u, pull * v,
            pull * u * u, pull * v * v, by_exponent * way,
        )  # fmt: skip
        total = [t + term for t, term in zip(total, terms, strict=True)]
    one = 1 / (nodes * (exponent + 1) * s)
    mean, turn_x, turn_y, by_u, by_v, by_a, by_b, by_m = (one * t for t in total)
    return mean, turn_x + by_u / a, turn_y + by_v / b, -by_a, -by_b, by_m - mean / (exponent + 1)


def _is_hertzian(exponent: Any) -> bool:
    return isinstance(exponent, float) and exponent == 0.5


def _hertz_flux(f: Any, q: Any) -> Any:
    """phi for m = 1/2, without cancellation: with w = sqrt(1 - q), 1 - w^3 over 1 - w^2."""
    w = f.sqrt(f.fmax(1 - q, _TINY))
    return (1 + w * w / (1 + w)) / f.fmax(q, 1.0)


def _flux(f: Any, q: Any, exponent: Any) -> Any:
    # The floor of q costs no accuracy: 1 - (1 - q)^(m+1) keeps eight digits there.
    q = f.fmax(q, 1e-8)
    return (1 - f.exp((exponent + 1) * f.log(f.fmax(1 - q, _TINY)))) / q


def _derivatives(f: Any, q: Any, exponent: Any) -> tuple[Any, Any, Any]:
    """phi and its derivatives by q and by the exponent."""
    inside, floor = f.fmax(1 - q, _TINY), f.fmax(q, 1e-8)
    log = f.log(inside)
    if _is_hertzian(exponent):
        w, off = f.sqrt(inside), 1 / f.fmax(q, 1.0)
        one = 1 / (1 + w)
        # 1/q^2 outside, where w is next to nothing
        by_q = -0.5 * (1 + one) * one * off * off
        return (1 + w * w * one) * off, by_q, -inside * w * log / floor
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
    """How far from the patch's centre along `direction` (..., 2), unit, the disc mean is `m`.

    Batched. Non-increasing in m (the mean falls along every ray, by Anderson's theorem): `m` at or
    above the maximum gives 0; `m` <= 0 gives a distance at which the disc has left the patch;
    NaN gives NaN. Bracketed regula falsi (Illinois) on sqrt(M), which is steep at the patch's edge.
    """
    way = np.asarray(direction, dtype=float)
    whole = np.broadcast_arrays(m, way[..., 0], way[..., 1], a, b, s, exponent)
    target, ux, uy, first, second, radius, power = (np.ravel(v).astype(float) for v in whole)
    # A supporting half-plane of the patch, moved out by s, bounds where the disc can touch it.
    end = (np.hypot(first * ux, second * uy) + radius) / np.maximum(ux**2 + uy**2, _TINY)
    out = np.where(target > 0, 0.0, end)
    out[np.isnan(target)] = np.nan
    peak = ellipse_mean(0.0, 0.0, first, second, radius, _profile(power), nodes)
    row = np.flatnonzero((target > 0) & (target < peak))
    top, root = np.sqrt(peak[row]), np.sqrt(target[row])
    ray = tuple(v[row] for v in (ux, uy, first, second, radius, power))
    out[row] = _roots(root, top, end[row], ray, nodes)
    return out.reshape(whole[0].shape)


def _roots(root: Array, top: Array, end: Array, ray: tuple[Array, ...], nodes: int) -> Array:
    """Where along k rays, between 0 and `end` (k,), the root of the mean falls from `top` (k,) to
    `root` (k,).
    """
    out, row = end.copy(), np.arange(len(end))
    low, high, at_low, at_high = np.zeros_like(end), end, top - root, -root
    side = np.zeros_like(end)
    for _ in range(60):
        at = (low * at_high - high * at_low) / (at_high - at_low)
        ux, uy, a, b, s, power = ray
        mean = ellipse_mean(at * ux, at * uy, a, b, s, _profile(power), nodes)
        value = np.sqrt(np.maximum(mean, 0.0)) - root
        out[row] = at
        above = value >= 0  # an end that stays counts half as much every time
        at_low = np.where(above, value, np.where(side < 0, at_low / 2, at_low))
        at_high = np.where(above, np.where(side > 0, at_high / 2, at_high), value)
        low, high = np.where(above, at, low), np.where(above, high, at)
        side = np.where(above, 1.0, -1.0)
        left = np.abs(value) > 1e-10
        if not left.any():
            break
        ray = tuple(v[left] for v in ray)
        row, root, low, high, at_low, at_high, side = (
            v[left] for v in (row, root, low, high, at_low, at_high, side)
        )
    return out


def _profile(power: Array) -> Any:
    """The exponents (k,), as one number where all are Hertz's."""
    return 0.5 if np.all(power == 0.5) else power
