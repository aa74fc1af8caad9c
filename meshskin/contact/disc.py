"""What a round taxel reads: the mean over a disc of the Hertz profile sqrt(1 - r^2), r < 1.

Lengths are in contact radii: rho is the distance of the disc's centre from the contact point, s is
the disc's radius. The disc is cut in slices along the line of centres. At x the disc reaches to
h = sqrt(s^2 - (x - rho)^2) and the patch to sqrt(1 - x^2); the two circles meet at x*. Slices
before x* end on the disc, slices after it on the patch:

    pi s^2 M = integral_lo^x* [h w + (1 - x^2) atan2(h, w)] dx + pi/2 [x - x^3/3]_x*^hi,
    w^2 = 1 - x^2 - h^2.

Both integrals are without branches, and M is C1 in rho and s.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.se3 import Array
from .array_backend import functions

_TINY = 1e-12


def disc_mean(rho: Any, s: Any, nodes: int = 8) -> Any:
    """Mean of sqrt(1 - r^2) over the disc of radius `s` > 0 centred at distance `rho` >= 0.

    NumPy arrays (broadcast) or CasADi expressions; the value, gradient and Hessian are finite
    everywhere, at rho = 0 too. Zero where rho >= 1 + s. Eight nodes: error below 1e-5.
    """
    return disc_mean_of_square(rho * rho, s, nodes)


def disc_mean_of_square(q: Any, s: Any, nodes: int = 8) -> Any:
    """`disc_mean` as a function of q = rho^2, for callers who have no smooth rho at zero."""
    f = functions(q, s)
    rho = f.sqrt(q + 1e-10)
    lo, cut, hi = _limits(f, rho, s)
    half = (cut - lo) / 2
    total = math.pi / 2 * ((hi - hi**3 / 3) - (cut - cut**3 / 3))
    for cosine, weight in _rule(nodes):
        x = lo + half * (1 + cosine)
        h = f.sqrt(f.fmax(s * s - (x - rho) ** 2, _TINY))
        w = f.sqrt(f.fmax(1 - s * s + rho * rho - 2 * rho * x, _TINY))
        total = total + weight * half * (h * w + (1 - x * x) * f.atan2(h, w))
    return total / (math.pi * s * s)


def invert_disc_mean(m: ArrayLike, s: ArrayLike, nodes: int = 8, tolerance: float = 1e-10) -> Array:
    """The distance rho at which `disc_mean(rho, s)` is `m`: non-increasing in m, batched.

    `m` at or above the maximum gives 0; `m` <= 0 gives 1 + s, where the disc leaves the patch.
    NaN gives NaN. Bracketed Newton steps.
    """
    target, radius = np.broadcast_arrays(np.asarray(m, dtype=float), np.asarray(s, dtype=float))
    return _invert(target.ravel(), radius.ravel(), nodes, tolerance).reshape(target.shape)


def _invert(m: Array, s: Array, nodes: int, tolerance: float) -> Array:
    out = np.where(m <= 0, 1.0 + s, 0.0)
    out[np.isnan(m) | np.isnan(s)] = np.nan
    row = np.flatnonzero((m > 0) & (m < disc_mean(np.zeros_like(s), s, nodes)))
    m, s = m[row], s[row]
    # Below s - 1 the patch lies inside the disc and the profile is flat: no root there.
    low, high = np.fmax(s - 1.0, 0.0), 1.0 + s
    rho = (low + high) / 2
    for _ in range(60):
        excess = disc_mean(rho, s, nodes) - m
        low, high = np.where(excess >= 0, rho, low), np.where(excess >= 0, high, rho)
        step = _newton_step(excess, m, disc_slope(rho, s, nodes))
        trial = rho - step
        inside = (trial > low) & (trial < high)
        new = np.where(inside, trial, (low + high) / 2)
        done = np.abs(new - rho) < tolerance
        out[row[done]] = new[done]
        row = row[~done]
        m, s, low, high, rho = (v[~done] for v in (m, s, low, high, new))
        if not len(row):
            break
    out[row] = rho
    return out


def disc_slope(rho: Array, s: Array, nodes: int = 8) -> Array:
    """Derivative of `disc_mean` by rho, NumPy: pi s^2 M' = integral_lo^x* 2 w (x - rho) / h dx."""
    rho = np.sqrt(rho * rho + 1e-10)
    lo, cut, _ = _limits(functions(), rho, s)
    half = (cut - lo) / 2
    total = np.zeros_like(half)
    for cosine, weight in _rule(nodes):
        x = lo + half * (1 + cosine)
        h = np.sqrt(np.fmax(s * s - (x - rho) ** 2, _TINY))
        w = np.sqrt(np.fmax(1 - s * s + rho * rho - 2 * rho * x, _TINY))
        total = total + weight * half * 2 * w * (x - rho) / h
    return np.asarray(total / (np.pi * s * s))


def _limits(f: Any, rho: Any, s: Any) -> tuple[Any, Any, Any]:
    """Ends of the slices: lo, x*, hi; all equal where the disc is off the patch."""
    lo = f.fmin(f.fmax(rho - s, -1.0), 1.0)
    hi = f.fmin(rho + s, 1.0)
    cut = f.fmin(f.fmax((1 - s * s + rho * rho) / (2 * rho), lo), hi)
    return lo, cut, hi


@functools.cache
def _rule(nodes: int) -> tuple[tuple[float, float], ...]:
    """Gauss-Legendre in the angle t of x = cos t: (cosine, weight); it absorbs root-like ends."""
    x, weight = np.polynomial.legendre.leggauss(nodes)
    angle = np.pi / 2 * (x + 1)
    return tuple(
        (math.cos(t), math.pi / 2 * k * math.sin(t)) for t, k in zip(angle, weight, strict=True)
    )


def _newton_step(excess: Array, m: Array, slope: Array) -> Array:
    """Newton's step for sqrt(M) = sqrt(m): M falls like a square towards the patch's edge."""
    value = np.maximum(excess + m, 0.0)
    slope = np.where(slope < 0, slope, -_TINY)
    return 2 * np.sqrt(value) * (np.sqrt(value) - np.sqrt(m)) / slope
