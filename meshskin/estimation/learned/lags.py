"""Lags of the readings behind the pressure, beyond those that the estimate has.

Covers and electronics relax with a distribution of time constants, and the loops of hysteresis are
those of a distribution of play operators. An estimate has one of each, and none where no single one
shows. A lag displaces the taxels along the motion of the contacts, which hardly shows in the
residuals: it shifts all taxels that are crossed in one direction alike. What is left of it is
therefore estimated at the end (small_effects.py): creep with each of several time constants and
play of each of several widths, a Prony series and a Prandtl-Ishlinskii operator.

Source: Visintin, Differential Models of Hysteresis (1994), section III.2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ...core.arrays import Array
from ..joint.departures import WIDTHS, FittedReadings
from ..joint.electronics import WIDTH, Electronics
from ..joint.small_effects import SmallEffects, contact_leverages, shared_effects
from .random_effects import RandomEffects

LAGS = "lags of the readings with several time constants or widths"
MAX_LEVERAGE = 0.1
"""Mean leverage of the contacts' errors from which lags are not looked for: how well these errors
are determined depends on the lags, which a likelihood at its mode leaves out. With 0.5 (counts of
studies/foreign_worlds.py) shares were found that are none, in four of seven recordings, and 1.4 to
1.7 times the error stated; with lags there 0.8 to 1.0 without them. With 0.01 to 0.04 (creep_twice
there, Preisach's operator, two time constants) they were right."""
MIN_LEVERAGE = 1e-3
"""Mean leverage of the contacts' errors below which they add nothing: at 4e-4 it was less than 0.05
standard deviations."""
DRAWS = 2
"""Pairs of draws: 4 and 12 pairs differ by 0.1 standard deviations with 985 contacts."""
STEP = 0.1
"""Length of a draw in standard deviations: at 1 readings are no longer linear in force errors that
are known to 10 %."""


def lags(
    fitted: FittedReadings, beyond_mode: Callable[[Callable[[FittedReadings], Array]], Array]
) -> SmallEffects:
    """The lags of the readings beyond those in `fitted`; beyond_mode: the slope of the marginal
    likelihood less that at the mode, of parameters whose derivatives a function gives
    (`slope_beyond_mode`)."""
    columns = _columns(fitted)
    slope, information = fitted.shared(columns)
    slope = np.where(np.diag(information) > 0, slope + beyond_mode(_columns), 0.0)
    return shared_effects(fitted, columns, slope, information)


def _columns(fitted: FittedReadings) -> Array:
    """Derivatives (k, q) of the readings in the shares of creep and play."""
    electronics = Electronics(fitted.data, fitted.readings, fitted.points)
    pressure = np.maximum(fitted.mu - fitted.offset, 0.0)
    halves = (np.full(len(pressure), width * WIDTH * electronics.peak) for width in WIDTHS)
    plays = [electronics.play(pressure, half)[0] - pressure for half in halves]
    return np.column_stack([fitted.creeps(electronics), *plays])


def slope_beyond_mode(effects: RandomEffects, columns: Callable[[FittedReadings], Array]) -> Array:
    """The slope (q,) of the marginal log-likelihood less that at the mode, which
    `FittedReadings.shared` gives; columns: derivatives (k, q) of readings in parameters that all
    taxels share.

    An estimate takes the errors of the contacts at their mode; the marginal likelihood is the
    integral over them. By Laplace's method its logarithm is that at the mode less half the log
    determinant of the information on the errors, and this determinant changes with the parameters:
    a lag makes readings change less with the errors of their contacts, and so the determinant
    smaller. By Fisher's identity the slope of the integral is the mean, over the posterior of the
    errors, of the slope at given errors. Its difference from the slope at the mode is a second
    derivative, taken along pairs of draws.

    Source: Louis, "Finding the observed information matrix when using the EM algorithm", Journal of
    the Royal Statistical Society B 44 (1982), section 2.

    Zero where forces were not measured, as the deviation of their errors is a bound, where a lag
    that is estimated couples the contacts, and where contacts have no errors (MIN_LEVERAGE).
    """
    fitted, system = effects.fitted(), effects.system()
    weighted = fitted.curvature[:, None] * columns(fitted)
    exact = np.mean(contact_leverages(fitted)) < MIN_LEVERAGE
    if exact or not effects.data.force_measured or effects.electronics is not None:
        return np.zeros(weighted.shape[1])
    follows = system.solve(*system.transposed(fitted.jacobian, weighted))

    def slope(errors: Array) -> Array:
        moved = _moved(effects, errors)
        left = columns(replace(fitted, mu=moved.mu)) - system.forward(moved.jacobian, follows)
        return -(moved.slopes()[0] @ left)

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
