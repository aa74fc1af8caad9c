"""A thin elastic layer bonded to a rigid core: Hertz with tabulated factors.

Radius, peak pressure and approach on a layer of thickness t, in parts of Hertz's on a half-space
of the same E*, depend only on chi = a_Hertz / t and Poisson's ratio. The table holds them at
Chebyshev points of chi / (1 + chi) and of Poisson's ratio, as the project's boundary elements
(`field`) give them: studies/layer_table.py writes it. At chi = 0, an infinite thickness, all are 1
and the patch is Hertz's. For one Poisson's ratio there remain three series in chi / (1 + chi).

The profile is p_0 (1 - x^2/a^2 - y^2/b^2)^m, m = pi a b p_0 / F - 1, which carries the force
exactly. An elliptic patch takes the factors of chi = sqrt(a b)_Hertz / t, and its ln(a/b) is
Hertz's times a fourth factor, tabulated for relative curvatures 2 : 1 (on a thin compressible layer
a/b tends to (B/A)^(1/2), near the circle of a half-space to (B/A)^(2/3)).

On circles, a, p_0 and depth are within 0.2 % of an axisymmetric finite-element contact (chi 0.1 to
5, Poisson's ratio 0.3 to 0.49). The profile is the weaker part: means over discs of half the
patch's radius are off by up to 2 % of p_0 on circles, 3.5 % at B/A = 3.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import ContactError
from ..core.se3 import Array
from . import elliptic
from .array_backend import chebyshev_coefficients, chebyshev_nodes, chebyshev_values, functions
from .patch import Patch, Patches
from .problem import FIELD, ContactProblem

MAX_CHI = 10.0
"""Largest a_Hertz / thickness of the table."""
CHIS, POISSONS = 21, 15
"""Chebyshev points of the table in chi / (1 + chi) and in Poisson's ratio, 0 to 0.5."""
MAX_CURVATURE_RATIO = 3.0
"""Largest B/A: there, p_0 is up to 3 % and the axes up to 2 % off those of `field`."""
TABLE = Path(__file__).with_name("layered.csv")
_END = MAX_CHI / (1 + MAX_CHI)


@dataclass(frozen=True)
class BondedLayer:
    """A bonded layer: the factors of its Poisson's ratio, and the forces of its depths."""

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
                remedy=f'without a layer take "elliptic"; {FIELD}',
            )
        if not self.thickness > 0:
            raise ContactError("thickness must be positive", value=f"{self.thickness} m")

    def factors(self, chi: Any) -> tuple[Any, Any, Any, Any]:
        """Radius, peak pressure, approach, ln(a/b) in parts of Hertz's at `chi` = a_Hertz / t.

        NumPy arrays, or CasADi expressions (there held at the end of the table).
        """
        f = functions(chi)
        y = f.fmin(2 / _END * chi / (1 + chi), 2.0) - 1
        radius, peak, depth, aspect = chebyshev_values(_factors(self.poisson), y)
        return f.exp(radius), f.exp(peak), f.exp(depth), f.exp(aspect)

    def chi(self, force: Any, curvature: Any, indenter_radius: Any, modulus: Any) -> Any:
        """a_Hertz / t of many contacts; arguments as `elliptic.patches`."""
        whole = elliptic.patches(force, curvature, indenter_radius, modulus)
        return _size(whole) / self.thickness

    def patches(self, force: Any, curvature: Any, indenter_radius: Any, modulus: Any) -> Patches:
        """Patches of many contacts; arguments as `elliptic.patches`, `modulus` is E*, Pa.

        Raises ContactError for NumPy values outside the range of the table.
        """
        whole = elliptic.patches(force, curvature, indenter_radius, modulus)
        size = _size(whole)
        chi = size / self.thickness
        if functions(size) is np:
            refuse_chi(float(np.max(chi, initial=0.0)))
        radius, peak, depth, aspect = self.factors(chi)
        stretch = elliptic.stretch(curvature, indenter_radius) ** aspect
        return Patches(
            first=size * radius * stretch,
            second=size * radius / stretch,
            peak=whole.peak * peak,
            depth=whole.depth * depth,
            exponent=1.5 * radius**2 * peak - 1,
        )

    def force(self, depth: Any, curvature: Any, indenter_radius: Any, modulus: Any) -> Any:
        """Force, N, from the approach `depth`, m; zero, with finite derivatives, where <= 0.

        Other arguments as `patches`. Beyond the table the force grows like Hertz's from its end.
        """
        # the depth that a half-space would take under the same force
        f = functions(depth, curvature, indenter_radius, modulus)
        sunk = f.fmax(depth, 0.0)
        one = elliptic.patches(1.0, curvature, indenter_radius, modulus)
        # a = a_1 (d/d_1)^(1/2) on the half-space; the square root is finite at 0 by its floor
        mean = _size(one) / self.thickness
        reach = mean * f.sqrt(f.fmax(sunk / one.depth, 1e-12))
        y = f.fmin(2 * reach / (1 + reach) / _sunken_end(self.poisson), 2.0) - 1
        (stiffer,) = chebyshev_values(_sunken(self.poisson), y)
        return elliptic.force(sunk * f.exp(stiffer), curvature, indenter_radius, modulus)


