"""Hertz contact of two spheres: closed forms, for NumPy arrays and CasADi expressions alike.

    1/R = 1/R_1 + 1/R_2,  1/E* = (1 - nu_1^2)/E_1 + (1 - nu_2^2)/E_2,
    a = (3 F R / 4 E*)^(1/3),  delta = a^2 / R,  F = 4/3 E* sqrt(R) delta^(3/2),
    p(r) = p_0 sqrt(1 - r^2/a^2),  p_0 = 3 F / (2 pi a^2).

Source: K. L. Johnson, "Contact Mechanics" (1985), section 4.2; Cannata, Denei, Mastrogiovanni,
"Towards Automated Self-Calibration of Robot Skin" (ICRA 2010), eq. 3, 12-15.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ...errors import ContactError
from ..both import functions, is_casadi
from .patch import Patch

MAX_RADIUS_RATIO = 0.6
"""Largest a/R: there, true spheres are 3.6 % off in a and 2.5 % in p_0 (boundary elements)."""
MAX_CURVATURE_RATIO = 1.05
"""Largest ratio of relative curvatures taken for a circle."""
MAX_LAYER_RATIO = 0.1
"""Largest a/thickness taken for a half-space: there, a bonded layer is 7.6 % less deep."""


def effective_modulus(
    young: Any, poisson: Any, indenter_young: Any = math.inf, indenter_poisson: Any = 0.0
) -> Any:
    """Contact modulus E*, Pa, from the Young's moduli, Pa, and Poisson's ratios of the two."""
    compliance = (1 - poisson**2) / young
    return 1 / (compliance + (1 - indenter_poisson**2) / indenter_young)


def relative_radius(curvature: Any, indenter_radius: Any) -> Any:
    """Radius R, m, of the equivalent sphere: 1/R = mean principal curvature + 1/indenter radius.

    `curvature`, 1/m, positive where convex: NumPy (..., 2) or a CasADi column of two. Raises
    ContactError for another shape.
    """
    if is_casadi(curvature):
        mean = (curvature[0] + curvature[1]) / 2
    else:
        pairs = np.asarray(curvature, dtype=float)
        if not pairs.shape or pairs.shape[-1] != 2:
            raise ContactError(
                "both principal curvatures are needed",
                value=f"shape {pairs.shape}",
                limit="(..., 2)",
            )
        mean = pairs.mean(axis=-1)
    return 1 / (mean + 1 / indenter_radius)


def contact_radius(force: Any, radius: Any, modulus: Any) -> Any:
    """Contact radius a, m, from the force, N, the relative radius R, m, and E*, Pa."""
    return (0.75 * force * radius / modulus) ** (1 / 3)


def peak_pressure(force: Any, contact_radius: Any) -> Any:
    """Pressure p_0, Pa, at the centre, from the force, N, and the contact radius a, m."""
    return 1.5 / math.pi * force / contact_radius**2


def depth(contact_radius: Any, radius: Any) -> Any:
    """Approach delta, m, from the contact radius a, m, and the relative radius R, m."""
    return contact_radius**2 / radius


def force(depth: Any, radius: Any, modulus: Any) -> Any:
    """Force, N, from the approach delta, m; zero, with finite derivatives, where delta <= 0."""
    f = functions(depth, radius, modulus)
    positive = f.fmax(depth, 0.0)
    # sqrt(fmax(delta, 0)) alone has an infinite derivative at 0.
    return 4 / 3 * modulus * f.sqrt(radius) * positive * f.sqrt(f.fmax(depth, 1e-12))


def solve(
    *,
    force: float,
    curvature: float | Sequence[float],
    indenter_radius: float,
    modulus: float,
    poisson: float,
    thickness: float | None = None,
) -> Patch:
    """The circular Hertz patch of a rigid sphere on a body; arguments as `contact.solve`.

    Raises ContactError for what leaves the model's range.
    """
    k1, k2 = np.broadcast_to(np.asarray(curvature, dtype=float), 2)
    for what, value, unit in (
        ("indenter radius", indenter_radius, "m"),
        ("modulus", modulus, "Pa"),
        ("thickness", thickness, "m"),
    ):
        if value is not None and not value > 0:
            raise ContactError(f"{what} must be positive", value=f"{value} {unit}", limit="> 0")
    if not (math.isfinite(force) and force >= 0):
        raise ContactError(
            "the indenter can only push", value=f"force {force} N", limit=">= 0 N, finite"
        )
    if not -1 < poisson <= 0.5:
        raise ContactError("Poisson's ratio is outside its range", value=poisson, limit="(-1, 0.5]")
    relative = np.sort([k1 + 1 / indenter_radius, k2 + 1 / indenter_radius])
    if not relative[0] > 0:
        raise ContactError(
            "the body is more hollow than the indenter is round: no single contact point",
            value=f"curvature {min(k1, k2):.4g} 1/m",
            limit=f"> {-1 / indenter_radius:.4g} 1/m",
            remedy="use a smaller indenter",
        )
    if relative[1] > MAX_CURVATURE_RATIO * relative[0]:
        raise ContactError(
            "hertz is for circular patches, and the relative curvatures are unequal",
            value=f"ratio {relative[1] / relative[0]:.3f}",
            limit=f"{MAX_CURVATURE_RATIO}",
            remedy="use a smaller indenter",
        )
    e_star = effective_modulus(modulus, poisson)
    radius = relative_radius((k1, k2), indenter_radius)
    a = contact_radius(force, radius, e_star)
    if a > MAX_RADIUS_RATIO * radius:
        raise ContactError(
            "the contact is too wide for the parabolic gap of hertz",
            value=f"a/R = {a / radius:.2f}",
            limit=MAX_RADIUS_RATIO,
            remedy="lower the force, or raise the modulus or the radii",
        )
    if thickness is not None and a > MAX_LAYER_RATIO * thickness:
        raise ContactError(
            "the layer is too thin for the half-space of hertz",
            value=f"a/thickness = {a / thickness:.2f}",
            limit=MAX_LAYER_RATIO,
            remedy="lower the force, or leave thickness out to accept the half-space",
        )
    peak = peak_pressure(force, a) if a > 0 else 0.0
    return Patch(
        semi_axes=np.array([a, a]), peak=float(peak), depth=float(depth(a, radius)), model="hertz"
    )
