"""Hertz contact of two spheres: closed forms for NumPy arrays and CasADi expressions.

    1/R = 1/R_1 + 1/R_2,  1/E* = (1 - nu_1^2)/E_1 + (1 - nu_2^2)/E_2,
    a = (3 F R / 4 E*)^(1/3),  delta = a^2 / R,  F = 4/3 E* sqrt(R) delta^(3/2),
    p(r) = p_0 sqrt(1 - r^2/a^2),  p_0 = 3 F / (2 pi a^2).

Source: K. L. Johnson, "Contact Mechanics" (1985), section 4.2; Cannata, Denei, Mastrogiovanni,
"Towards Automated Self-Calibration of Robot Skin" (ICRA 2010), eq. 3, 12-15.
"""

from __future__ import annotations

import math
from typing import Any

from .array_backend import functions, is_casadi, positive_part
from .patch import Patches
from .problem import MIN_RELATIVE_CURVATURE, principal_curvatures

MAX_CURVATURE_RATIO = 1.05
"""Largest ratio of relative curvatures for a circular patch: at it the semi-axes of the ellipse
differ by 3.3 % (a/b = ratio^(2/3)) and the peak pressure changes by 0.013 %."""


def relative_radius(curvature: Any, indenter_radius: Any) -> Any:
    """Radius R, m, of the equivalent sphere: 1/R = mean principal curvature + 1/indenter radius.

    `curvature`, 1/m, positive where convex, as in `problem.principal_curvatures`. CasADi
    expressions are bounded as in `problem.relative_curvatures`: a closed loop may pass a hollow.
    """
    k1, k2 = principal_curvatures(curvature)
    tip = 1 / indenter_radius
    relative = (k1 + k2) / 2 + tip
    if is_casadi(curvature):
        relative = functions(curvature).fmax(relative, MIN_RELATIVE_CURVATURE * tip)
    return 1 / relative


def contact_radius(force: Any, radius: Any, modulus: Any) -> Any:
    """Contact radius a, m, from the force, N, the relative radius R, m, and E*, Pa."""
    return (0.75 * force * radius / modulus) ** (1 / 3)


def depth(contact_radius: Any, radius: Any) -> Any:
    """Approach delta, m, from the contact radius a, m, and the relative radius R, m."""
    return contact_radius**2 / radius


def force(depth: Any, radius: Any, modulus: Any) -> Any:
    """Force, N, from the approach delta, m; zero, with finite derivatives, where delta <= 0."""
    f = functions(depth, radius, modulus)
    # sqrt(fmax(delta, 0)) alone has an infinite derivative at 0
    root = f.sqrt(f.fmax(depth, 1e-12))
    return 4 / 3 * modulus * f.sqrt(radius) * positive_part(depth) * root


def slope(depth: Any, radius: Any, modulus: Any) -> Any:
    """dF/d(depth), N/m, at approaches delta > 0, m; other arguments as in `force`."""
    return 2 * modulus * functions(depth, radius, modulus).sqrt(radius * depth)


def patches(force: Any, curvature: Any, indenter_radius: Any, modulus: Any) -> Patches:
    """Circular patches of the mean curvature for many contacts.

    force (...), N; curvature (..., 2), 1/m; modulus: E*, Pa. NumPy arrays, or CasADi expressions
    with a column of two curvatures.
    """
    radius = relative_radius(curvature, indenter_radius)
    a = contact_radius(force, radius, modulus)
    return Patches(a, a, 2 / math.pi * modulus * a / radius, depth(a, radius))