def solve(setting: ContactProblem) -> Patch:
    """The patch of a rigid sphere on a bonded layer.

    Without a thickness, of a half-space. Raises ContactError for what leaves the model's range.
    """
    if setting.ratio > MAX_CURVATURE_RATIO:
        raise ContactError(
            "the patch is too long for the factors of layered",
            value=f"ratio of relative curvatures {setting.ratio:.3g}",
            limit=f"{MAX_CURVATURE_RATIO:g}",
            remedy=f"use a smaller indenter; {FIELD}",
        )
    layer = BondedLayer(
        setting.poisson, math.inf if setting.thickness is None else setting.thickness
    )
    found = layer.patches(setting.force, setting.pair, setting.indenter_radius, setting.e_star)
    axes = np.sort([found.first, found.second])[::-1]
    setting.refuse_wide(axes, "layered")
    return Patch(
        axes, float(found.peak), float(found.depth), "layered", exponent=float(found.exponent)
    )


def _size(whole: Patches) -> Any:
    """sqrt(a b), m."""
    return functions(whole.first, whole.second).sqrt(whole.first * whole.second)


def refuse_chi(chi: float) -> None:
    """Raise ContactError where chi leaves the table."""
    if not chi <= MAX_CHI:
        raise ContactError(
            "the layer is thinner than the table of layered goes",
            value=f"a_Hertz/thickness = {chi:.3g}",
            limit=f"{MAX_CHI:g}",
            remedy=f"lower the force, or take a thicker layer; {FIELD}",
        )


@functools.cache
def _table() -> Array:
    """Coefficients (CHIS, POISSONS, 4) of the logarithms of the table's columns."""
    rows = np.loadtxt(TABLE, delimiter=",", skiprows=1)
    values = np.log(rows[:, 2:]).reshape(CHIS, POISSONS, 4)
    along = chebyshev_coefficients(values)
    return np.swapaxes(chebyshev_coefficients(np.swapaxes(along, 0, 1)), 0, 1)


@functools.lru_cache(maxsize=64)
def _factors(poisson: float) -> Array:
    """Coefficients (CHIS, 4) in chi / (1 + chi) for one Poisson's ratio."""
    basis = np.polynomial.chebyshev.chebvander(4 * poisson - 1, POISSONS - 1)[0]
    return np.asarray(np.einsum("ijk,j->ik", _table(), basis))


def _sunken_end(poisson: float) -> float:
    """z / (1 + z) at the end of the table, z = chi sqrt(depth factor): chi by its depth."""
    depth = sum(_factors(poisson)[:, 2])
    end = MAX_CHI * math.exp(depth / 2)
    return end / (1 + end)


@functools.lru_cache(maxsize=64)
def _sunken(poisson: float) -> Array:
    """Coefficients (2 CHIS, 1) in z / (1 + z) of -ln(depth factor), z = sqrt(depth R) / t."""
    from scipy.optimize import brentq

    layer = BondedLayer(poisson, 1.0)

    def excess(y: float, z: float) -> float:
        chi = y / (1 - y)
        return chi * math.sqrt(float(layer.factors(np.float64(chi))[2])) - z

    values = []
    for y in _sunken_end(poisson) * (1 + chebyshev_nodes(2 * CHIS)) / 2:
        z = y / (1 - y)
        root = brentq(excess, 0.0, _END + 1e-9, args=(z,), xtol=1e-14) if z > 0 else 0.0
        values.append([-math.log(float(layer.factors(np.float64(root / (1 - root)))[2]))])
    return chebyshev_coefficients(np.array(values))
