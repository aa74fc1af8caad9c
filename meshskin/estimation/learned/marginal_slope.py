"""The slope of the marginal likelihood, over the errors of the contacts, in other parameters.

An estimate takes these errors at their mode; the marginal likelihood is the integral over them. By
Laplace's method its logarithm is that at the mode less half the log determinant of the information
on the errors, and this determinant changes with the parameters: a lag makes readings change less
with the errors of their contacts, and so the determinant smaller. By Fisher's identity the slope of
the integral is the mean, over the posterior of the errors, of the slope at given errors. Its
difference from the slope at the mode is a second derivative, taken along pairs of draws.

Source: Louis, "Finding the observed information matrix when using the EM algorithm", Journal of the
Royal Statistical Society B 44 (1982), section 2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ...core.arrays import Array
from ..joint.departures import FittedReadings
from ..joint.pressure import robust_costs
from ..joint.rejected_readings import HUBER
from .lags import contact_leverage
from .random_effects import RandomEffects

MIN_LEVERAGE = 1e-3
"""Mean leverage of the contacts' errors below which they add nothing: at 4e-4 it was less than 0.05
standard deviations."""
DRAWS = 2
"""Pairs of draws: 4 and 12 pairs differ by 0.1 standard deviations with 985 contacts."""
STEP = 0.1
"""Length of a draw in standard deviations: at 1 readings are no longer linear in force errors that
are known to 10 %."""


def slope_beyond_mode(effects: RandomEffects, columns: Callable[[FittedReadings], Array]) -> Array:
    """The slope (q,) of the marginal log-likelihood less that at the mode, which
    `FittedReadings.shared` gives; columns: derivatives (k, q) of readings in parameters that all
    taxels share.

    Zero where forces were not measured, as the deviation of their errors is a bound, where a lag
    that is estimated couples the contacts, and where contacts have no errors (MIN_LEVERAGE).
    """
    fitted, system = effects.fitted(), effects.system()
    weighted = fitted.curvature[:, None] * columns(fitted)
    exact = contact_leverage(fitted) < MIN_LEVERAGE
    if exact or not effects.data.force_measured or effects.electronics is not None:
        return np.zeros(weighted.shape[1])
    follows = system.solve(*system.transposed(fitted.jacobian, weighted))

    def slope(errors: Array) -> Array:
        moved = _moved(effects, errors)
        left = columns(replace(fitted, mu=moved.mu)) - system.forward(moved.jacobian, follows)
        return -(_rate(moved) @ left)

    rng, root = np.random.default_rng(0), np.linalg.cholesky(np.linalg.inv(system.contacts))
    total = -DRAWS * slope(np.zeros(root.shape[:2]))
    for _ in range(DRAWS):
        draw = STEP * np.einsum("mij,mj->mi", root, rng.normal(size=root.shape[:2]))
        total += (slope(draw) + slope(-draw)) / 2
    return total / (DRAWS * STEP**2)


def _moved(effects: RandomEffects, errors: Array) -> RandomEffects:
    """The readings where the contacts have further errors (m, 3)."""
    u = replace(effects.unknowns, errors=effects.unknowns.errors + errors)
    moved = RandomEffects(effects.data, effects.readings, u, effects.deviations, effects.pattern)
    moved.spread = effects.spread
    return moved


def _rate(effects: RandomEffects) -> Array:
    """Derivatives (k,) of the readings' costs."""
    readings, spread = effects.readings, effects.spread
    level = readings.level / effects.data.sigma / spread
    rate = robust_costs(effects.mu / spread, level, readings.kind, HUBER)[1]
    return np.asarray(rate * readings.weight / spread)
