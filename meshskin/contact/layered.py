"""A thin elastic layer bonded to a rigid core: Hertz's patch with tabulated factors.

On a layer of thickness t, the ratios of contact radius, peak pressure and approach to Hertz's on a
half-space of the same E* depend only on chi = a_Hertz / t and Poisson's ratio. The table holds them
at Chebyshev points of chi / (1 + chi) and of Poisson's ratio, computed with boundary elements
(`field`) by studies/layer_table.py. At chi = 0, an infinite thickness, all are 1. For one Poisson's
ratio they are series in chi / (1 + chi).

The profile is p_0 (1 - x^2/a^2 - y^2/b^2)^m with m = pi a b p_0 / F - 1, whose integral is the
force F. An elliptic patch takes the factors of chi = sqrt(a b)_Hertz / t, and its ln(a/b) is
Hertz's times a fourth factor, tabulated for relative curvatures 2 : 1 (on a thin compressible layer
a/b tends to (B/A)^(1/2), near the circle of a half-space to (B/A)^(2/3)).

On circles, a, p_0 and depth are within 0.2 % of an axisymmetric finite-element contact (chi 0.1 to
5, Poisson's ratio 0.3 to 0.49). The profile is less accurate: means over discs of half the patch's
radius differ by up to 2 % of p_0 on circles and 3.5 % at B/A = 3.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..core.arrays import Array
from ..core.errors import ContactError
from . import elliptic
from .array_backend import (
    chebyshev_coefficients,
    chebyshev_nodes,
    chebyshev_values,
    functions,
    positive_part,
)
from .patch import Patches
from .problem import FIELD_REMEDY

MAX_CHI = 10.0
"""Largest a_Hertz / thickness of the table: there the approach is 0.08 (Poisson's ratio 1/2) to
0.23 (0) of Hertz's."""
CHIS, POISSONS = 21, 15
"""Chebyshev points of the table in chi / (1 + chi) and in Poisson's ratio, 0 to 0.5."""
MAX_CURVATURE_RATIO = 3.0
"""Largest B/A: there, p_0 differs by up to 3 % and the axes by up to 2 % from those of `field`."""
TOO_THIN = "the layer is too thin for the table of layered"
TABLE = Path(__file__).with_name("layered.csv")
"""The table: chi, Poisson's ratio, and the four factors."""
_MAX_ARGUMENT = MAX_CHI / (1 + MAX_CHI)
"""Largest chi / (1 + chi) of the series."""


@dataclass(frozen=True)
class BondedLayer:
    """A bonded layer: the factors for its Poisson's ratio, and forces from approaches."""

    poisson: float
    """Poisson's ratio of the layer, 0 to 0.5."""
    thickness: float
    """Thickness t, m; inf for a half-space."""

    def __post_init__(self) -> None:
        if not 0 <= self.poisson <= 0.5:
            raise ContactError(
                "Poisson's ratio is outside the table of layered",
                value=self.poisson,
                limit="[0, 0.5]",
                remedy=f'without a layer use "elliptic"; {FIELD_REMEDY}',
            )
        if not self.thickness > 0:
            raise ContactError(
                "thickness must be positive", value=f"{self.thickness} m", limit="> 0"
            )

    def factors(self, chi: Any) -> tuple[Any, Any, Any, Any]:
        """Radius, peak pressure, approach and ln(a/b), relative to Hertz's, at `chi` = a_Hertz / t.

        NumPy arrays, or CasADi expressions, which are clipped at the end of the table.
        """
        f = functions(chi)
        y = f.fmin(2 / _MAX_ARGUMENT * chi / (1 + chi), 2.0) - 1
        radius, peak, depth, aspect = chebyshev_values(_factor_series(self.poisson), y)
        return f.exp(radius), f.exp(peak), f.exp(depth), f.exp(aspect)

    def chi(self, force: Any, curvature: Any, indenter_radius: Any, modulus: Any) -> Any:
        """a_Hertz / t of many contacts; arguments as in `elliptic.patches`."""
        hertz = elliptic.patches(force, curvature, indenter_radius, modulus)
        return _mean_radius(hertz) / self.thickness

    def patches(self, force: Any, curvature: Any, indenter_radius: Any, modulus: Any) -> Patches:
        """Patches of many contacts; arguments as in `elliptic.patches`, `modulus` is E*, Pa.

        Raises ContactError for NumPy values outside the table.
        """
        hertz = elliptic.patches(force, curvature, indenter_radius, modulus)
        size = _mean_radius(hertz)
        chi = size / self.thickness
        if functions(size) is np and not (largest := float(np.max(chi, initial=0.0))) <= MAX_CHI:
            raise ContactError(
                TOO_THIN,
                value=f"a_Hertz/thickness = {largest:.3g}",
                limit=f"{MAX_CHI:g}",
                remedy=f"lower the force, or use a thicker layer; {FIELD_REMEDY}",
            )
        radius, peak, depth, aspect = self.factors(chi)
        root_aspect = elliptic.root_aspect(curvature, indenter_radius) ** aspect
        return Patches(
            first=size * radius * root_aspect,
            second=size * radius / root_aspect,
            peak=hertz.peak * peak,
            depth=hertz.depth * depth,
            exponent=1.5 * radius**2 * peak - 1,
        )

    def force(self, depth: Any, curvature: Any, indenter_radius: Any, modulus: Any) -> Any:
        """Force, N, from the approach `depth`, m; zero, with finite derivatives, where depth <= 0.

        Other arguments as in `patches`. Beyond the table the force grows like Hertz's.
        """
        f = functions(depth, curvature, indenter_radius, modulus)
        positive = positive_part(depth)
        unit = elliptic.patches(1.0, curvature, indenter_radius, modulus)
        # on the half-space a = a_1 (d/d_1)^(1/2), the square root finite at 0 by its lower bound
        scale = _mean_radius(unit) / self.thickness
        z = scale * f.sqrt(f.fmax(positive / unit.depth, 1e-12))
        y = f.fmin(2 * z / (1 + z) / _max_depth_argument(self.poisson), 2.0) - 1
        (log_factor,) = chebyshev_values(_depth_series(self.poisson), y)
        # the approach of a half-space under the same force
        return elliptic.force(positive * f.exp(log_factor), curvature, indenter_radius, modulus)


def _mean_radius(patches: Patches) -> Any:
    """sqrt(a b), m."""
    return functions(patches.first, patches.second).sqrt(patches.first * patches.second)


@functools.cache
def _table() -> Array:
    """Coefficients (CHIS, POISSONS, 4) of the logarithms of the table's columns."""
    rows = np.loadtxt(TABLE, delimiter=",", skiprows=1)
    values = np.log(rows[:, 2:]).reshape(CHIS, POISSONS, 4)
    along = chebyshev_coefficients(values)
    return np.swapaxes(chebyshev_coefficients(np.swapaxes(along, 0, 1)), 0, 1)


@functools.lru_cache(maxsize=64)
def _factor_series(poisson: float) -> Array:
    """Coefficients (CHIS, 4) in chi / (1 + chi) for one Poisson's ratio."""
    basis = np.polynomial.chebyshev.chebvander(4 * poisson - 1, POISSONS - 1)[0]
    return np.asarray(np.einsum("ijk,j->ik", _table(), basis))


def _max_depth_argument(poisson: float) -> float:
    """z / (1 + z) at the end of the table, where z = chi sqrt(depth factor) = sqrt(depth R) / t."""
    log_factor = sum(_factor_series(poisson)[:, 2])  # the value of the series at its end
    z = MAX_CHI * math.exp(log_factor / 2)
    return z / (1 + z)


@functools.lru_cache(maxsize=64)
def _depth_series(poisson: float) -> Array:
    """Coefficients (2 CHIS, 1) in z / (1 + z) of -ln(depth factor), see _max_depth_argument."""
    from scipy.optimize import brentq

    layer = BondedLayer(poisson, 1.0)

    def excess(y: float, z: float) -> float:
        chi = y / (1 - y)
        return chi * math.sqrt(float(layer.factors(np.float64(chi))[2])) - z

    values = []
    for y in _max_depth_argument(poisson) * (1 + chebyshev_nodes(2 * CHIS)) / 2:
        z = y / (1 - y)
        root = brentq(excess, 0.0, _MAX_ARGUMENT + 1e-9, args=(z,), xtol=1e-14) if z > 0 else 0.0
        values.append([-math.log(float(layer.factors(np.float64(root / (1 - root)))[2]))])
    return chebyshev_coefficients(np.array(values))
