"""How the patches of all contacts follow the force and the contact modulus.

On a given body and layer semi-axes, exponent and p_0/E* depend on F/E* alone, for any linear
elastic model (by dimensions): so their derivatives in ln F, at one E*, tell those in ln E*, too.
On a half-space lengths go with (F/E*)^(1/3) and p_0 with F^(1/3) E*^(2/3), the exponent stays. On a
layer of thickness t nothing is a power: there patches and derivatives come from the contact model
itself, by automatic differentiation, in units of t and E*.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from ...contact import ContactModel, Patches
from ...core.codegen import compile_function
from ...core.se3 import Array
from . import pressure, pressure_elliptic
from .batch import BATCH, evaluate

if TYPE_CHECKING:
    from ..data.measurements import Measurements
    from .contacts import Contacts

Means = Callable[[Array, np.ndarray, "Contacts", float], tuple[Array, Array, tuple[Array, ...]]]
"""What taxels read in units of the peak, and its derivatives by place and shape."""


class LoadDerivatives(NamedTuple):
    """Derivatives in ln F at constant E*: numbers, or of every contact (m, 1)."""

    shape: tuple[Any, ...]
    """Of what `Means` calls the shape."""
    peak: Any
    """Of ln p_0."""


def half_space(
    data: Measurements, log_force: Array, log_modulus: float
) -> tuple[Patches, LoadDerivatives]:
    """Patches at forces and E* that are by `log_force` (m,) and `log_modulus` off the nominal."""
    length = np.exp((log_force - log_modulus) / 3)
    patch = data.patches
    found = patch._replace(
        first=patch.first * length,
        second=patch.second * length,
        peak=patch.peak * np.exp((log_force + 2 * log_modulus) / 3),
        depth=patch.depth * length**2,
    )
    return found, LoadDerivatives((1 / 3,) * (1 if data.model.name == "hertz" else 2), 1 / 3)


def layer(
    data: Measurements, log_force: Array, log_modulus: float
) -> tuple[Patches, LoadDerivatives]:
    """As `half_space`, on a layer."""
    modulus, t = data.modulus * np.exp(log_modulus), data.model.thickness or 1.0
    load = np.log(data.force / (modulus * t**2)) + log_force
    out = evaluate(
        _layer(data.model.poisson, data.model.thickness is None),
        len(load), load, data.curvature * t, data.indenter_radius / t,
    )  # fmt: skip
    first, second, peak, depth, exponent = out[:, :5].T
    by_first, by_second, by_peak, _, by_exponent = out[:, 5:, None].swapaxes(0, 1)
    found = Patches(first * t, second * t, peak * modulus, depth * t, exponent)
    return found, LoadDerivatives((by_first, by_second, by_exponent), by_peak)


@functools.cache
def _layer(poisson: float, endless: bool) -> ca.Function:
    """(ln F/(E* t^2), k_1 t, k_2 t, r/t) by columns -> a/t, b/t, p_0/E*, depth/t, exponent, and
    the derivatives in ln F of the logarithms of the first four and of the exponent.

    `endless`: without a thickness; t is any unit of length, then.
    """
    x = ca.SX.sym("x", 4)
    patch = ContactModel("layered", poisson, None if endless else 1.0).patches(
        force=ca.exp(x[0]), curvature=x[1:3], indenter_radius=x[3], effective_modulus=1.0
    )
    sizes = ca.vertcat(patch.first, patch.second, patch.peak, patch.depth)
    slope = ca.jacobian(ca.vertcat(ca.log(sizes), patch.exponent), x[0])
    out = ca.vertcat(sizes, patch.exponent, slope)
    return compile_function(ca.Function("layer", [x], [out], {"cse": True})).map(BATCH)


PATCHES_UNDER_LOAD = {"hertz": half_space, "elliptic": half_space, "layered": layer}
"""How patches follow force and modulus, by the name of the contact model."""
DISC_MEANS: dict[str, Means] = {
    "hertz": pressure.circle,
    "elliptic": pressure_elliptic.ellipse,
    "layered": pressure_elliptic.profile,
}
"""What is read under them, by the name of the contact model."""
