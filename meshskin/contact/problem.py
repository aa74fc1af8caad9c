"""What is pressed on what, checked, and the limits that the contact models share."""

from __future__ import annotations

import math
import numbers
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..core.arguments import check_array, repr_short
from ..core.errors import ContactError
from ..core.se3 import Array
from .array_backend import functions, is_casadi

MAX_WIDTH = 0.52
"""Largest a/R_s of a parabolic gap, 1/R_s^2 = 1/r^2 - k/r + k^2 for a sphere of radius r on the
curvature k: there, boundary elements on true arcs are 4 % off in a and 2.5 % in p_0."""
MAX_LAYER_RATIO = 0.1
"""Largest a/thickness taken for a half-space: there, a bonded layer is 7.6 % less deep."""

FIELD = 'contact.solve(model="field") holds for a single contact'
"""Of a remedy: scenes and estimators do not take boundary elements."""
HOLLOWEST = 1e-3
"""Least relative curvature of CasADi expressions, in parts of the indenter's."""


@dataclass(frozen=True)
class ContactProblem:
    """A rigid spherical indenter on a body: the arguments of `contact.solve`, checked.

    Raises ContactError for values that are no contact at all, whatever the model.
    """

    force: float
    curvature: float | Sequence[float]
    indenter_radius: float
    modulus: float
    poisson: float
    thickness: float | None = None

    def __post_init__(self) -> None:
        for what in ("force", "indenter_radius", "modulus", "poisson", "thickness"):
            value = getattr(self, what)
            if value is not None and not isinstance(value, numbers.Real | np.ndarray):
                raise ContactError(f"{what} must be a number", value=repr_short(value))
        check_array("curvature", self.curvature, error=ContactError)
        for what, value, unit in (
            ("indenter radius", self.indenter_radius, "m"),
            ("modulus", self.modulus, "Pa"),
            ("thickness", self.thickness, "m"),
        ):
            if value is not None and not value > 0:
                raise ContactError(f"{what} must be positive", value=f"{value} {unit}", limit="> 0")
        if not (math.isfinite(self.force) and self.force >= 0):
            raise ContactError(
                "the indenter can only push", value=f"force {self.force} N", limit=">= 0 N, finite"
            )
        if not -1 < self.poisson <= 0.5:
            raise ContactError(
                "Poisson's ratio is outside its range", value=self.poisson, limit="(-1, 0.5]"
            )
        if np.shape(self.curvature) not in ((), (1,), (2,)):
            raise ContactError(
                "a surface has two principal curvatures", value=self.curvature, limit="one or two"
            )
        if not np.isfinite(self.pair).all():
            raise ContactError("a curvature is not finite", value=self.curvature)
        if not self.relative[0] > 0:
            raise ContactError(
                "the body is more hollow than the indenter is round: no single contact point",
                value=f"curvature {self.pair.min():.4g} 1/m",
                limit=f"> {-1 / self.indenter_radius:.4g} 1/m",
                remedy="use a smaller indenter",
            )

    @cached_property
    def pair(self) -> Array:
        """Both principal curvatures (2,) of the body, 1/m."""
        return np.array(np.broadcast_to(np.asarray(self.curvature, dtype=float), 2))

    @cached_property
    def relative(self) -> Array:
        """Relative principal curvatures (2,), 1/m, smaller first."""
        return np.sort(self.pair + 1 / self.indenter_radius)

    @property
    def ratio(self) -> float:
        """Ratio B/A >= 1 of the relative curvatures."""
        return float(self.relative[1] / self.relative[0])

    @property
    def e_star(self) -> float:
        """Contact modulus E*, Pa, of the body against the rigid indenter."""
        return self.modulus / (1 - self.poisson**2)

    @property
    def radius(self) -> float:
        """Relative radius R, m: one over the mean relative curvature."""
        return float(2 / self.relative.sum())

    def refuse_wide(self, axes: Array, model: str) -> None:
        """Raise ContactError where semi-axes (2,), larger first, leave the parabolic gap."""
        widest = float(width(axes, np.sort(self.pair), self.indenter_radius))
        if widest > MAX_WIDTH:
            raise ContactError(
                f"the contact is too wide for the parabolic gap of {model}",
                value=f"a/R = {widest:.3g} (1/R^2 = 1/r^2 - k/r + k^2)",
                limit=MAX_WIDTH,
                remedy=f"lower the force, or raise the modulus or the radii; {FIELD}",
            )

    def refuse_layer(self, axes: Array, model: str) -> None:
        """Raise ContactError where the layer is too thin for a half-space under the patch."""
        if self.thickness is not None and axes[0] > MAX_LAYER_RATIO * self.thickness:
            raise ContactError(
                f"the layer is too thin for the half-space of {model}",
                value=f"a/thickness = {axes[0] / self.thickness:.3g}",
                limit=MAX_LAYER_RATIO,
                remedy='take contact = "layered", or leave thickness out to accept the half-space',
            )


def width(axes: Array, curvature: Array, indenter_radius: float) -> Array:
    """a/R_s (...), the larger along the semi-axes (..., 2), m, at curvature (..., 2), 1/m.

    True arcs add r^4 (k_1^3 + k_2^3) / 8 to the gap r^2 (k_1 + k_2) / 2 of two curvatures, so
    the error goes with a^2 (k_1^2 - k_1 k_2 + k_2^2) / 4.
    """
    tip = 1 / indenter_radius
    return np.asarray(
        np.max(axes * np.sqrt(tip**2 - tip * curvature + curvature**2), axis=-1), dtype=float
    )


def principal_curvatures(curvature: Any) -> tuple[Any, Any]:
    """The two columns of `curvature`: NumPy (..., 2), or a CasADi column of two.

    Raises ContactError for another shape.
    """
    if is_casadi(curvature):
        return curvature[0], curvature[1]
    pairs = np.asarray(curvature, dtype=float)
    if not pairs.shape or pairs.shape[-1] != 2:
        raise ContactError(
            "both principal curvatures are needed", value=f"shape {pairs.shape}", limit="(..., 2)"
        )
    return pairs[..., 0], pairs[..., 1]


def relative_curvatures(curvature: Any, indenter_radius: Any) -> tuple[Any, Any]:
    """Relative curvatures, 1/m, along the two principal directions, in the order of `curvature`.

    `curvature`, 1/m, positive where convex, as `principal_curvatures`. CasADi's are held above
    zero: a step of the closed loop stays finite in a hollow. Raises ContactError where the body is
    more hollow than the indenter is round.
    """
    k1, k2 = principal_curvatures(curvature)
    tip = 1 / indenter_radius
    first, second = k1 + tip, k2 + tip
    if is_casadi(curvature):
        f = functions(curvature)
        return f.fmax(first, HOLLOWEST * tip), f.fmax(second, HOLLOWEST * tip)
    if not (np.all(first > 0) and np.all(second > 0)):
        raise ContactError(
            "the body is more hollow than the indenter is round: no single contact point",
            value=f"curvature {min(np.min(k1), np.min(k2)):.4g} 1/m",
            limit="> -1/indenter radius",
            remedy="use a smaller indenter",
        )
    return first, second
