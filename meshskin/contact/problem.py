"""The contact problem: the arguments of `contact.solve`, and limits that the models share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..core.arguments import check_array, check_real
from ..core.arrays import Array
from ..core.errors import ContactError
from .array_backend import functions, is_casadi

MAX_WIDTH = 0.52
"""Largest a/R_s for a parabolic gap, 1/R_s^2 = 1/r^2 - k/r + k^2 for a sphere of radius r on the
curvature k. At this limit boundary elements with circular arcs differ by 4 % in a and 2.5 % in p_0
(tests/contact/test_models.py)."""
MAX_LAYER_RATIO = 0.1
"""Largest a/thickness for a half-space: there the approach on a bonded layer is 5 %
(Poisson's ratio 0) to 7.5 % (1/2) smaller (tests/contact/test_layered.py)."""
MIN_RELATIVE_CURVATURE = 1e-3
"""Lower bound on relative curvatures in CasADi expressions, in units of 1/(indenter radius): they
stay positive where an iterate of the closed loop or an optimizer passes a hollow. Far below the
relative curvature of a valid contact."""

FIELD_REMEDY = 'contact.solve(model="field") holds for a single contact'
"""Remedy in messages: scenes and estimators do not accept the model "field"."""
NOT_FINITE = "curvature must be finite"
HOLLOW = "the hollow of the body is tighter than the indenter: no single contact point"
UNEQUAL = "the relative principal curvatures are too unequal for {}"
WIDE = "the contact is too wide for the contact model {}"
THIN = "the layer is too thin for the half-space of {}"
"""Limits of a contact in words; {}: the name of a model."""


@dataclass(frozen=True)
class ContactProblem:
    """A rigid spherical indenter pressed on a body: the checked arguments of `contact.solve`.

    Raises ContactError for values that no contact model accepts.
    """

    force: float
    """Contact force, N."""
    curvature: float | Sequence[float]
    """Principal curvatures of the body, 1/m, positive where convex; one number: both are equal."""
    indenter_radius: float
    """Radius of the indenter, m."""
    modulus: float
    """Young's modulus of the body, Pa."""
    poisson: float
    """Poisson's ratio of the body."""
    thickness: float | None = None
    """Thickness of the soft layer of the body, m; None: a half-space."""

    def __post_init__(self) -> None:
        check_real("modulus", self.modulus, "Pa", above=0.0, error=ContactError)
        for name in ("indenter_radius", "thickness"):  # inf: a plane, a half-space
            value = getattr(self, name)
            if value is not None and not np.array_equal(value, math.inf):
                check_real(name, value, "m", above=0.0, error=ContactError)
        check_real("force", self.force, "N", least=0.0, error=ContactError)
        check_real("poisson", self.poisson, above=-1.0, most=0.5, error=ContactError)
        check_array("curvature", self.curvature, error=ContactError)
        if np.shape(self.curvature) not in ((), (1,), (2,)):
            raise ContactError(
                "curvature must be one or two principal curvatures",
                value=self.curvature,
                limit="one or two numbers",
            )
        if not np.isfinite(self.curvature_pair).all():
            raise ContactError(NOT_FINITE, value=self.curvature)
        relative_curvatures(self.curvature_pair, self.indenter_radius)

    @cached_property
    def curvature_pair(self) -> Array:
        """Both principal curvatures (2,) of the body, 1/m."""
        return np.array(np.broadcast_to(np.asarray(self.curvature, dtype=float), 2))

    @property
    def curvature_ratio(self) -> float:
        """Ratio B/A >= 1 of the relative principal curvatures."""
        low, high = np.sort(self.curvature_pair + 1 / self.indenter_radius)
        return float(high / low)

    @property
    def effective_modulus(self) -> float:
        """Contact modulus E* = E / (1 - nu^2), Pa, of the body against a rigid indenter."""
        return self.modulus / (1 - self.poisson**2)

    def check_width(self, axes: Array, model: str) -> None:
        """Raise ContactError where semi-axes (2,), m, larger first, exceed the parabolic gap."""
        ratio = float(width_ratio(axes, np.sort(self.curvature_pair), self.indenter_radius))
        if ratio > MAX_WIDTH:
            raise ContactError(
                WIDE.format(model),
                value=f"a/R = {ratio:.3g} (1/R^2 = 1/r^2 - k/r + k^2)",
                limit=MAX_WIDTH,
                remedy=f"lower the force, or raise the modulus or the radii; {FIELD_REMEDY}",
            )

    def check_thickness(self, axes: Array, model: str) -> None:
        """Raise ContactError where the layer under the patch is too thin for a half-space."""
        if self.thickness is not None and axes[0] > MAX_LAYER_RATIO * self.thickness:
            raise ContactError(
                THIN.format(model),
                value=f"a/thickness = {axes[0] / self.thickness:.3g}",
                limit=MAX_LAYER_RATIO,
                remedy='use contact = "layered", or omit thickness to assume a half-space',
            )


def check_ratio(ratio: float, limit: float, model: str) -> None:
    """Raise ContactError where the `ratio` B/A of relative curvatures exceeds a model's `limit`."""
    if not ratio <= limit:
        smaller = "use a smaller indenter"
        remedies = {
            "hertz": f'use contact = "elliptic", or {smaller}',
            "layered": f"{smaller}; {FIELD_REMEDY}",
        }
        raise ContactError(
            UNEQUAL.format(model),
            value=f"ratio {ratio:.4g}",
            limit=f"{limit:g}",
            remedy=remedies.get(model, smaller),
        )


def width_ratio(axes: Array, curvature: Array, indenter_radius: float) -> Array:
    """a/R_s (...), the larger of both semi-axes (..., 2), m, at curvature (..., 2), 1/m.

    Circular arcs add r^4 (k_1^3 + k_2^3) / 8 to the gap r^2 (k_1 + k_2) / 2 of two curvatures, so
    that the error is proportional to a^2 (k_1^2 - k_1 k_2 + k_2^2) / 4.
    """
    tip = 1 / indenter_radius
    return np.asarray(
        np.max(axes * np.sqrt(tip**2 - tip * curvature + curvature**2), axis=-1), dtype=float
    )


def principal_curvatures(curvature: Any) -> tuple[Any, Any]:
    """The two columns of `curvature`: a NumPy array (..., 2), or a CasADi column of two.

    Raises ContactError for another shape.
    """
    if is_casadi(curvature):
        return curvature[0], curvature[1]
    pairs = np.asarray(curvature, dtype=float)
    if not pairs.shape or pairs.shape[-1] != 2:
        raise ContactError(
            "curvature must hold both principal curvatures",
            value=f"shape {pairs.shape}",
            limit="(..., 2)",
        )
    return pairs[..., 0], pairs[..., 1]


def relative_curvatures(curvature: Any, indenter_radius: Any) -> tuple[Any, Any]:
    """Relative curvatures, 1/m, along the two principal directions, in the order of `curvature`.

    `curvature`, 1/m, positive where convex, as in `principal_curvatures`. CasADi expressions are
    bounded from below by MIN_RELATIVE_CURVATURE. Raises ContactError where the body is more concave
    than the indenter is convex.
    """
    k1, k2 = principal_curvatures(curvature)
    tip = 1 / indenter_radius
    first, second = k1 + tip, k2 + tip
    if is_casadi(curvature):
        f, least = functions(curvature), MIN_RELATIVE_CURVATURE * tip
        return f.fmax(first, least), f.fmax(second, least)
    if not (np.all(first > 0) and np.all(second > 0)):
        raise ContactError(
            HOLLOW,
            value=f"curvature {min(np.min(k1), np.min(k2)):.4g} 1/m",
            limit=f"> {-np.min(tip):.4g} 1/m",
            remedy="use a smaller indenter",
        )
    return first, second


def effective_modulus(
    young: Any, poisson: Any, indenter_young: Any = math.inf, indenter_poisson: Any = 0.0
) -> Any:
    """Contact modulus E*, Pa, of two bodies with Young's moduli, Pa, and Poisson's ratios."""
    compliance = (1 - poisson**2) / young
    return 1 / (compliance + (1 - indenter_poisson**2) / indenter_young)
