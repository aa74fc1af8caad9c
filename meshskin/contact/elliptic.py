"""Hertz contact with unequal curvatures: the exact ellipse, for NumPy arrays and CasADi.

The gap is A x^2 + B y^2, with relative curvatures 2A and 2B. With semi-axes a and b, Carlson's
integrals R_F and R_D, and p_0 = 3 F / (2 pi a b),

    A = p_0 a b R_D(0, b^2, a^2) / (3 E*),  B = p_0 a b R_D(0, a^2, b^2) / (3 E*),
    delta = p_0 a b R_F(0, a^2, b^2) / E*,  p = p_0 sqrt(1 - x^2/a^2 - y^2/b^2).

Relative to the circular patch a_0, delta_0 with 1/R = A + B, the solution is given by the factors
ln(a/b) / ln(B/A) (aspect), sqrt(a b) / a_0 (size) and delta / delta_0 (depth). They are even and
smooth in ln(B/A), so that one Chebyshev series in its square represents each to 1e-9, without a
branch at the circle. The coefficients are computed from the equations on first use.

Source: K. L. Johnson, "Contact Mechanics" (1985), section 4.2, eq. 4.24-4.33; B. C. Carlson,
Numerical Algorithms 10 (1995).
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np

from ..core.arrays import Array
from . import hertz
from .array_backend import chebyshev_coefficients, chebyshev_nodes, chebyshev_values, functions
from .patch import Patches
from .problem import check_ratio, relative_curvatures

MAX_CURVATURE_RATIO = 1000.0
"""Largest B/A of the series: a patch 61 times as long as wide, beyond any contact of a skin."""
TERMS = 24
"""Terms of the series: the error is below 1e-9 (tests/contact/test_elliptic.py)."""
_MAX_SQUARE = math.log(MAX_CURVATURE_RATIO) ** 2
"""Largest ln(B/A)^2 of the series."""


def patches(force: Any, curvature: Any, indenter_radius: Any, modulus: Any) -> Patches:
    """Elliptic patches of many contacts.

    force (...), N; curvature (..., 2), 1/m; modulus: E*, Pa. NumPy arrays, or CasADi expressions
    with a column of two curvatures, whose ratio B/A is clipped at MAX_CURVATURE_RATIO. Raises
    ContactError for NumPy values out of range.
    """
    radius, aspect, size, depth = _factors(curvature, indenter_radius)
    circle = hertz.contact_radius(force, radius, modulus)
    return Patches(
        first=circle * size * aspect,
        second=circle * size / aspect,
        peak=2 / math.pi * modulus * circle / (radius * size**2),
        depth=hertz.depth(circle, radius) * depth,
    )


def force(depth: Any, curvature: Any, indenter_radius: Any, modulus: Any) -> Any:
    """Force, N, from the approach `depth`, m; zero, with finite derivatives, where depth <= 0.

    Other arguments and errors as in `patches`.
    """
    radius, _, _, factor = _factors(curvature, indenter_radius)
    return hertz.force(depth / factor, radius, modulus)


def slope(depth: Any, curvature: Any, indenter_radius: Any, modulus: Any) -> Any:
    """dF/d(depth), N/m, at approaches > 0, m; other arguments and errors as in `patches`."""
    radius, _, _, factor = _factors(curvature, indenter_radius)
    return hertz.slope(depth / factor, radius, modulus) / factor


def root_aspect(curvature: Any, indenter_radius: Any) -> Any:
    """sqrt(a/b), where a lies along the first principal direction; arguments as in `patches`."""
    return _factors(curvature, indenter_radius)[1]


def exact_factors(log_ratio: float) -> tuple[float, float, float]:
    """Aspect, size and depth at ln(B/A) = `log_ratio` >= 0, by bisection of the equations."""
    from scipy.special import elliprd, elliprf

    def gap(log_aspect: float) -> tuple[float, float]:
        long, short = math.exp(log_aspect), math.exp(-log_aspect)  # squares of a and b, a b = 1
        return elliprd(0, short, long) / 3, elliprd(0, long, short) / 3

    def excess(log_aspect: float) -> float:
        a, b = gap(log_aspect)
        return math.log(b / a) - log_ratio

    circle = log_ratio < 1e-9  # below, rounding dominates the root, and the limit 2/3 is exact
    root, high = 0.0, 0.0 if circle else log_ratio
    while root < (middle := 0.5 * (root + high)) < high:  # until no number lies between
        root, high = (middle, high) if excess(middle) < 0 else (root, middle)
    size = (2 * sum(gap(root)) / math.pi) ** (1 / 3)
    depth = 2 / math.pi / size * elliprf(0, math.exp(root), math.exp(-root))
    return (2 / 3 if circle else root / log_ratio), size, float(depth)


def _factors(curvature: Any, indenter_radius: Any) -> tuple[Any, Any, Any, Any]:
    """R, sqrt(a/b), sqrt(a b)/a_0, delta/delta_0; a lies along the first principal direction."""
    k1, k2 = relative_curvatures(curvature, indenter_radius)
    f = functions(k1, k2)
    log_ratio = f.log(k2 / k1)
    square = log_ratio**2
    if f is np:
        largest = math.exp(math.sqrt(np.max(square, initial=0.0)) - 1e-12)
        check_ratio(largest, MAX_CURVATURE_RATIO, "elliptic")
    aspect, size, depth = chebyshev_values(_series(), f.fmin(2 / _MAX_SQUARE * square, 2.0) - 1)
    return 2 / (k1 + k2), f.exp(log_ratio * aspect / 2), size, depth


@functools.cache
def _series() -> Array:
    """Chebyshev coefficients (TERMS, 3) in ln(B/A)^2 of aspect, size and depth."""
    squares = _MAX_SQUARE / 2 * (1 + chebyshev_nodes(TERMS))
    return chebyshev_coefficients(np.array([exact_factors(math.sqrt(q)) for q in squares]))
