"""The reading of a round taxel: the mean over a disc of the Hertz profile sqrt(1 - r^2), r < 1.

Lengths are in contact radii: rho is the distance of the disc's centre from the contact point, s is
the disc's radius. The disc is cut into slices perpendicular to the line of centres. At x the disc
extends to h = sqrt(s^2 - (x - rho)^2) and the patch to sqrt(1 - x^2); the two circles meet at x*.
Slices before x* end on the disc, slices after it on the patch:

    pi s^2 M = integral_lo^x* [h w + (1 - x^2) atan2(h, w)] dx + pi/2 [x - x^3/3]_x*^hi,
    w^2 = 1 - x^2 - h^2.

Both integrals are free of branches, and M is C1 in rho and s.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import Array
from .array_backend import functions

if TYPE_CHECKING:
    from ..core.many_points import ColumnFunction

NODES = 8
"""Nodes of the quadrature over the slices, by default: the error is below 1e-5."""
_MIN_SQUARE = 1e-12
"""Lower bound under square roots, whose derivatives stay finite: 1e-6 contact radii."""
_MIN_RHO_SQUARE = 1e-10
"""Added to rho^2, so that rho has derivatives at 0; M changes by about 1e-10."""
MAX_ITERATIONS = 60
"""Iterations of the bracketed root finders: bisection alone reaches 1e-18 of the bracket."""


def disc_mean(rho: Any, s: Any, nodes: int = NODES) -> Any:
    """Mean of sqrt(1 - r^2) over the disc of radius `s` > 0 centred at distance `rho` >= 0.

    NumPy arrays (broadcast) or CasADi expressions. Value, gradient and Hessian are finite
    everywhere, including rho = 0. Zero where rho >= 1 + s.
    """
    return disc_mean_of_square(rho * rho, s, nodes)


def disc_mean_of_square(q: Any, s: Any, nodes: int = NODES) -> Any:
    """`disc_mean` as a function of q = rho^2, which is smooth in positions where rho is not."""
    f = functions(q, s)
    rho = f.sqrt(q + _MIN_RHO_SQUARE)
    lo, cut, hi = _limits(f, rho, s)
    total = math.pi / 2 * ((hi - hi**3 / 3) - (cut - cut**3 / 3))
    for weight, x, h, w in _slices(f, rho, s, lo, cut, nodes):
        total = total + weight * (h * w + (1 - x * x) * f.atan2(h, w))
    return total / (math.pi * s * s)


def disc_slope(rho: Array, s: Array) -> Array:
    """Derivative of `disc_mean` by rho: pi s^2 M' = integral_lo^x* 2 w (x - rho) / h dx."""
    return np.asarray(_mean_and_slope(rho, s)[1])


def _mean_and_slope(rho: Any, s: Any) -> tuple[Any, Any]:
    """`disc_mean` and `disc_slope` from the same slices."""
    f = functions(rho, s)
    rho = f.sqrt(rho * rho + _MIN_RHO_SQUARE)
    lo, cut, hi = _limits(f, rho, s)
    mean = math.pi / 2 * ((hi - hi**3 / 3) - (cut - cut**3 / 3))
    slope = 0.0 * (rho * s)
    for weight, x, h, w in _slices(f, rho, s, lo, cut, NODES):
        mean = mean + weight * (h * w + (1 - x * x) * f.atan2(h, w))
        slope = slope + weight * 2 * w * (x - rho) / h
    area = math.pi * s * s
    return mean / area, slope / area


@functools.cache
def _compiled() -> ColumnFunction:
    """`_mean_and_slope` of columns rho and s."""
    import casadi as ca

    from ..core.many_points import ColumnFunction

    x = ca.SX.sym("x", 2)
    return ColumnFunction("disc_mean", x, ca.vertcat(*_mean_and_slope(x[0], x[1])))


def _limits(f: Any, rho: Any, s: Any) -> tuple[Any, Any, Any]:
    """Limits of the slices: lo, x*, hi; all equal where disc and patch do not overlap."""
    lo = f.fmin(f.fmax(rho - s, -1.0), 1.0)
    hi = f.fmin(rho + s, 1.0)
    cut = f.fmin(f.fmax((1 - s * s + rho * rho) / (2 * rho), lo), hi)
    return lo, cut, hi


def _slices(
    f: Any, rho: Any, s: Any, lo: Any, cut: Any, nodes: int
) -> Iterator[tuple[Any, Any, Any, Any]]:
    """Quadrature of the slices that end on the disc: weight, x, h, w of each node."""
    half = (cut - lo) / 2
    for cosine, weight in _rule(nodes):
        x = lo + half * (1 + cosine)
        h = f.sqrt(f.fmax(s * s - (x - rho) ** 2, _MIN_SQUARE))
        w = f.sqrt(f.fmax(1 - s * s + rho * rho - 2 * rho * x, _MIN_SQUARE))
        yield weight * half, x, h, w


@functools.cache
def _rule(nodes: int) -> tuple[tuple[float, float], ...]:
    """Gauss-Legendre in the angle t of x = cos t: (cosine, weight).

    The substitution removes the square-root singularities at the ends.
    """
    x, weight = np.polynomial.legendre.leggauss(nodes)
    angle = np.pi / 2 * (x + 1)
    return tuple(
        (math.cos(t), math.pi / 2 * k * math.sin(t)) for t, k in zip(angle, weight, strict=True)
    )


def invert_disc_mean(m: ArrayLike, s: ArrayLike, tolerance: float = 1e-10) -> Array:
    """The distance rho at which `disc_mean(rho, s)` is `m`, batched, to `tolerance`.

    Non-increasing in m. `m` at or above the maximum gives 0; `m` <= 0 gives 1 + s, where the disc
    leaves the patch; NaN gives NaN. Newton steps with a bracket.
    """
    target, radius = np.broadcast_arrays(np.asarray(m, dtype=float), np.asarray(s, dtype=float))
    return _invert(target.ravel(), radius.ravel(), tolerance).reshape(target.shape)


def _invert(m: Array, s: Array, tolerance: float) -> Array:
    out = np.where(m <= 0, 1.0 + s, 0.0)
    out[np.isnan(m) | np.isnan(s)] = np.nan
    row = np.flatnonzero((m > 0) & (m < _compiled()(len(s), np.zeros_like(s), s)[0]))
    m, s = m[row], s[row]
    # below s - 1 the patch lies inside the disc and the mean is constant: no root there
    low, high = np.fmax(s - 1.0, 0.0), 1.0 + s
    rho = (low + high) / 2
    for _ in range(MAX_ITERATIONS):
        if not len(row):
            break
        mean, slope = _compiled()(len(rho), rho, s)
        excess = mean - m
        low, high = np.where(excess >= 0, rho, low), np.where(excess >= 0, high, rho)
        # Newton's step for sqrt(M) = sqrt(m): M vanishes quadratically at the edge of the patch
        root = np.sqrt(np.maximum(mean, 0.0))
        slope = np.where(slope < 0, slope, -_MIN_SQUARE)
        trial = rho - 2 * root * (root - np.sqrt(m)) / slope
        inside = (trial > low) & (trial < high)
        new = np.where(inside, trial, (low + high) / 2)
        done = np.abs(new - rho) < tolerance
        out[row[done]] = new[done]
        row = row[~done]
        m, s, low, high, rho = (v[~done] for v in (m, s, low, high, new))
    out[row] = rho
    return out
